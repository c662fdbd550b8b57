"""Fiducial marks of scans: found, reported, drawn, and written into a project."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.errors import InputError, PhotoplanError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.camera.file import read_cameras
from photoplan.io.camera.model import FiducialSystem
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.run_record import recording
from photoplan.io.scan_pitch import parse_pitch
from photoplan.orientation.marks.fiducials import FiducialSearch, find_fiducials
from photoplan.orientation.marks.found import FiducialResult, MarksNotFound, SoughtMark
from photoplan.orientation.marks.layout import MarkLayout
from photoplan.orientation.marks.locate import LEAST_CORRELATION
from photoplan.plain import pick
from photoplan.project.camera_marks import ScanImage, mark_patterns, stated_pixel_mm


@dataclass(frozen=True, eq=False)
class ImageFiducials:
    """Marks of one image."""

    name: str
    file: Path
    camera: str
    size: tuple[int, int]
    grey: str
    """Which grey values were used."""
    band: int | None
    """Band that was used; None: luminance."""
    layout: MarkLayout
    """What was sought."""
    found: FiducialResult

    def json_fields(self) -> dict[str, Any]:
        """Every mark, and the affine transformation."""
        found, fit = self.found, self.found.fit
        residuals = dict(zip(fit.names, found.residuals_um))
        return {
            **pick(self, "file", "camera", "size", "grey", image="name"),
            "pixel_um": 1000 * found.pixel_mm,
            **pick(found.turn, "rotation", "mirrored"),
            **pick(found, "negative", "blur_px", "notes"),
            "marks": [
                {
                    **pick(m, "name", "x", "y", "correlation", "method", "paraboloid", "matching"),
                    "sigma": [m.sigma_x, m.sigma_y],
                    "residual_um": residuals[m.name],
                }
                for m in found.marks
            ],
            "missing": [pick(m, "name", "x", "y", "reason", best_correlation="correlation") for m in found.missing],
            "affine": {
                "parameters": [getattr(fit.transformation, f"a{k}") for k in range(1, 7)],
                "residuals_um": residuals,
                "sigma0_px": fit.sigma0,
                **pick(found, "sigma0_um"),
                "redundancy": fit.redundancy,
            },
        }

    def __str__(self) -> str:
        found = self.found
        s = "no check: three marks" if math.isnan(found.sigma0_um) else f"sigma0 {found.sigma0_um:.1f} µm"
        worst = float(np.hypot(*found.residuals_um.T).max())
        tone = "negative" if found.negative else "positive"
        lines = [
            f"{self.name}: {len(found.marks)} of {len(found.marks) + len(found.missing)} marks, pixel "
            f"{1000 * found.pixel_mm:.3f} µm, {s}, largest residual {worst:.1f} µm, turned {found.turn}, {tone}"
        ]
        for m, (vx, vy) in zip(found.marks, found.residuals_um):
            lines.append(
                f"  {m.name:>6}  x {m.x:10.3f} ± {m.sigma_x:.3f}  y {m.y:10.3f} ± {m.sigma_y:.3f} px  "
                f"correlation {m.correlation:.3f}  residual {vx:+7.1f} {vy:+7.1f} µm  {m.method}"
            )
        for lost in found.missing:
            best = "" if math.isnan(lost.correlation) else f", best correlation {lost.correlation:.2f}"
            lines.append(f"  {lost.name:>6}  not found near {lost.x:.0f} {lost.y:.0f}: {lost.reason}{best}")
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class UnfoundFiducials:
    """A scan on which fewer than three marks were found."""

    name: str
    file: Path
    band: int | None
    """Band that was used; None: luminance."""
    layout: MarkLayout
    sought: tuple[SoughtMark, ...]


@dataclass(frozen=True, eq=False)
class FiducialsReport:
    """Marks of all images."""

    images: tuple[ImageFiducials, ...]
    failed: dict[str, str]
    """Reasons, by image."""
    unfound: tuple[UnfoundFiducials, ...]
    """Of the failed ones those on which marks were sought and not found, to be looked at."""
    written: Path | None
    """Project file that received the marks."""

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        failed = [{"image": name, "reason": reason} for name, reason in self.failed.items()]
        return {**pick(self, "images", project="written"), "failed": failed}


@dataclass(frozen=True)
class FiducialsRequest:
    """What is asked."""

    images: tuple[Path, ...]
    """Scans, or one project file."""
    camera: Path | None = None
    """File that describes their camera; a project describes its own."""
    camera_name: str | None = None
    """Which of its cameras, where it describes several."""
    select: tuple[str, ...] = ()
    """Names or patterns of a project's images; all film images if empty."""
    scan_resolution: str | None = None
    """Of the scans, such as ``1200dpi`` or ``21um``; None: as the files state it, else found."""
    rotation: int | None = None
    mirrored: bool | None = None
    negative: bool | None = None
    band: int | None = None
    least_correlation: float = LEAST_CORRELATION
    dry_run: bool = False
    """Do not write into the project."""


@dataclass(frozen=True)
class _Job:
    name: str
    file: Path
    camera_name: str
    mirrored: bool
    layout: MarkLayout


def locate_fiducials(request: FiducialsRequest, events: Events = SILENT) -> FiducialsReport:
    """Find the fiducial marks of all images; one that fails does not stop the others.

    Raises
    ------
    UsageError
        Options contradict each other.
    InputError
        Camera or project cannot be used.
    """
    project = _project(request)
    jobs = _jobs(request, project)
    pixel_mm = sum(parse_pitch(request.scan_resolution)) / 2 if request.scan_resolution else None
    with recording("fiducials", request, [*request.images, request.camera, *(job.file for job in jobs)]) as record:
        results: list[ImageFiducials] = []
        failed: dict[str, str] = {}
        unfound: list[UnfoundFiducials] = []
        events.begin("fiducial marks", len(jobs), "images")
        for job in jobs:
            try:
                results.append(_locate(request, job, pixel_mm, project is not None))
            except ResourceError:
                raise
            except PhotoplanError as error:
                failed[job.name] = f"{job.file}: {error}" if isinstance(error, MarksNotFound) else str(error)
                if isinstance(error, MarksNotFound):
                    unfound.append(
                        UnfoundFiducials(
                            name=job.name, file=job.file, band=request.band, layout=job.layout, sought=error.sought
                        )
                    )
            events.done()
        written = None
        if project is not None and results and not request.dry_run:
            written = request.images[0]
            edit_project(written, ProjectChanges(images={r.name: _entries(project, r) for r in results}))
        report = FiducialsReport(tuple(results), failed, tuple(unfound), written)
        record([written], report)
    return report


def scans_of(request: FiducialsRequest) -> dict[str, Path]:
    """Files of the images that a request asks for, by the names in its report."""
    return {job.name: job.file for job in _jobs(request, _project(request))}


def _project(request: FiducialsRequest) -> Project | None:
    """The project that is given in place of images."""
    if len(request.images) == 1 and request.images[0].suffix.lower() == ".toml":
        if request.camera is not None or request.camera_name is not None:
            raise UsageError("a project describes its cameras itself; leave out `camera` and `camera_name`")
        return load_project(request.images[0])
    if not request.images:
        raise UsageError("no image is given; give scans and `camera` FILE, or a project file")
    if request.select:
        raise UsageError("`images` chooses among the images of a project; here the images are given themselves")
    if request.camera is None:
        raise UsageError("`camera` FILE is needed: it describes the fiducial marks; or give a project file")
    return None


def _jobs(request: FiducialsRequest, project: Project | None) -> list[_Job]:
    if project is None:
        assert request.camera is not None
        name, system = _film_camera(request.camera, request.camera_name)
        layout = _layout(system, name, request.camera.resolve().parent)
        files = [str(path) for path in request.images]
        twice = sorted({f for f in files if files.count(f) > 1})
        if twice:
            raise UsageError(f"image {twice[0]} is given twice")
        return [
            _Job(name=path.name, file=path, camera_name=name, mirrored=system.mirrored, layout=layout)
            for path in request.images
        ]
    jobs = []
    layouts: dict[str, MarkLayout] = {}
    for name in project.select(request.select or None):
        image = project.image(name)
        marks = project.cameras[image.camera].fiducial_system
        if marks is None:
            if request.select:
                raise UsageError(f"image {name!r}: its camera {image.camera!r} is digital and has no fiducial marks")
            continue
        if image.camera not in layouts:
            layouts[image.camera] = _layout(marks, image.camera, project.folder)
        jobs.append(
            _Job(
                name=name,
                file=project.resolve(image.file),
                camera_name=image.camera,
                mirrored=marks.mirrored,
                layout=layouts[image.camera],
            )
        )
    if not jobs:
        raise InputError(f"{request.images[0]}: none of its images was taken with a film camera")
    return jobs


def _film_camera(path: Path, wanted: str | None) -> tuple[str, FiducialSystem]:
    marks = {name: camera.fiducial_system for name, camera in read_cameras(path).cameras.items()}
    film = {name: system for name, system in marks.items() if system is not None}
    listed = ", ".join(map(repr, film)) or "none"
    if wanted is not None:
        if wanted not in film:
            raise UsageError(f"{path}: has no film camera {wanted!r}; its film cameras are {listed}")
        return wanted, film[wanted]
    if len(film) != 1:
        raise UsageError(f"{path}: describes {len(film)} film cameras ({listed}); choose one with `camera_name`")
    return next(iter(film.items()))


def _layout(system: FiducialSystem, name: str, folder: Path) -> MarkLayout:
    try:
        return MarkLayout.of(system.places_mm, mark_patterns(system, folder))
    except InputError as error:
        raise InputError(f"camera {name!r}: {error}") from None


def _locate(request: FiducialsRequest, job: _Job, pixel_mm: float | None, in_project: bool) -> ImageFiducials:
    scan = ScanImage(job.file, request.band)
    known = FiducialSearch(
        pixel_mm=pixel_mm if pixel_mm is not None else stated_pixel_mm(job.file),
        rotation=request.rotation,
        mirrored=request.mirrored,
        usual_mirrored=job.mirrored,
        negative=request.negative,
        least_correlation=request.least_correlation,
    )
    try:
        found = find_fiducials(scan, job.layout, known)
    except MarksNotFound:
        raise
    except InputError as error:
        raise type(error)(f"{job.file}: {error}") from None
    if in_project and found.turn.mirrored != job.mirrored:
        raise InputError(
            f"{job.file}: the scan is {'' if found.turn.mirrored else 'not '}mirrored, but its camera "
            f"{job.camera_name!r} states mirrored = {str(job.mirrored).lower()}; correct that entry, or give "
            "scans of the other kind a camera of their own"
        )
    return ImageFiducials(
        name=job.name,
        file=job.file,
        camera=job.camera_name,
        size=scan.size,
        grey=scan.rule,
        band=request.band,
        layout=job.layout,
        found=found,
    )


def _entries(project: Project, result: ImageFiducials) -> dict[str, object]:
    """What is written for an image."""
    image = project.image(result.name)
    marks = {m.name: [round(m.x, 4), round(m.y, 4)] for m in result.found.marks}
    entries: dict[str, object] = {"fiducials": marks}
    if image.size is None and project.cameras[image.camera].size is None:
        entries["size"] = list(result.size)
    return entries

"""Film: fiducial marks, interior orientation, and resection of single images."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.fiducials import (
    MODELS,
    AffineFacts,
    FiducialFit,
    Shrinkage,
    affine_facts,
    film_shrinkage,
    residuals_on_film,
)
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Interior, Lens
from photoplan.errors import GeometryError, InputError, PhotoplanError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Estimate, Result, noted, raise_failed, with_sigma
from photoplan.geometry.pose import angle_in_unit, angles_from_rotation
from photoplan.io.camera.model import FiducialSystem
from photoplan.io.files import unique_stems
from photoplan.io.formats import read_cameras
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Image, Project, fiducial_fit, interior_of, lens_of
from photoplan.io.raster_info import parse_pitch, read_pitch
from photoplan.io.store import recording
from photoplan.orientation.bundle.adjust import angle_derivatives
from photoplan.orientation.bundle.model import AdjustedCamera
from photoplan.orientation.conventions import fitting_convention, of_resection, rejection_reason
from photoplan.orientation.marks.fiducials import FiducialSearch, find_fiducials
from photoplan.orientation.marks.locate import FiducialResult, MarkLayout, MarksNotFound, SoughtMark
from photoplan.orientation.resection import MeasuredPoints, Resected, ResectSettings, resect
from photoplan.plain import counted, pick
from photoplan.products.adjust.inputs import AdjustInputs, decimals_of, read_inputs, stated_accuracy
from photoplan.products.adjust.sensors import (
    Calibrated,
    block_camera,
    block_frame,
    calibrated,
    camera_entries,
    nadir_heights,
)
from photoplan.project.camera_marks import ScanImage, mark_patterns, stated_pixel_mm
from photoplan.project.cameras import stated_pose
from photoplan.requests.orient import FiducialsRequest, InteriorRequest, ResectRequest


@dataclass(frozen=True, eq=False)
class ImageFiducials:
    """Marks of one image."""

    name: str
    file: Path
    camera: str
    size: tuple[int, int]
    grey: str
    """Grey values that were used."""
    band: int | None
    """Band that was used; None: luminance."""
    layout: MarkLayout
    """Layout of the marks that were sought."""
    found: FiducialResult
    picture: Path | None
    """File of its picture."""

    def json_fields(self) -> dict[str, Any]:
        """Every mark, and the affine transformation."""
        found, fit = self.found, self.found.fit
        residuals = dict(zip(fit.names, found.residuals_um))
        return {
            **pick(self, "file", "camera", "size", "grey", "picture", image="name"),
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
    picture: Path | None
    """File of its picture."""


@dataclass(frozen=True, eq=False)
class FiducialsReport(Result):
    """Marks of all images."""

    images: tuple[ImageFiducials, ...]
    failed: dict[str, str]
    """Reasons, by image."""
    unfound: tuple[UnfoundFiducials, ...]
    """Failed images on which marks were searched and not found, to be looked at."""
    project: Path | None
    """Project file that received the marks."""

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        return {**pick(self, "images", "project"), "failed": _reasons(self.failed)}

    def summary(self) -> Sequence[str]:
        """Return the marks of each image."""
        return [str(image) for image in self.images]

    def messages(self) -> Sequence[str]:
        """Return the notes on images, the pictures of those that failed, and what was written into the project."""
        notes = [f"{image.name}: {note}" for image in self.images for note in image.found.notes]
        notes += [f"{u.name}: where its marks were sought: {u.picture}" for u in self.unfound if u.picture]
        changed = [f"{self.project}: fiducial marks of {len(self.images)} images written"] if self.project else []
        return [*noted(notes), *changed]


def _reasons(failed: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"image": name, "reason": reason} for name, reason in failed.items()]


@dataclass(frozen=True)
class _Job:
    name: str
    file: Path
    camera_name: str
    mirrored: bool
    layout: MarkLayout
    picture: Path | None = None


def locate_fiducials(request: FiducialsRequest, events: Events = SILENT) -> FiducialsReport:
    """Find the fiducial marks of all images; one that fails does not stop the others.

    Raises
    ------
    UsageError
        Options contradict each other.
    InputError
        Camera or project cannot be used.
    """
    project = None if request.project is None else load_project(request.project)
    jobs = _jobs(request, project)
    if request.pictures is not None:
        stems = unique_stems([job.name for job in jobs])
        places = {name: request.pictures / f"{stem}.fiducials.png" for name, stem in stems.items()}
        for place in places.values():
            check_output(place, [*request.images, *(job.file for job in jobs)], overwrite=request.overwrite)
        jobs = [replace(job, picture=places[job.name]) for job in jobs]
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
                            name=job.name,
                            file=job.file,
                            band=request.band,
                            layout=job.layout,
                            sought=error.sought,
                            picture=job.picture,
                        )
                    )
            events.done()
        written = request.project if results and not request.dry_run else None
        if project is not None and written is not None:
            edit_project(written, ProjectChanges(images={r.name: _entries(project, r) for r in results}))
        report = FiducialsReport(tuple(results), failed, tuple(unfound), written)
        record([written], report)
    return report


def _jobs(request: FiducialsRequest, project: Project | None) -> list[_Job]:
    if project is None:
        assert request.camera is not None
        name, system = _film_camera(request.camera, request.camera_name)
        layout = _layout(system, name, request.camera.resolve().parent)
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
        picture=job.picture,
    )


def _entries(project: Project, result: ImageFiducials) -> dict[str, object]:
    """Return the entries of an image in the project."""
    image = project.image(result.name)
    marks = {m.name: [round(m.x, 4), round(m.y, 4)] for m in result.found.marks}
    entries: dict[str, object] = {"fiducials": marks}
    if image.size is None and project.cameras[image.camera].size is None:
        entries["size"] = list(result.size)
    return entries


#: A film that seems to have changed by more was not scanned with the pitch that its file states.
UNBELIEVABLE = 0.01


@dataclass(frozen=True, eq=False)
class ImageInterior:
    """Interior orientation of one scan."""

    image: str
    camera: str
    fit: FiducialFit
    facts: AffineFacts
    """In millimetres and pixels."""
    plane_mm: NDArray[np.float64]
    """Calibrated places of the marks that were used, shape (n, 2)."""
    residuals_um: NDArray[np.float64]
    """Transformed minus measured, on the film: x right, y up, shape (n, 2), micrometres."""
    pitch: tuple[float, float] | None
    """Sampling distance of the scan, millimetres; None: not known, or not believable."""
    shrinkage: Shrinkage | None
    note: str | None = None

    @property
    def sigma0_um(self) -> float:
        """Standard deviation of one measured coordinate on the film; NaN without redundancy."""
        return self.fit.sigma0 * 1000 * math.sqrt(self.facts.pixel_size[0] * self.facts.pixel_size[1])

    def json_fields(self) -> dict[str, Any]:
        """Every mark with its residuals, and the figures in practical units."""
        fit, facts, shrinkage = self.fit, self.facts, self.shrinkage
        return {
            **pick(self, "image", "camera", "sigma0_um", "note"),
            **pick(fit, "model", "missing", "redundancy", sigma0_px="sigma0", mm_to_px="transformation"),
            "marks": [
                {"name": name, "x_mm": place[0], "y_mm": place[1], "residual_px": px, "residual_um": um}
                for name, place, px, um in zip(fit.names, self.plane_mm, fit.residuals, self.residuals_um)
            ],
            **pick(facts, "mirrored", scale_px_per_mm="scale"),
            "pixel_um": [1000 * s for s in facts.pixel_size],
            "rotation_deg": math.degrees(facts.rotation),
            "shear_mrad": 1000 * facts.shear,
            "scan_pitch_um": self.pitch and [1000 * p for p in self.pitch],
            "shrinkage_permille": shrinkage and [1000 * shrinkage.x, 1000 * shrinkage.y],
            "sigma_shrinkage_permille": shrinkage and [1000 * s for s in shrinkage.sigma],
        }

    def __str__(self) -> str:
        fit, facts = self.fit, self.facts
        check = (
            f"sigma0 {fit.sigma0:.3f} px = {self.sigma0_um:.1f} µm" if fit.redundancy else "not checked (no redundancy)"
        )
        lines = [f"{self.image}  {fit.model}, {len(fit.names)} marks: {check}"]
        lines += [
            f"  {name:>8}  vx {u[0]:+8.1f}  vy {u[1]:+8.1f} µm   {v[0]:+8.3f} {v[1]:+8.3f} px"
            for name, u, v in zip(fit.names, self.residuals_um, fit.residuals)
        ]
        x, y = (1000 * s for s in facts.pixel_size)
        turned = "mirrored, turned" if facts.mirrored else "turned"
        lines.append(
            f"  pixel {x:.3f} × {y:.3f} µm · {turned} {math.degrees(facts.rotation):+.3f}° · "
            f"shear {1000 * facts.shear:+.3f} mrad"
        )
        if self.shrinkage is not None and self.pitch is not None:
            s, (px, py) = self.shrinkage, self.pitch
            sigma = "" if math.isnan(s.sigma[0]) else f" (±{1000 * s.sigma[0]:.3f}, ±{1000 * s.sigma[1]:.3f})"
            lines.append(
                f"  film shrinkage x {1000 * s.x:+.3f} ‰  y {1000 * s.y:+.3f} ‰{sigma}, if a pixel of the scanner "
                f"is {1000 * px:.3f} × {1000 * py:.3f} µm"
            )
        if fit.missing:
            lines.append(f"  not measured: {', '.join(fit.missing)}")
        if self.note:
            lines.append(f"  {self.note}")
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class InteriorResult(Result):
    """Interior orientations of the scans of a project."""

    project: Path
    images: tuple[ImageInterior, ...]
    unmeasured: tuple[str, ...]
    """Film scans whose marks are not measured yet."""
    failed: dict[str, str]
    """Film scans whose marks cannot be right, and why."""
    cameras: tuple[str, ...]
    """Cameras whose model was set in the project file."""

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        return {**pick(self, "images", "unmeasured", written="cameras"), "failed": _reasons(self.failed)}

    def written(self) -> Sequence[Path]:
        """Return the project file if it was changed."""
        return [self.project] if self.cameras else []

    def summary(self) -> Sequence[str]:
        """Return the figures of each scan."""
        return [str(image) for image in self.images]

    def messages(self) -> Sequence[str]:
        """Return the scans without marks, and the cameras whose model was written."""
        names = ", ".join(self.unmeasured)
        lines = [f"note: marks not measured in {names}: `photoplan fiducials` finds them"] if names else []
        model = self.images[0].fit.model if self.images else ""
        return [*lines, *(f"camera {name!r}: interior = {model!r} written to the project" for name in self.cameras)]


def interior_orientations(request: InteriorRequest, events: Events = SILENT) -> InteriorResult:
    """Compute the interior orientation of every film scan of a project whose marks are measured.

    Scans with marks that cannot be right are listed in the result, the others are computed all the same; the project
    file is changed only if none fails.

    Raises
    ------
    UsageError
        The resolution is not understood.
    InputError
        The project has no film scan, or none with measured marks.
    """
    pitch = None if request.scan_resolution is None else parse_pitch(request.scan_resolution)
    project = load_project(request.project)
    scans = _scans(project, request)
    unmeasured = tuple(image.name for image in scans if not image.fiducials)
    if len(unmeasured) == len(scans):
        raise InputError(
            f"{request.project}: no fiducial marks are measured in {', '.join(unmeasured[:5])}; "
            "`photoplan fiducials` finds them"
        )
    found, failed = [], {}
    for image in scans:
        if image.fiducials:
            try:
                found.append(_interior(project, image, request.model, pitch))
            except InputError as error:
                failed[image.name] = str(error)
    cameras = tuple(dict.fromkeys(i.camera for i in found)) if request.write and not failed else ()
    if cameras:
        edit_project(request.project, ProjectChanges(cameras={name: {"interior": request.model} for name in cameras}))
    return InteriorResult(
        project=request.project, images=tuple(found), unmeasured=unmeasured, failed=failed, cameras=cameras
    )


def _scans(project: Project, request: InteriorRequest) -> list[Image]:
    chosen = [project.image(name) for name in project.select(request.images or None)]
    scans = [image for image in chosen if project.cameras[image.camera].fiducial_system]
    if not scans:
        raise InputError(
            f'{request.project}: none of {len(chosen)} images is the scan of a film (camera with type = "film"); '
            "digital images need no interior orientation"
        )
    return scans


def _interior(project: Project, image: Image, model: str | None, pitch: tuple[float, float] | None) -> ImageInterior:
    camera = project.cameras[image.camera]
    assert camera.fiducial_system is not None
    places = camera.fiducial_system.places_mm
    if model is not None and len(places) < MODELS[model]:
        raise GeometryError(
            f"image {image.name!r}: camera {image.camera!r} has {len(places)} fiducial marks; "
            f"{model} needs {MODELS[model]}"
        )
    fit = fiducial_fit(camera, image, model)
    plane = np.array([places[name] for name in fit.names])
    on_film = 1000 * residuals_on_film(fit.transformation, plane, fit.residuals)
    facts = affine_facts(fit.transformation)
    plain = ImageInterior(
        image=image.name,
        camera=image.camera,
        fit=fit,
        facts=facts,
        plane_mm=plane,
        residuals_um=on_film,
        pitch=None,
        shrinkage=None,
    )
    if pitch is None:
        try:
            pitch = read_pitch(project.resolve(image.file))
        except InputError:
            return replace(plain, note="film shrinkage is not known: the scan cannot be opened")
        if pitch is None:
            return replace(plain, note="film shrinkage is not known: the file states no resolution; `scan_resolution`")
        shrinkage = film_shrinkage(fit.transformation, pitch, fit.covariance)
        if max(abs(shrinkage.x), abs(shrinkage.y)) > UNBELIEVABLE:
            note = (
                f"film shrinkage is not known: the file says {25.4 / pitch[0]:.4g} dpi, its marks say "
                f"{25.4 * facts.scale[0]:.4g} dpi; `scan_resolution`"
            )
            return replace(plain, note=note)
    return replace(plain, pitch=pitch, shrinkage=film_shrinkage(fit.transformation, pitch, fit.covariance))


#: Control points from which an image is tried where none is named.
_LEAST = 3


@dataclass(frozen=True, eq=False)
class ResectResult(Result):
    """Orientations of single images."""

    project: Path
    images: tuple[ResectedImage, ...]
    failed: dict[str, str]
    """Images that could not be oriented, with the reason."""
    left_out: tuple[str, ...]
    """Images with fewer than three control points."""
    changed: bool
    """True if orientations were written into the project."""
    notes: tuple[str, ...]

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        own = pick(self, "project", "images", "left_out", "notes", written="changed")
        return {**own, "failed": _reasons(self.failed)}

    def written(self) -> Sequence[Path]:
        """Return the project file if it was changed."""
        return [self.project] if self.changed else []

    def summary(self) -> Sequence[str]:
        """Return the parameters of each image with their standard deviations, and gross errors."""
        return [line for image in self.images for line in image.lines()]

    def messages(self) -> Sequence[str]:
        """Return the notes, images with too little control, and what was written into the project."""
        notes = [*self.notes, *(f"{image.image.name}: {note}" for image in self.images for note in image.notes)]
        if self.left_out:
            names = ", ".join(self.left_out[:5]) + (" …" if len(self.left_out) > 5 else "")
            notes.append(f"{len(self.left_out)} images have fewer than 3 control points: {names}")
        changed = f"{self.project}: orientation of {counted(len(self.images), 'image')} written"
        return [*noted(notes), *([changed] if self.changed else [])]

    def raise_failures(self) -> None:
        """Name the images that could not be oriented."""
        raise_failed(self.failed, len(self.images), "images could not be oriented")


def resect_project(request: ResectRequest, events: Events = SILENT) -> ResectResult:
    """Orient images by control and write the result into the project.

    Raises
    ------
    UsageError
        Parameters of a camera should be free for several of its images.
    InputError
        Project or measurements cannot be used, or no image has three control points.
    """
    free = tuple(dict.fromkeys(request.free))
    settings = ResectSettings(free, not request.unknown_camera_constant, request.critical)
    events.begin("resection", 0, "images")
    project = _overridden(load_project(request.project), request)
    names = project.select(request.images or None)
    inputs = read_inputs(project, names)
    with recording("resect", request, [request.project, *inputs.files]) as record:
        counts = {name: len(control_rows(inputs, name)) for name in names}
        wanted = [n for n in names if request.images or counts[n] >= _LEAST]
        if not wanted:
            most = max(counts.items(), key=lambda item: item[1])
            raise UsageError(
                f"none of the {len(counts)} images has {_LEAST} control points with three known coordinates; the most, "
                f"{most[1]}, has image {most[0]!r}. Check that points are called the same in image points and control"
            )
        camera, count = Counter(project.image(n).camera for n in wanted).most_common(1)[0]
        if free and count > 1:
            raise UsageError(
                f"{', '.join(free)} of camera {camera!r} cannot be found for {count} images one by one, as each gives "
                "another value; name one with `images`, or free the parameters in `photoplan adjust`"
            )
        done: list[ResectedImage] = []
        failed: dict[str, str] = {}
        for name in wanted:
            try:
                done.append(resect_image(inputs, project.image(name), settings))
            except PhotoplanError as error:
                text = str(error)
                failed[name] = text if repr(name) in text else f"image {name!r}: {text}"
            events.done()
        written = bool(done) and not request.dry_run
        result = ResectResult(
            project=request.project,
            images=tuple(done),
            failed=failed,
            left_out=tuple(n for n in names if n not in wanted),
            changed=written,
            notes=inputs.notes,
        )
        if written:
            images = {r.image.name: r.image_entries for r in done}
            cameras = {r.image.camera: r.camera_entries for r in done if r.camera_entries}
            edit_project(request.project, ProjectChanges(images=images, cameras=cameras))
            record([request.project], result)
    return result


def _overridden(project: Project, request: ResectRequest) -> Project:
    """Return the project with the measurements that options name."""
    changes: dict[str, Any] = {
        "image_points": tuple(str(p.absolute()) for p in request.image_points),
        "control": tuple(str(p.absolute()) for p in request.control),
        "sigma_image": request.sigma_image,
        "sigma_control": request.sigma_control,
        # Positions take no part in a resection.
        "positions": None,
    }
    kept = {k: v for k, v in changes.items() if v or k == "positions"}
    return project.model_copy(update={"observations": project.observations.model_copy(update=kept)})


Array = NDArray[np.float64]

#: Decimals of angles that are written.
_ANGLE_DECIMALS = 10
_SINGULAR = "the angles are near a singular position of their order, only their combination is determined"
_GREEK = {"o": "ω", "p": "φ", "k": "κ"}


@dataclass(frozen=True, eq=False)
class ResectedImage:
    """An image with its orientation in the terms of the project."""

    image: Image
    size: tuple[int, int]
    points: MeasuredPoints
    found: Resected
    center: Array
    """(3,), in the project's CRS and the orientation's height system."""
    angles: Array
    """(3,), in the unit and order of the project."""
    covariance: Array
    """Covariances of centre, angles and the parameters of the camera that were unknowns, (6 + k, 6 + k)."""
    angle_names: tuple[str, ...]
    """ω, φ, κ in the order of the angles."""
    angle_unit: str
    calibrated: Calibrated | None
    """Parameters of the camera that were unknowns."""
    camera_entries: dict[str, Any]
    """Entries of the camera in the project that change."""
    notes: tuple[str, ...]

    @property
    def sigma_center(self) -> Array:
        """(3,), metres."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def sigma_angles(self) -> Array:
        """(3,), in the project's unit."""
        return np.sqrt(np.diag(self.covariance)[3:6])

    @property
    def image_entries(self) -> dict[str, Any]:
        """Entries of the image in the project."""
        return {
            "center": _rounded(self.center, decimals_of(self.sigma_center)),
            "angles": _rounded(self.angles, _ANGLE_DECIMALS),
            **stated_accuracy(self.covariance),
            "approximate": None,
        }

    @property
    def gross_errors(self) -> list[str]:
        """A line for each point that was taken out."""
        found = self.found
        lines = []
        for k in np.flatnonzero(found.rejected):
            dx, dy = found.residuals[k]
            size = np.nanmax(np.abs(found.normalised[k]))
            lines.append(
                f"gross error: point {self.points.names[k]!r} misses by {dx:+.1f}, {dy:+.1f} px, {size:.1f} times its "
                "standard deviation"
            )
        return lines

    @property
    def estimates(self) -> list[list[Estimate]]:
        """Projection centre, angles and, if they were unknown, parameters of the camera."""
        center = zip(("X0", "Y0", "Z0"), self.center, self.sigma_center)
        angles = zip(self.angle_names, self.angles, self.sigma_angles)
        found = [
            [Estimate(name, value, sigma, unit="m") for name, value, sigma in center],
            [
                Estimate(name, value, sigma, unit="°" if self.angle_unit == "deg" else self.angle_unit)
                for name, value, sigma in angles
            ],
        ]
        if self.calibrated is not None:
            c = self.calibrated
            found.append([Estimate(*each) for each in zip(c.parameters, c.after, c.sigma, c.parameters, c.units)])
        return found

    def lines(self) -> list[str]:
        """Return the parameters with their standard deviations, and gross errors."""
        found = self.found
        head = f"{self.image.name}  {counted(int((~found.rejected).sum()), 'point')} · redundancy {found.redundancy} · "
        head += f"sigma0 {found.sigma0:.3g} · rms {found.rms:.2f} px"
        if found.redundancy > 0:
            head += f" · 95 % within {found.reach_95:.1f} times ±"
        rows = [
            "  ".join(f"{e.name} {with_sigma(e.value, e.sigma, e.unit)}" for e in group) for group in self.estimates
        ]
        return [head, *(f"  {row}" for row in rows), *(f"  {line}" for line in self.gross_errors)]

    def json_fields(self) -> dict[str, Any]:
        """Orientation, quality, and every point."""
        found = self.found
        return {
            "image": self.image.name,
            **self.image_entries,
            **pick(found, "sigma0", "redundancy", "reach_95", rms_px="rms"),
            "covariance_rotation": found.covariance[3:6, 3:6],
            "camera": None if self.calibrated is None else _camera_fields(self.calibrated),
            "points": [
                {
                    "name": name,
                    "xy": self.points.xy[k],
                    "residual_px": found.residuals[k],
                    "normalised": found.normalised[k],
                    "redundancy": found.redundancies[k],
                    "rejected": found.rejected[k],
                }
                for k, name in enumerate(self.points.names)
            ],
            "notes": self.notes,
        }


def _camera_fields(found: Calibrated) -> dict[str, Any]:
    columns = zip(found.parameters, found.after, found.sigma, found.units, found.before)
    return {
        name: {"value": value, "sigma": sigma, "unit": unit, "before": before}
        for name, value, sigma, unit, before in columns
    }


def _rounded(values: Array, decimals: int) -> list[float]:
    return [float(v) + 0.0 for v in np.round(values, decimals)]


def control_rows(inputs: AdjustInputs, name: str) -> list[tuple[int, int]]:
    """Return the measurements of control with three known coordinates in an image: (measurement, ground point)."""
    points, ground = inputs.points, inputs.ground
    if name not in points.images:
        return []
    known = np.isfinite(ground.XYZ).all(axis=1) & ~ground.check
    at = {n: k for k, n in enumerate(ground.names) if known[k]}
    mine = np.flatnonzero(points.image == points.images.index(name))
    pairs = ((int(k), at.get(points.points[points.point[k]], -1)) for k in mine)
    return [(k, g) for k, g in pairs if g >= 0]


def resect_image(inputs: AdjustInputs, image: Image, settings: ResectSettings) -> ResectedImage:
    """Orient one image of a project by its control points."""
    project = inputs.project
    described = project.cameras[image.camera]
    interior, lens = interior_of(described, image), lens_of(described)
    # By the names that coefficients have with y up.
    settings = replace(
        settings, free=block_camera(image.camera, described, interior, dict.fromkeys(settings.free)).free
    )
    rows = control_rows(inputs, image.name)
    given = measured_control(inputs, rows)
    frame = block_frame(project, given.XYZ if rows else np.zeros((1, 3)))
    working = given
    if frame.local is not None and rows:
        XYZ = given.XYZ.copy()
        XYZ[:, 2] = frame.inward(XYZ)
        working = replace(given, XYZ=XYZ)
    found = resected(project, image, working, interior, lens, settings)
    terrain = float(nadir_heights(project, found.pose.center[None, :2], np.nan)[0])
    wrong = rejection_reason(of_resection(working, found, terrain))
    if wrong is not None:
        fits = fitting_convention(
            working,
            interior.size[1],
            lambda other: resected(project, image, other, interior, lens, settings),
            found.rms,
        )
        raise GeometryError(f"image {image.name!r}: {wrong}; its orientation is not written: {fits}")
    center = found.pose.center.copy()
    if frame.local is not None:
        center[2] = frame.outward(center)
    orientation = project.orientation
    R = found.pose.R_ground_camera
    D = angle_derivatives(R, orientation.rotation)
    of_angles = D @ found.covariance[3:6, 3:6] @ D.T
    T = np.eye(len(found.covariance))
    T[3:6, 3:6] = angle_in_unit(D, orientation.angle_unit)
    camera, entries = (None, {}) if not found.free else _calibration(project, image, found)
    if camera is not None:
        T[6:, 6:] = camera.of_block
    return ResectedImage(
        image=image,
        size=interior.size,
        points=given,
        found=found,
        center=center,
        angles=angle_in_unit(angles_from_rotation(R, orientation.rotation), orientation.angle_unit),
        covariance=T @ found.covariance @ T.T,
        angle_names=tuple(_GREEK[k] for k in orientation.rotation),
        angle_unit=orientation.angle_unit,
        calibrated=camera,
        camera_entries=entries,
        notes=(*found.notes, *([_SINGULAR] if np.sqrt(np.diag(of_angles)).max() > 0.5 else [])),
    )


def _calibration(project: Project, image: Image, found: Resected) -> tuple[Calibrated, dict[str, Any]]:
    """Return the calibrated camera of an image, and the entries that its description gets."""
    described = project.cameras[image.camera]
    start = block_camera(image.camera, described, interior_of(described, image))
    adjusted = AdjustedCamera(
        name=image.camera,
        c=found.interior.c,
        principal_point=found.interior.principal_point,
        lens=found.lens,
        free=found.free,
        covariance=found.covariance[6:, 6:],
    )
    camera = calibrated(described, start, adjusted)
    return camera, {**camera_entries(described, start, adjusted), "sigma": camera.sigmas}


def measured_control(inputs: AdjustInputs, rows: list[tuple[int, int]]) -> MeasuredPoints:
    """Return the points of `control_rows`."""
    points, ground = inputs.points, inputs.ground
    k, g = np.array(rows, np.int64).reshape(-1, 2).T
    covariance = np.zeros((len(g), 3, 3))
    covariance[:, range(3), range(3)] = ground.sigma[g] ** 2
    if ground.covariance is not None:
        covariance = ground.covariance[g]
    names, xy = tuple(ground.names[i] for i in g), points.xy[k]
    return MeasuredPoints(names=names, xy=xy, sigma=points.sigma[k], XYZ=ground.XYZ[g], covariance=covariance)


def resected(
    project: Project, image: Image, points: MeasuredPoints, interior: Interior, lens: Lens, settings: ResectSettings
) -> Resected:
    """Resect an image with the earth curvature and refraction of the project."""
    orientation = project.orientation
    curvature, refraction = orientation.earth_curvature, orientation.refraction
    camera_of = partial(oriented_camera, crs=project.crs, earth_curvature=curvature, refraction=refraction)
    below = float(points.XYZ[:, 2].mean()) if len(points) else 0.0
    over = partial(camera_of, mean_ground=below)
    plain = curvature == "none" and not refraction
    near = None if image.center is None or image.angles is None else stated_pose(project, image)
    found = resect(points, interior, lens, settings, camera_of=None if plain else over, near=near, name=image.name)
    if curvature == "correction":
        # It refers to the ground below the station, which is known only now.
        below = float(nadir_heights(project, found.pose.center[None, :2], below)[0])
        over = partial(camera_of, mean_ground=below)
        found = resect(points, interior, lens, settings, camera_of=over, near=found.pose, name=image.name)
    return found

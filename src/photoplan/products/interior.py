"""Interior orientation of a project's film scans from their measured marks: figures, choice of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.affine_facts import AffineFacts, Shrinkage, affine_facts, film_shrinkage, residuals_on_film
from photoplan.cameras.fiducials_fit import MODELS, FiducialFit
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.io.project.cameras import fiducial_fit
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.io.scan_pitch import parse_pitch, read_pitch
from photoplan.plain import pick

#: A film that seems to have changed by more was not scanned with the pitch that its file states.
UNBELIEVABLE = 0.01


@dataclass(frozen=True)
class InteriorRequest:
    """What is asked."""

    project: Path
    images: tuple[str, ...] | None = None
    """Names or patterns; None: all film scans."""
    model: str | None = None
    """One of `MODELS`; None: what the camera states."""
    scan_resolution: str | None = None
    """Such as ``1200dpi`` or ``21um``; None: as the files state it."""
    write: bool = False
    """Whether the model becomes that of the cameras."""


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
class InteriorResult:
    """What came out."""

    images: tuple[ImageInterior, ...]
    unmeasured: tuple[str, ...]
    """Film scans whose marks are not measured yet."""
    failed: dict[str, str]
    """Film scans whose marks cannot be right, and why."""
    written: tuple[str, ...]
    """Cameras whose model was set in the project file."""

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        failed = [{"image": name, "reason": reason} for name, reason in self.failed.items()]
        return {**pick(self, "images", "unmeasured", "written"), "failed": failed}


def interior_orientations(request: InteriorRequest) -> InteriorResult:
    """Interior orientation of every film scan of a project whose marks are measured.

    Scans with marks that cannot be right are listed in the result, the others are computed all the same; the project
    file is changed only if none fails.

    Raises
    ------
    UsageError
        `write` without a model, or the resolution is not understood.
    InputError
        The project has no film scan, or none with measured marks.
    """
    if request.write and request.model is None:
        raise UsageError("`write` sets the model of the cameras; say which with `model`")
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
    written = _write(request, found) if request.write and not failed else ()
    return InteriorResult(tuple(found), unmeasured, failed, written)


def _scans(project: Project, request: InteriorRequest) -> list[Image]:
    chosen = [project.image(name) for name in project.select(request.images)]
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


def _write(request: InteriorRequest, found: Sequence[ImageInterior]) -> tuple[str, ...]:
    cameras = tuple(dict.fromkeys(i.camera for i in found))
    edit_project(request.project, ProjectChanges(cameras={name: {"interior": request.model} for name in cameras}))
    return cameras

"""`photoplan resect`: images of a project oriented by control points, one by one, as entries of the project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.build import oriented_camera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.errors import GeometryError, PhotoplanError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.rotation import ANGLE_UNITS, angles_from_rotation
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.io.run_record import recording
from photoplan.orientation.bundle.block import AdjustedCamera
from photoplan.orientation.bundle.frame import angle_derivatives
from photoplan.orientation.judgement import fitting, impossible, of_resection
from photoplan.orientation.resection.adjust import resect
from photoplan.orientation.resection.model import MeasuredPoints, Resected, ResectSettings
from photoplan.plain import pick
from photoplan.products.adjust.block import decimals_of, stated_accuracy
from photoplan.products.adjust.cameras import Calibrated, block_camera, calibrated, camera_entries
from photoplan.products.adjust.frame import block_frame, nadir_heights
from photoplan.products.adjust.inputs import AdjustInputs, read_inputs
from photoplan.project.posed import stated_pose

#: Control points from which an image is tried where none is named.
_LEAST = 3


@dataclass(frozen=True)
class ResectRequest:
    """What is asked."""

    project: Path
    images: tuple[str, ...] = ()
    """Names or patterns; none: all images with three control points or more."""
    image_points: tuple[Path, ...] = ()
    """Instead of those that [observations] names."""
    control: tuple[Path, ...] = ()
    """Instead of those that [observations] names."""
    sigma_image: float | None = None
    """Standard deviation of image coordinates, pixels; None: that of the project."""
    sigma_control: tuple[float, float] | None = None
    """Standard deviation of control, horizontal and height, metres; None: that of the project."""
    free: tuple[str, ...] = ()
    """Parameters of the camera that are unknowns: c, x0, y0."""
    unknown_camera_constant: bool = False
    """The stated camera constant is no start value either."""
    critical: float = 4.0
    dry_run: bool = False
    """Whether the project is left as it is."""


@dataclass(frozen=True, eq=False)
class ResectResult:
    """What came out."""

    project: Path
    images: tuple[ResectedImage, ...]
    failed: dict[str, str]
    """Images that could not be oriented, with the reason."""
    left_out: tuple[str, ...]
    """Images with fewer than three control points."""
    written: bool
    notes: tuple[str, ...]

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        return {
            **pick(self, "project", "written", "images", "left_out", "notes"),
            "failed": [{"image": name, "reason": reason} for name, reason in self.failed.items()],
        }


def resect_project(request: ResectRequest, events: Events = SILENT) -> ResectResult:
    """Orient images by control and write the result into the project.

    Raises
    ------
    UsageError
        Parameters of a camera should be free for several of its images.
    InputError
        Project or measurements cannot be used, or no image has three control points.
    """
    settings = ResectSettings(request.free, not request.unknown_camera_constant, request.critical)
    project = _overridden(load_project(request.project), request)
    names = project.select(request.images or None)
    inputs = read_inputs(project, names)
    with recording("resect", request, [request.project, *inputs.files]) as record:
        counts = {name: len(control_rows(inputs, name)) for name in names}
        wanted = [n for n in names if request.images or counts[n] >= _LEAST]
        _refuse(inputs, wanted, counts, settings)
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
        left = tuple(n for n in names if n not in wanted)
        result = ResectResult(
            project=request.project,
            images=tuple(done),
            failed=failed,
            left_out=left,
            written=written,
            notes=inputs.notes,
        )
        if written:
            edit_project(request.project, _changes(done))
            record([request.project], result)
    return result


def _overridden(project: Project, request: ResectRequest) -> Project:
    """The project with the measurements that options name."""
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


def _refuse(inputs: AdjustInputs, wanted: Sequence[str], counts: dict[str, int], settings: ResectSettings) -> None:
    if not wanted:
        most = max(counts.items(), key=lambda item: item[1])
        raise UsageError(
            f"none of the {len(counts)} images has {_LEAST} control points with three known coordinates; the most, "
            f"{most[1]}, has image {most[0]!r}. Check that points are called the same in image points and control"
        )
    if settings.free:
        project = inputs.project
        count = Counter(project.image(n).camera for n in wanted)
        camera, images = count.most_common(1)[0]
        if images > 1:
            raise UsageError(
                f"{', '.join(settings.free)} of camera {camera!r} cannot be found for {images} images one by one, as "
                "each gives another value; name one with `images`, or free the parameters in `photoplan adjust`"
            )


def _changes(done: Sequence[ResectedImage]) -> ProjectChanges:
    return ProjectChanges(
        images={r.image.name: r.image_entries for r in done},
        cameras={r.image.camera: r.camera_entries for r in done if r.camera_entries},
    )


Array = NDArray[np.float64]

#: Decimals of angles that are written.
_ANGLE_DECIMALS = 10
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
    """Of centre, angles and the parameters of the camera that were unknowns, (6 + k, 6 + k)."""
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
    def angle_sign(self) -> str:
        """What is written behind angles."""
        return {"deg": "°", "gon": " gon", "rad": " rad"}[self.angle_unit]

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
    """Measurements of control with three known coordinates in an image: (measurement, ground point)."""
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
    wrong = impossible(of_resection(working, found, terrain))
    if wrong is not None:
        fits = fitting(
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
    to_unit = ANGLE_UNITS[orientation.angle_unit] / (2 * np.pi)
    R = found.pose.R_ground_camera
    D = angle_derivatives(R, orientation.rotation)
    of_angles = D @ found.covariance[3:6, 3:6] @ D.T
    T = np.eye(len(found.covariance))
    T[3:6, 3:6] = D * to_unit
    camera, entries = (None, {}) if not found.free else _calibration(project, image, found)
    if camera is not None:
        T[6:, 6:] = camera.of_block
    return ResectedImage(
        image=image,
        size=interior.size,
        points=given,
        found=found,
        center=center,
        angles=angles_from_rotation(R, orientation.rotation) * to_unit,
        covariance=T @ found.covariance @ T.T,
        angle_names=tuple(_GREEK[k] for k in orientation.rotation),
        angle_unit=orientation.angle_unit,
        calibrated=camera,
        camera_entries=entries,
        notes=(*found.notes, *_notes(of_angles)),
    )


def _calibration(project: Project, image: Image, found: Resected) -> tuple[Calibrated, dict[str, Any]]:
    """What an image says of its camera, and the entries that the description gets."""
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


def _notes(of_angles: Array) -> Sequence[str]:
    if np.sqrt(np.diag(of_angles)).max() > 0.5:
        return ["the angles are near a singular position of their order, only their combination is determined"]
    return []


def measured_control(inputs: AdjustInputs, rows: list[tuple[int, int]]) -> MeasuredPoints:
    """The points of `control_rows`."""
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
    """Resection with the earth curvature and refraction of the project."""
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

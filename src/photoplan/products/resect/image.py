"""One image of a project resected: from measurements and control to entries of the project."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera
from photoplan.cameras.build import oriented_camera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose
from photoplan.geometry.rotation import angles_from_rotation
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.io.project.model import ANGLE_UNITS, Image, Project
from photoplan.orientation.bundle.block import AdjustedCamera
from photoplan.orientation.bundle.frame import angle_derivatives
from photoplan.orientation.judgement import fitting, impossible, of_resection
from photoplan.orientation.resection.adjust import resect
from photoplan.orientation.resection.model import MeasuredPoints, Resected, ResectSettings
from photoplan.plain import pick
from photoplan.products.adjust.block import decimals_of
from photoplan.products.adjust.cameras import Calibrated, block_camera, calibrated, camera_entries
from photoplan.products.adjust.frame import block_frame, nadir_heights
from photoplan.products.adjust.inputs import AdjustInputs
from photoplan.project.scene import stated_pose

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
    sigma_center: Array
    sigma_angles: Array
    angle_names: tuple[str, ...]
    """ω, φ, κ in the order of the angles."""
    angle_unit: str
    calibrated: Calibrated | None
    """Parameters of the camera that were unknowns."""
    camera_entries: dict[str, Any]
    """Entries of the camera in the project that change."""
    notes: tuple[str, ...]

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
            "sigma_center": [float(f"{v:.4g}") for v in self.sigma_center],
            "sigma_angles": [float(f"{v:.4g}") for v in self.sigma_angles],
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
            **pick(found, "sigma0", "redundancy", rms_px="rms"),
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
    """Orient one image of a project by its control points.

    Raises
    ------
    InputError
        The interior orientation is not known, or height systems cannot be joined.
    GeometryError
        The points do not determine the orientation.
    """
    project = inputs.project
    described = project.cameras[image.camera]
    interior, lens = interior_of(described, image), lens_of(described)
    rows = control_rows(inputs, image.name)
    given = measured_control(inputs, rows)
    frame = block_frame(project, given.XYZ if rows else np.zeros((1, 3)))
    working = given
    if frame.local is not None and rows:
        XYZ = given.XYZ.copy()
        XYZ[:, 2] = frame.inward(XYZ)
        working = MeasuredPoints(given.names, given.xy, given.sigma, XYZ, given.covariance)
    found = resected(project, image, working, (interior, lens), settings)
    terrain = float(nadir_heights(project, found.pose.center[None, :2], np.nan)[0])
    wrong = impossible(of_resection(working, found, terrain))
    if wrong is not None:
        fits = fitting(
            working, interior.size[1], lambda other: resected(project, image, other, (interior, lens), settings)
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
    camera = None
    entries: dict[str, Any] = {}
    if found.free:
        start = block_camera(image.camera, described, interior, dict.fromkeys(found.free))
        adjusted = AdjustedCamera(
            image.camera, found.interior.c, found.interior.principal_point, lens, found.free, found.covariance[6:, 6:]
        )
        camera, entries = calibrated(described, start, adjusted), camera_entries(described, start, adjusted)
    return ResectedImage(
        image=image,
        size=interior.size,
        points=given,
        found=found,
        center=center,
        angles=angles_from_rotation(R, orientation.rotation) * to_unit,
        sigma_center=np.sqrt(np.diag(found.covariance)[:3]),
        sigma_angles=np.sqrt(np.diag(of_angles)) * to_unit,
        angle_names=tuple(_GREEK[k] for k in orientation.rotation),
        angle_unit=orientation.angle_unit,
        calibrated=camera,
        camera_entries=entries,
        notes=(*found.notes, *_notes(of_angles)),
    )


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
    return MeasuredPoints(tuple(ground.names[i] for i in g), points.xy[k], points.sigma[k], ground.XYZ[g], covariance)


def resected(
    project: Project, image: Image, points: MeasuredPoints, camera: tuple[Interior, Lens], settings: ResectSettings
) -> Resected:
    """Resection with the earth curvature and refraction of the project."""
    orientation = project.orientation
    below = float(points.XYZ[:, 2].mean()) if len(points) else 0.0

    def camera_of(interior: Interior, lens: Lens, pose: Pose) -> CentralCamera:
        return oriented_camera(
            interior,
            lens,
            pose,
            crs=project.crs,
            earth_curvature=orientation.earth_curvature,
            refraction=orientation.refraction,
            mean_ground=below,
        )

    plain = orientation.earth_curvature == "none" and not orientation.refraction
    near = None if image.center is None or image.angles is None else stated_pose(project, image)
    found = resect(points, *camera, settings, camera_of=None if plain else camera_of, near=near, name=image.name)
    if orientation.earth_curvature == "correction":
        # It refers to the ground below the station, which is known only now.
        below = float(nadir_heights(project, found.pose.center[None, :2], below)[0])
        found = resect(points, *camera, settings, camera_of=camera_of, near=found.pose, name=image.name)
    return found

"""A camera that was turned onto a photograph: its angles with standard deviations, and a file that holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.iterate import by_differences
from photoplan.geometry.rotation import ANGLE_UNITS, angles_from_rotation, small_rotations, view_from_rotation
from photoplan.io.naming import write_atomically
from photoplan.io.orientation.block import OrientationBlock
from photoplan.io.orientation.table import OrientationTable, OrientedImage
from photoplan.io.orientation.toml import render
from photoplan.io.project.write import toml_value
from photoplan.products.view.camera import CameraRequest, ViewCamera, map_axes
from photoplan.products.view.ground import ViewGround
from photoplan.products.view.photo_skyline import PhotoMatch, turned
from photoplan.project.posed import stated_pose
from photoplan.targets.view import FrameBundle

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RefinedCamera:
    """A camera, turned; its standpoint is as it was."""

    names: tuple[str, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    sigma: tuple[float, ...]
    unit: str
    """Of all of them: deg, gon or rad."""
    used: int
    """Columns of the photograph that decided."""
    correlated: float
    """Columns that err together, see `orientation.skyline`."""
    text: str
    """The file that holds it."""
    constant: tuple[float, float] | None = None
    """Of an image, where it was free: the factor of its camera's constant, and the standard deviation of that."""

    def json_fields(self) -> dict[str, Any]:
        """Its numbers."""
        rows = zip(self.names, self.before, self.after, self.sigma)
        told = {name: {"before": b, "after": a, "sigma": s} for name, b, a, s in rows}
        if self.constant is not None:
            told["constant_factor"] = {"before": 1.0, "after": self.constant[0], "sigma": self.constant[1]}
        return {"unit": self.unit, **told, "columns_used": self.used, "columns_correlated": self.correlated}


def refined_camera(camera: ViewCamera, match: PhotoMatch, ground: ViewGround, path: Path | None) -> RefinedCamera:
    """Angles of a camera that was turned: azimuth, pitch, roll and field of view of a standpoint, an image's own."""
    assert match.fit is not None and match.turn is not None
    of_image = camera.request.image is not None

    def numbers(turn: _Floats) -> _Floats:
        return _of_image(camera, ground, turn) if of_image else _of_standpoint(camera, turn)

    unit = ground.named.orientation.angle_unit if of_image else "deg"
    order = ground.named.orientation.rotation if of_image else ""
    greek = {"o": "omega", "p": "phi", "k": "kappa"}
    names = tuple(greek[k] for k in order) if of_image else ("azimuth", "pitch", "roll", "field_of_view")
    before, after = numbers(np.zeros_like(match.turn)), numbers(match.turn)
    D = by_differences(numbers, match.turn, 1e-6)
    sigma = np.sqrt(np.diag(D @ match.fit.covariance @ D.T))
    count = len(names) if of_image else len(match.turn)
    constant = None
    if of_image and len(match.turn) > 3:
        factor = math.exp(match.turn[3])
        constant = factor, factor * math.sqrt(match.fit.covariance[3, 3])
    if of_image:
        text = _orientation_text(camera, ground, after, path, constant)
    else:
        text = _camera_text(camera.request, after)
    told = (tuple(float(v) for v in row[:count]) for row in (before, after, sigma))
    b, a, s = told
    return RefinedCamera(
        names=names[:count],
        before=b,
        after=a,
        sigma=s,
        unit=unit,
        used=match.fit.used,
        correlated=match.fit.correlated,
        text=text,
        constant=constant,
    )


def write_refined(path: Path, refined: RefinedCamera) -> None:
    """Write its file."""
    write_atomically(path, refined.text.encode())


def _of_standpoint(camera: ViewCamera, turn: _Floats) -> _Floats:
    """Azimuth, pitch, roll and field of view, degrees."""
    target = turned(camera.target, turn)
    assert isinstance(target.bundle, FrameBundle)
    axes = map_axes(target.warps, target.center)
    azimuth, pitch, roll = view_from_rotation(axes.T @ target.bundle.camera.pose.R_ground_camera)
    stated = math.radians(camera.request.azimuth or 0.0)
    azimuth = stated + math.remainder(azimuth - stated, 2 * math.pi)
    half = math.tan(math.radians(camera.request.field_of_view or 60.0) / 2)
    wide = 2 * math.atan(half / math.exp(turn[3] if len(turn) > 3 else 0.0))
    return np.degrees([azimuth, pitch, roll, wide])


def _of_image(camera: ViewCamera, ground: ViewGround, turn: _Floats) -> _Floats:
    """Angles of an image, in the order and the unit of its project."""
    project = ground.named
    R = stated_pose(project, project.image(str(camera.request.image))).R_ground_camera
    angles = angles_from_rotation(R @ small_rotations(turn[None, :3])[0], project.orientation.rotation)
    return np.asarray(angles * (ANGLE_UNITS[project.orientation.angle_unit] / (2 * np.pi)))


def _camera_text(request: CameraRequest, after: _Floats) -> str:
    """A file that is taken in place of an image as the camera of a view."""
    names = ("azimuth", "pitch", "roll", "field_of_view")
    values: dict[str, Any] = dict(zip(names, (round(float(v), 7) for v in after)))
    found = replace(request, **values)
    lines = ["# A camera of views, turned onto the skyline of a photograph; angles in degrees, lengths in metres."]
    stated = ((f.name, getattr(found, f.name)) for f in fields(found))
    told = ((n, list(v) if isinstance(v, tuple) else v) for n, v in stated if v is not None)
    return "\n".join([*lines, *(f"{n} = {toml_value(v)}" for n, v in told), ""])


def _orientation_text(
    camera: ViewCamera, ground: ViewGround, after: _Floats, path: Path | None, constant: tuple[float, float] | None
) -> str:
    """An orientation file of one image."""
    project = ground.named
    image = project.image(str(camera.request.image))
    a, b, c = (round(float(v), 8) for v in after)
    line = OrientedImage(name=image.name, center=image.pose_numbers[0], angles=(a, b, c), camera=image.camera)
    stated = project.orientation
    file = path or Path("refined.toml")
    table = OrientationTable(
        file, (line,), stated.angle_unit, stated.rotation, crs=project.crs, height_system=stated.height_system
    )
    note = ""
    if constant is not None:
        factor, sigma = constant
        note = f"# Its camera constant is {factor:.7f} (±{sigma:.7f}) times that of its camera: alter it there, too.\n"
    return note + render(OrientationBlock(table), file)[file]

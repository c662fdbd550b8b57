"""OpenSfM's ``reconstruction.json`` written; see `photoplan.io.orientation.opensfm` for what the numbers mean."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from photoplan.errors import InputError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.earth_poses import topocentric_of_map
from photoplan.io.camera.model import FilmCamera, FrameCamera
from photoplan.io.lens_forms import opencv_form, opencv_losses
from photoplan.io.orientation.block import Loss, OrientationBlock, height_losses, require_cameras
from photoplan.io.orientation.table import FLIP, OrientationTable


def axis_angle(R_camera_world: NDArray[np.float64]) -> list[float]:
    """Rotation vector of a matrix (3, 3), radians."""
    vector: list[float] = Rotation.from_matrix(R_camera_world).as_rotvec().tolist()
    return vector


def losses(block: OrientationBlock) -> Iterable[Loss]:
    """What of a block the format cannot hold."""
    yield from opencv_losses(block, rational=False)
    yield from height_losses(block.table)


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Text of a ``reconstruction.json``.

    Raises
    ------
    InputError
        The block has no cameras or no place on the earth, or a camera has no form there.
    """
    require_cameras(block, path, "reconstruction.json")
    origin, centers, rotations = _tangential(block.table, path)
    shots = {}
    for image, center, R in zip(block.table.images, centers, rotations):
        R_camera_world = FLIP @ R.T
        shots[image.name] = {
            "rotation": axis_angle(R_camera_world),
            "translation": (-R_camera_world @ center).tolist(),
            "camera": block.camera_name(image),
            "orientation": 1,
        }
    contents = {
        "cameras": {name: normalised_camera(name, camera, path) for name, camera in block.cameras.items()},
        "shots": shots,
        "points": {},
        "reference_lla": dict(zip(("latitude", "longitude", "altitude"), origin)),
    }
    return {path: json.dumps([contents], indent=1) + "\n"}


def _tangential(
    table: OrientationTable, path: Path
) -> tuple[tuple[float, float, float], NDArray[np.float64], NDArray[np.float64]]:
    """Origin of a tangential system, and poses in it."""
    if table.origin is not None:
        return table.origin, table.centers, table.rotations
    if table.crs is None:
        raise InputError(f"{path}: reconstruction.json needs the place on the earth; state the CRS of the orientation")
    middle = table.centers.mean(axis=0)
    lon, lat = crs_step(table.crs, "EPSG:4326")(middle[:2]).tolist()
    origin = (lat, lon, float(table.centers[:, 2].min()))
    enu, R_map_enu = topocentric_of_map(origin, table.crs, table.centers)
    return origin, enu, np.swapaxes(R_map_enu, 1, 2) @ table.rotations


def normalised_camera(name: str, camera: FrameCamera | FilmCamera, path: Path) -> dict[str, Any]:
    """Entry of a camera in ``cameras``.

    Raises
    ------
    InputError
        It has no form there.
    """
    form = opencv_form(camera)
    if form is None or form.rational:
        raise InputError(f"{path}: camera {name!r} has no form in OpenSfM; write without its lens, or another format")
    side = max(form.size)
    c_x, c_y = ((point - (s - 1) / 2) / side for point, s in zip(form.point, form.size))
    common: dict[str, Any] = {"width": form.size[0], "height": form.size[1]}
    common |= {"focal_x": form.focal[0] / side, "focal_y": form.focal[1] / side, "c_x": c_x, "c_y": c_y}
    k = {f"k{i + 1}": v for i, v in enumerate(form.k)}
    if form.fisheye:
        return {"projection_type": "fisheye_opencv", **common, **k}
    radial = {n: k[n] for n in ("k1", "k2", "k3")}
    return {"projection_type": "brown", **common, **radial, "p1": form.p[0], "p2": form.p[1]}

"""Exterior orientation from OpenSfM's ``reconstruction.json``.

As its documentation defines it (opensfm.org/docs: geometry, dataset): ``rotation`` is an angle-axis vector that, with
``translation``, takes world coordinates to camera coordinates, x_camera = R x_world + t, the camera's axes being x
right, y down, z forwards. World coordinates are a local tangential system (east, north, up) whose origin is
``reference_lla``. So the projection centre is −Rᵀ t, and with our axes (y up, z backwards)
R_ground_camera = Rᵀ diag(1, −1, −1).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.io.camera.opensfm import cameras_of
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat
from photoplan.io.orientation.opensfm_write import losses, render
from photoplan.io.orientation.table import FLIP, OrientationTable, OrientedImage, TableFormat, degrees_of
from photoplan.io.plain_files import finite, read_json


def rotation_from_axis_angle(vector: ArrayLike) -> NDArray[np.float64]:
    """Matrix of the rotation about `vector` (3,) by its length in radians (Rodrigues' formula)."""
    v = np.asarray(vector, float)
    angle = float(np.linalg.norm(v))
    if angle == 0:
        return np.eye(3)
    x, y, z = v / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def read(path: Path, form: TableFormat) -> OrientationTable:
    """Orientation table of a ``reconstruction.json``, in its local tangential system; `form` is not used.

    Raises
    ------
    InputError
        The file is no such JSON, or it is not georeferenced.
    """
    contents = read_json(path)
    if not isinstance(contents, list) or not all(isinstance(r, dict) and "shots" in r for r in contents):
        raise InputError(f"{path}: not a reconstruction.json of OpenSfM (a list of reconstructions with `shots`)")
    origins = {_origin(r, path) for r in contents}
    if len(origins) != 1:
        raise InputError(f"{path}: the reconstructions have {len(origins)} different origins; keep one reconstruction")
    images = [_image(name, shot, path) for r in contents for name, shot in r["shots"].items()]
    notes = []
    if len(contents) > 1:
        sizes = ", ".join(str(len(r["shots"])) for r in contents)
        notes.append(f"{path.name}: {len(contents)} separate reconstructions ({sizes} images), tied by GPS only")
    return OrientationTable(path, tuple(images), origin=origins.pop(), notes=tuple(notes))


def _origin(reconstruction: dict[str, Any], path: Path) -> tuple[float, float, float]:
    lla = reconstruction.get("reference_lla")
    beside = path.with_name("reference_lla.json")
    if lla is None and beside.is_file():
        lla, path = read_json(beside, 100_000), beside
    if not isinstance(lla, dict):
        raise InputError(f"{path}: states no reference_lla; the reconstruction is not georeferenced")
    lat, lon, alt = (finite(lla.get(k), f"{path}: reference_lla.{k}") for k in ("latitude", "longitude", "altitude"))
    if abs(lat) > 90 or abs(lon) > 360:
        raise InputError(f"{path}: reference_lla latitude {lat}, longitude {lon} are not on the earth")
    return lat, lon, alt


def _image(name: str, shot: Any, path: Path) -> OrientedImage:
    where = f"{path}: shot {name!r}"
    if not isinstance(shot, dict) or "rotation" not in shot or "translation" not in shot:
        raise InputError(f"{where}: rotation or translation is missing")
    R_camera_world = rotation_from_axis_angle(finite(shot["rotation"], f"{where}: rotation", 3))
    t = np.array(finite(shot["translation"], f"{where}: translation", 3))
    center = -R_camera_world.T @ t
    angles = degrees_of((R_camera_world.T @ FLIP)[None])[0]
    camera = shot.get("camera")
    return OrientedImage(
        name,
        (float(center[0]), float(center[1]), float(center[2])),
        (float(angles[0]), float(angles[1]), float(angles[2])),
        str(camera) if camera is not None else None,
    )


def read_block(path: Path, form: TableFormat) -> OrientationBlock:
    """The same table with the cameras of the file, where it describes them.

    Raises
    ------
    InputError
        See `read`, or a camera's model is not supported.
    """
    table = read(path, form)
    contents = read_json(path)
    cameras = {}
    if all(isinstance(r.get("cameras"), dict) for r in contents):
        cameras = cameras_of(contents, path)
    return OrientationBlock(table, cameras)


FORMAT = OrientationFormat(
    name="opensfm",
    title="reconstruction.json of OpenSfM",
    sniff=lambda path, head: path.suffix.lower() == ".json" and '"shots"' in head,
    read=read_block,
    render=render,
    losses=losses,
    suffix=".json",
)

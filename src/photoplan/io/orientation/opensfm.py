"""Exterior orientation from OpenSfM's ``reconstruction.json``.

As its documentation defines it (opensfm.org/docs: geometry, dataset): ``rotation`` is an angle-axis vector that, with
``translation``, takes world coordinates to camera coordinates, x_camera = R x_world + t, the camera's axes being x
right, y down, z forwards. World coordinates are a local tangential system (east, north, up) whose origin is
``reference_lla``, or with OpenDroneMap of today a UTM zone (`photoplan.io.orientation.opensfm_world`). So the
projection centre is −Rᵀ t, and with our axes (y up, z backwards) R_ground_camera = Rᵀ diag(1, −1, −1).
"""

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
from photoplan.geometry.earth_poses import enu_of_geodetic, geodetic_of_enu, topocentric_of_map
from photoplan.io.appearance import looks_like
from photoplan.io.camera.model import CameraEntry
from photoplan.io.camera.opensfm import cameras_of
from photoplan.io.lens_forms import opencv_form, opencv_losses
from photoplan.io.orientation.block import Loss, OrientationBlock, OrientationFormat, height_losses, require_cameras
from photoplan.io.orientation.opensfm_world import Shots, world_of
from photoplan.io.orientation.table import FLIP, OrientationTable, TableFormat, posed
from photoplan.io.plain_files import finite, read_json


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
    shots: dict[str, dict[str, Any]] = {}
    for image, center, R in zip(block.table.images, centers, rotations):
        R_camera_world = FLIP @ R.T
        shots[image.name] = {
            "rotation": Rotation.from_matrix(R_camera_world).as_rotvec().tolist(),
            "translation": (-R_camera_world @ center).tolist(),
            "camera": block.camera_name(image),
            "orientation": 1,
        }
    if block.table.positions is not None:
        gps = enu_of_geodetic(origin, block.table.positions)
        for shot, position in zip(shots.values(), gps):
            if np.isfinite(position).all():
                shot["gps_position"] = position.tolist()
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


def normalised_camera(name: str, camera: CameraEntry, path: Path) -> dict[str, Any]:
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


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of a ``reconstruction.json``, in its local system or UTM zone; `form` is not used.

    With the cameras of the file, where it describes them.

    Raises
    ------
    InputError
        The file is no such JSON, it is not georeferenced, its poses are in no known world, or a camera's model is not
        supported.
    """
    contents = read_json(path)
    if not isinstance(contents, list) or not all(isinstance(r, dict) and "shots" in r for r in contents):
        raise InputError(
            f"{path}: not a reconstruction.json of OpenSfM (a list of reconstructions with `shots`){looks_like(path)}"
        )
    origins = {_origin(r, path) for r in contents}
    if len(origins) != 1:
        raise InputError(f"{path}: the reconstructions have {len(origins)} different origins; keep one reconstruction")
    origin = origins.pop()
    stated = [(name, shot) for r in contents for name, shot in r["shots"].items()]
    if not stated:
        raise InputError(f"{path}: a reconstruction.json without shots; reconstruct again")
    shots = _shots(stated, path)
    world = world_of(path, origin, shots)
    rotations = np.swapaxes(Rotation.from_rotvec(shots.vectors).as_matrix(), 1, 2) @ FLIP
    images = tuple(
        posed(name, center, R, str(shot["camera"]) if shot.get("camera") else None)
        for (name, shot), center, R in zip(stated, shots.centers + world.offset, rotations)
    )
    notes = [world.note]
    if len(contents) > 1:
        sizes = ", ".join(str(len(r["shots"])) for r in contents)
        notes.insert(0, f"{path.name}: {len(contents)} separate reconstructions ({sizes} images), tied by GPS only")
    known = np.isfinite(shots.gps).any()
    table = OrientationTable(
        path,
        images,
        crs=world.crs,
        origin=origin if world.crs is None else None,
        positions=geodetic_of_enu(origin, shots.gps) if known else None,
        notes=tuple(notes),
    )
    described = all(isinstance(r.get("cameras"), dict) for r in contents)
    return OrientationBlock(table, cameras_of(contents, path) if described else {})


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


def _shots(stated: list[tuple[str, Any]], path: Path) -> Shots:
    """Poses and positions of receivers, as stated."""
    centers, vectors, gps, dops = [], [], [], []
    for name, shot in stated:
        where = f"{path}: shot {name!r}"
        if not isinstance(shot, dict) or "rotation" not in shot or "translation" not in shot:
            raise InputError(f"{where}: rotation or translation is missing")
        vectors.append(finite(shot["rotation"], f"{where}: rotation", 3))
        t = np.array(finite(shot["translation"], f"{where}: translation", 3))
        centers.append(-Rotation.from_rotvec(vectors[-1]).inv().apply(t))
        position = shot.get("gps_position")
        gps.append([np.nan] * 3 if position is None else finite(position, f"{where}: gps_position", 3))
        dops.append(shot["gps_dop"] if isinstance(shot.get("gps_dop"), int | float) else np.nan)
    known = [d for d in dops if np.isfinite(d)]
    return Shots(
        names=tuple(name for name, _ in stated),
        centers=np.array(centers),
        vectors=np.array(vectors),
        gps=np.array(gps, float),
        dop=float(np.median(known)) if known else np.nan,
    )


FORMAT = OrientationFormat(
    name="opensfm",
    title="reconstruction.json of OpenSfM",
    sniff=lambda path, head: path.suffix.lower() == ".json" and '"shots"' in head,
    read=read,
    render=render,
    losses=losses,
    suffix=".json",
)

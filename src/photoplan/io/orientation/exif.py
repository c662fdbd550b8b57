"""Approximate orientations from what drones write into their images: position, and the attitude of the gimbal.

The gimbal's axes are x along the viewing direction, y right, z down; R = R_z(yaw) R_y(pitch) R_x(roll) takes them to
north, east, down (DJI Mavic 3E/3T User Manual, "Photo File": NED, rotation order ZYX). So pitch −90 looks straight down
with the top of the image towards the yaw. The image lies on its sensor as the camera writes it, without EXIF's display
rotation.

Yaw is taken from true north. Positions become a tangential system (east, north, up), which later steps carry into the
project's CRS with the convergence of meridians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.local import enu_poses
from photoplan.geometry.pose import rotation_from_angles
from photoplan.io.image_metadata import ImageMetadata, read_image_metadata
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, OrientationTable, posed
from photoplan.io.orientation.form import TableFormat

SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff")
#: From north, east, down to east, north, up.
_R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: Columns: camera x (right), y (up) and z (backwards) in the gimbal's axes forwards, right, down.
_R_GIMBAL_CAMERA = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def rotation_from_gimbal(yaw_pitch_roll: ArrayLike) -> NDArray[np.float64]:
    """R_enu_camera (3, 3): camera axes to east, north, up, of yaw, pitch and roll in degrees."""
    # About z by yaw, then y by pitch, then x by roll: the order that is spelled kappa, phi, omega.
    R_ned_gimbal = rotation_from_angles(np.radians(np.asarray(yaw_pitch_roll, float)), "kpo")
    return np.asarray(_R_ENU_NED @ R_ned_gimbal @ _R_GIMBAL_CAMERA, np.float64)


def image_files(path: Path) -> list[Path]:
    """JPEG and TIFF images of a folder by name, or the one file."""
    if not path.is_dir():
        return [path]
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not files:
        raise InputError(f"{path}: the folder holds no image ({', '.join(SUFFIXES)})")
    return files


@dataclass(frozen=True)
class Folder:
    """Images of a folder, or one image, by what they state."""

    placed: tuple[ImageMetadata, ...]
    """Images that state a position."""
    count: int
    """All images."""
    notes: tuple[str, ...]
    """Images that were left out, or parts of their metadata that are damaged."""


def read_folder(path: Path) -> Folder:
    """Metadata of the images of a folder, or of one image."""
    files, found, unread = image_files(path), [], []
    for file in files:
        try:
            found.append(read_image_metadata(file))
        except InputError as error:
            if len(files) == 1:
                raise
            unread.append(str(error).removeprefix(f"{path}/"))
    notes = []
    unfixed = tuple(m.file.name for m in found if m.no_fix)
    damaged = tuple(f"{m.file.name}: {fault}" for m in found for fault in m.faults)
    lost = sum(m.position is None and not m.no_fix and not m.faults for m in found)
    elsewhere = {m.file: m.datum for m in found if m.position is not None and m.datum and not _is_wgs84(m.datum)}
    of_other = tuple(f"{file.name}: datum {datum}" for file, datum in elsewhere.items())
    for many, what in (
        (unread, "cannot be used and are left out"),
        (damaged, "have damaged metadata, which are left out"),
        (of_other, "refer to another datum than WGS 84 and are left out"),
    ):
        if many:
            notes.append(f"{path.name}: {len(many)} of {len(files)} images {what}: {listed(many)}")
    if unfixed:
        notes.append(f"{path.name}: {without_fix(unfixed)}; left out")
    if lost:
        notes.append(f"{path.name}: {lost} images state no position; left out")
    stated = tuple(m for m in found if m.position is not None and m.file not in elsewhere)
    if not stated:
        raise InputError(
            "; ".join([f"{path}: no image states a GPS position (latitude, longitude and altitude)", *notes])
        )
    return Folder(stated, len(files), tuple(notes))


def _is_wgs84(datum: str) -> bool:
    return datum.upper().replace(" ", "").replace("-", "").startswith("WGS84")


def listed(texts: Sequence[str]) -> str:
    """The first texts of many."""
    return "; ".join(texts[:3]) + (" …" if len(texts) > 3 else "")


def without_fix(names: Sequence[str]) -> str:
    """A note on images that state latitude and longitude 0."""
    states = "1 image states" if len(names) == 1 else f"{len(names)} images state"
    some = ", ".join(names[:3]) + (" …" if len(names) > 3 else "")
    return f"{states} latitude 0 and longitude 0, which receivers write without a position: {some}"


def map_positions(images: Sequence[ImageMetadata], crs: str) -> NDArray[np.float64]:
    """Positions in a projected CRS, shape (n, 3): map coordinates, and the height as the images state it."""
    places = np.array([m.position for m in images], float).reshape(-1, 3)
    step = crs_step("EPSG:4326", crs)
    step = step.near(places[0, [1, 0]]) if len(places) else step
    return np.column_stack([step(places[:, [1, 0]]), places[:, 2]])


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Approximate orientations of a folder of drone images, or of one; `form` is not used."""
    folder = read_folder(path)
    stated = folder.placed
    oriented = [m for m in stated if m.yaw_pitch_roll is not None and m.position is not None]
    if not oriented:
        raise InputError(
            f"{path}: {len(stated)} images state a position and none an attitude (gimbal angles in XMP); give the "
            "folder as positions in [observations] instead"
        )
    origin, enu, axes = enu_poses(np.array([m.position for m in oriented], float))
    # One camera needs no name: that of the camera file may be any.
    several = len({m.camera for m in oriented}) > 1
    images = tuple(
        posed(m.file.name, at, R @ rotation_from_gimbal(m.yaw_pitch_roll or (0, 0, 0)), m.camera if several else None)
        for m, at, R in zip(oriented, enu, axes)
    )
    notes, lost = list(folder.notes), len(stated) - len(oriented)
    notes += [f"{path.name}: {lost} images state no attitude; left out"] if lost else []
    turned = sum(m.display != 1 for m in oriented)
    if turned:
        notes.append(
            f"{path.name}: EXIF turns {turned} images for display; angles are those of the pixels as stored, so images "
            "that another program has turned need its angle"
        )
    notes.append(
        "positions and gimbal angles of drones are approximate: metres, degrees, and heights in a system of their own"
    )
    sizes = {m.file.name: m.size for m in oriented if m.size is not None}
    named = {m.file.name: m.file.name if path.is_dir() else str(m.file) for m in oriented}
    return OrientationBlock(OrientationTable(path, images, origin=origin, notes=tuple(notes)), files=named, sizes=sizes)


def _sniff(path: Path, head: str) -> bool:
    if path.is_dir():
        return any(p.suffix.lower() in SUFFIXES for p in path.iterdir())
    return path.suffix.lower() in SUFFIXES


FORMAT = OrientationFormat("exif", "positions and attitudes in drone images", _sniff, read)

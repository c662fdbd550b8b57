"""Observed positions of the antenna (GNSS), with or without attitudes (IMU), from tables of text.

A table names its columns in the first line: name, x, y, z, then as far as known omega, phi, kappa, sigma or sigma_xy
and sigma_z or sigma_x, sigma_y, sigma_z (metres), sigma_angle (one, in the unit of the angles), strip and time
(seconds, or ISO 8601). Files of other formats are read as orientations: all exposures are then one strip in the order
of the file. A folder of images gives the positions that EXIF and XMP state.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import ObservedAttitudes, ObservedPositions
from photoplan.errors import InputError
from photoplan.geometry.bounds import odd_angles, odd_place
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.heights import heights_in
from photoplan.geometry.rotation import rotation_from_angles
from photoplan.io.names import same_images
from photoplan.io.orientation.exif import map_positions, read_folder
from photoplan.io.orientation.file import read_orientation
from photoplan.io.orientation.table import TableFormat, angle_in_radians
from photoplan.io.plain_files import crs_beside
from photoplan.io.tables import Columns, Dialect, Table, read_table

_ROLES = {
    "name": ("name", "nom", "image", "image_name", "filename", "file", "photo", "label", "id"),
    "x": ("x", "x0", "e", "east", "easting"),
    "y": ("y", "y0", "n", "north", "northing"),
    "z": ("z", "z0", "h", "height", "altitude", "alt"),
    "omega": ("omega", "ω", "o"),
    "phi": ("phi", "φ", "p"),
    "kappa": ("kappa", "κ", "k"),
    "sigma": ("sigma",),
    "sigma_xy": ("sigma_xy", "sigma_h"),
    "sigma_x": ("sigma_x", "sx"),
    "sigma_y": ("sigma_y", "sy"),
    "sigma_z": ("sigma_z", "sz", "sigma_v"),
    "sigma_angle": ("sigma_angle", "sigma_attitude"),
    "strip": ("strip", "line", "flight_line", "run"),
    "time": ("time", "t", "gps_time", "seconds", "timestamp"),
}
_NEEDED = ("name", "x", "y", "z")
_TEXTS = (".csv", ".txt", ".tsv", ".dat", ".opk")


@dataclass(frozen=True, eq=False)
class PositionTable:
    """Observed positions and attitudes of a file, as it states them."""

    path: Path
    images: tuple[str, ...]
    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres."""
    sigma: NDArray[np.float64]
    """Standard deviations, shape (n, 3), metres; NaN: not stated."""
    R_ground_camera: NDArray[np.float64] | None
    """Shape (n, 3, 3); None: the file has no attitudes."""
    sigma_angle: NDArray[np.float64]
    """Standard deviation of each attitude, shape (n,), radians; NaN: not stated."""
    strip: tuple[str, ...]
    """Name of each image's strip; ``"all"`` where the file states none."""
    time: NDArray[np.float64]
    """Seconds; the running number of the line where the file states none."""
    notes: tuple[str, ...] = ()
    """What was left out."""

    def positions(self, sigma: tuple[float, float] | None = None) -> ObservedPositions:
        """The positions; those without a standard deviation get `sigma` (horizontal coordinates, height; metres)."""
        default = np.full(3, np.nan) if sigma is None else np.array([sigma[0], sigma[0], sigma[1]])
        full = np.where(np.isnan(self.sigma), default, self.sigma)
        lost = np.flatnonzero(np.isnan(full).any(axis=1))
        if len(lost):
            raise InputError(
                f"{self.path}: image {self.images[lost[0]]!r}: the accuracy of observed positions is not stated; give "
                "sigma_position = [horizontal, height] in [observations], or columns sigma_x, sigma_y, sigma_z"
            )
        return ObservedPositions(images=self.images, XYZ=self.XYZ, sigma=full, strip=self.strip, time=self.time)

    def attitudes(self, sigma: float | None = None) -> ObservedAttitudes | None:
        """The attitudes that have a standard deviation, or get `sigma` (radians); None if none has."""
        if self.R_ground_camera is None:
            return None
        full = np.where(np.isnan(self.sigma_angle), np.nan if sigma is None else sigma, self.sigma_angle)
        keep = np.flatnonzero(np.isfinite(full))
        if not len(keep):
            return None
        names = tuple(self.images[k] for k in keep)
        return ObservedAttitudes(names, self.R_ground_camera[keep], full[keep, None])


def read_observed_positions(
    path: Path,
    form: TableFormat | None = None,
    *,
    crs: str | None = None,
    height_system: str | None = None,
    columns: str | None = None,
) -> PositionTable:
    """Observed positions of a file."""
    path, form = Path(path), form or TableFormat()
    if path.is_dir() and crs is not None and not (path / "images.txt").is_file():
        return _from_images(path, crs)
    if path.suffix.lower() not in _TEXTS:
        return _from_orientation(path, form, crs, height_system)
    beside = None if crs is None else crs_beside(path)
    if beside is not None and crs is not None:
        _same(path, beside.system.crs, crs)
    table = read_table(
        path, Columns(roles=_ROLES, needed=_NEEDED), Dialect(columns, form.delimiter, form.decimal_comma)
    )
    names = table.names("name")
    first: dict[str, int] = {}
    spelled = same_images(names)
    for k, name in enumerate(names):
        at = first.setdefault(spelled[name], k)
        if at != k:
            raise InputError(
                f"{table.where(k)}: image {name!r} is given in line {table.lines[at]} already; keep one of the lines"
            )
    XYZ = table.numbers("x", "y", "z")
    if beside is not None:
        system = beside.system
        XYZ = heights_in(
            system.to_metres(XYZ, f"{path}: heights"), system.crs, system.heights, height_system, str(path)
        )
    for k, place in enumerate(XYZ.tolist()):
        odd = odd_place(place, camera=True)
        if odd is not None:
            raise InputError(f"{table.where(k)}: image {names[k]!r}: {odd}")
    strips = tuple(text or "all" for text in table.texts("strip"))
    sigma_angle = angle_in_radians(table.numbers("sigma_angle", empty=True), form.angle_unit)
    _positive(table, "sigma_angle", sigma_angle)
    return PositionTable(
        path=path,
        images=tuple(names),
        XYZ=XYZ,
        sigma=_sigma(table),
        R_ground_camera=_rotations(table, form),
        sigma_angle=sigma_angle,
        strip=strips,
        time=_times(table),
    )


def _sigma(table: Table) -> NDArray[np.float64]:
    out = []
    for roles in (("sigma_x", "sigma_xy", "sigma"), ("sigma_y", "sigma_xy", "sigma"), ("sigma_z", "sigma")):
        out.append(table.first_known(*roles))
        _positive(table, roles[0], out[-1])
    return np.stack(out, axis=1)


def _positive(table: Table, role: str, values: NDArray[np.float64]) -> None:
    bad = np.flatnonzero(values <= 0)
    if len(bad):
        raise InputError(f"{table.where(int(bad[0]))}: {role} = {values[bad[0]]:g}; it must be positive")


def _rotations(table: Table, form: TableFormat) -> NDArray[np.float64] | None:
    roles = ("omega", "phi", "kappa")
    there = [role for role in roles if role in table.roles]
    if not there:
        return None
    if len(there) < 3:
        raise InputError(f"{table.path}: columns {', '.join(there)} alone; omega, phi and kappa go together")
    angles = {role[0]: table.numbers(role) for role in roles}
    for k in range(len(table.rows)):
        odd = odd_angles([float(values[k]) for values in angles.values()], form.angle_unit, list(angles))
        if odd is not None:
            raise InputError(f"{table.where(k)}: {odd.split(';')[0]}; state the unit as angle_unit in [orientation]")
    stated = angle_in_radians(np.stack([angles[letter] for letter in form.rotation], axis=1), form.angle_unit)
    R = np.stack([rotation_from_angles(a, form.rotation) for a in stated])
    return R if form.direction == "camera-to-ground" else np.swapaxes(R, 1, 2)


def _times(table: Table) -> NDArray[np.float64]:
    if "time" not in table.roles:
        return np.arange(len(table.rows), dtype=float)
    texts = table.texts("time")
    if not any(re.match(r"\d{4}-\d\d-\d\d", text) for text in texts):
        return table.numbers("time")
    out = []
    for k, text in enumerate(texts):
        try:
            moment = datetime.datetime.fromisoformat(text)
        except ValueError:
            raise InputError(f"{table.where(k)}: time {text[:40]!r}; seconds or ISO 8601 are needed") from None
        out.append(moment.replace(tzinfo=moment.tzinfo or datetime.UTC).timestamp())
    return np.array(out)


def _same(path: Path, own: str, crs: str) -> None:
    if not same_crs(own, crs):
        raise InputError(
            f"{path}: positions in {crs_label(own)}, the project is in {crs_label(crs)}; `photoplan convert` "
            "transforms them"
        )


def _from_images(path: Path, crs: str) -> PositionTable:
    """Positions that drones write into their images, with the receiver's standard deviations and times."""
    folder = read_folder(path)
    images = folder.placed
    n = len(images)
    sigma = np.array([m.sigma or (np.nan,) * 3 for m in images], float).reshape(n, 3)
    times = [m.time for m in images]
    time = np.array(times, float) if all(t is not None for t in times) else np.arange(n, dtype=float)
    names = tuple(m.file.name for m in images)
    return PositionTable(
        path=path,
        images=names,
        XYZ=map_positions(images, crs),
        sigma=sigma,
        R_ground_camera=None,
        sigma_angle=np.full(n, np.nan),
        strip=("all",) * n,
        time=time,
        notes=folder.notes,
    )


def _from_orientation(path: Path, form: TableFormat, crs: str | None, heights: str | None) -> PositionTable:
    table = read_orientation(path, form).heights_in_metres(None)
    if table.origin is not None:
        raise InputError(f"{path}: positions refer to a local system; `photoplan convert` brings them into the CRS")
    if table.crs is not None and crs is not None:
        _same(path, table.crs, crs)
    centers = table.centers
    if table.crs is not None:
        centers = heights_in(centers, table.crs, table.height_system, heights, str(path))
    n = len(table.images)
    return PositionTable(
        path=path,
        images=tuple(image.name for image in table.images),
        XYZ=centers,
        sigma=np.full((n, 3), np.nan),
        R_ground_camera=table.rotations,
        sigma_angle=np.full(n, np.nan),
        strip=("all",) * n,
        time=np.arange(n, dtype=float),
    )

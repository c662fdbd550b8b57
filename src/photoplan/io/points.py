"""Ground points, image points and observed positions in files; points of surfaces as LAS, LAZ or PLY."""

from __future__ import annotations

import datetime
import importlib.util
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.windows
import shapely
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.arrays import Floats
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedAttitudes, ObservedPositions
from photoplan.errors import InputError, UsageError, named_by
from photoplan.geometry.bounds import odd_angles, odd_place
from photoplan.geometry.crs import crs_label, crs_step, parse_crs, same_crs
from photoplan.geometry.frames import Frame
from photoplan.geometry.heights import heights_in
from photoplan.geometry.pose import angle_in_radians, rotation_from_angles
from photoplan.geometry.units import MetricSystem, metric_system
from photoplan.io.disk import disk_error, open_raster
from photoplan.io.files import ImageNames, check_plain_file, crs_beside, read_text, same_images
from photoplan.io.formats import read_orientation
from photoplan.io.image_metadata import map_positions, read_image_folder
from photoplan.io.orientation.block import TableFormat
from photoplan.io.store import give_name, scratch, standing
from photoplan.io.tables import NUMBER, Columns, Dialect, TextTable, number, read_table, write_table
from photoplan.io.vector_layer import read_layer

_ROLES = {
    "name": ("name", "point", "id", "label", "gcp", "point_id", "marker"),
    "x": ("x", "x0", "e", "east", "easting", "x_m"),
    "y": ("y", "y0", "n", "north", "northing", "y_m"),
    "z": ("z", "z0", "h", "height", "altitude", "alt", "elevation", "z_m"),
    "sigma": ("sigma",),
    "sigma_xy": ("sigma_xy", "sigma_h"),
    "sigma_x": ("sigma_x", "sx"),
    "sigma_y": ("sigma_y", "sy"),
    "sigma_z": ("sigma_z", "sz", "sigma_v"),
    "role": ("role", "type", "use"),
}
_NEEDED = ("name", "x", "y", "z")
_SIGMAS = ("sigma", "sigma_xy", "sigma_x", "sigma_y", "sigma_z")
_CHECK = {"": False, "control": False, "gcp": False, "check": True, "checkpoint": True, "check point": True}


def read_ground_points(
    path: Path,
    *,
    crs: str | None = None,
    height_system: str | None = None,
    columns: str | None = None,
    decimal_comma: bool = False,
) -> GroundPoints:
    """Ground points of a table or of the first layer of a GeoPackage with points."""
    path = Path(path)
    if path.suffix.lower() == ".gpkg":
        return _from_layer(path, crs, height_system)
    beside = crs_beside(path)
    table = read_table(path, Columns(roles=_ROLES, needed=_NEEDED), Dialect(columns, decimal_comma=decimal_comma))
    names = table.names("name")
    stated = table.numbers("x", "y", "z", empty=True)
    XYZ = _in_metres(path, stated, None if beside is None else beside.system, crs, height_system)
    return _points(names, XYZ, lambda role: table.numbers(role, empty=True), table.texts("role"), table.where)


def _points(
    names: Sequence[str],
    XYZ: Floats,
    numbers: Callable[[str], Floats],
    roles: Sequence[str],
    where: Callable[[int], str],
) -> GroundPoints:
    seen: dict[str, int] = {}
    check = np.zeros(len(names), bool)
    for k, (name, role) in enumerate(zip(names, roles)):
        if name in seen:
            raise InputError(f"{where(k)}: ground point {name!r} is given twice; keep one of them")
        seen[name] = k
        if role.strip().casefold() not in _CHECK:
            raise InputError(f"{where(k)}: role {role[:40]!r} of ground point {name!r}; allowed are control and check")
        check[k] = _CHECK[role.strip().casefold()]
        known = np.isfinite(XYZ[k])
        odd = odd_place(XYZ[k].tolist(), camera=False)
        if odd is not None:
            raise InputError(f"{where(k)}: ground point {name!r}: {odd}")
        if known[0] != known[1] or not known.any():
            raise InputError(
                f"{where(k)}: ground point {name!r} has {'X' if known[0] else 'Y' if known[1] else 'nothing'} alone; "
                "give X, Y and Z, or X and Y, or Z"
            )
    both, plane, x, y, z = (numbers(role) for role in _SIGMAS)
    sigma = np.stack([_first(x, plane, both), _first(y, plane, both), _first(z, both)], axis=1)
    bad = np.flatnonzero((sigma < 0).any(axis=1))
    if len(bad):
        k = int(bad[0])
        raise InputError(
            f"{where(k)}: standard deviation of ground point {names[k]!r} is {np.nanmin(sigma[k]):g} m; give 0 (fixed) "
            "or more"
        )
    return GroundPoints(tuple(names), XYZ, sigma, check)


def _first(*columns: Floats) -> Floats:
    """The first of several columns that has a value, row by row."""
    out = columns[0]
    for column in columns[1:]:
        out = np.where(np.isnan(out), column, out)
    return out


def _in_metres(path: Path, XYZ: Floats, own: MetricSystem | None, wanted: str | None, heights: str | None) -> Floats:
    """Coordinates in metres, heights in the wanted system; a CRS other than the wanted one is refused."""
    if own is None:
        return XYZ
    if wanted is not None and not same_crs(own.crs, wanted):
        raise InputError(
            f"{path}: ground points in {crs_label(own.crs)}, the project is in {crs_label(wanted)}; transform them"
        )
    return heights_in(own.to_metres(XYZ, f"{path}: heights"), own.crs, own.heights, heights, str(path))


def _from_layer(path: Path, crs: str | None, heights: str | None) -> GroundPoints:
    path = check_plain_file(path, "ground points")
    found = read_layer(path)
    shapes = found.shapes

    def where(k: int) -> str:
        return f"{path}: feature {k + 1}"

    if not len(shapes):
        raise InputError(f"{path}: holds no point")
    for k, shape in enumerate(shapes):
        if shape is None or shape.geom_type != "Point" or shape.is_empty:
            kind = "without geometry" if shape is None or shape.is_empty else f"a {shape.geom_type}"
            raise InputError(f"{where(k)} is {kind}; ground points are single points")
    fields = {name.casefold(): values for name, values in found.fields.items()}
    own = next((fields[n] for n in _ROLES["name"] if n in fields), None)
    if own is None:
        raise InputError(f"{path}: no field with names; one called {' or '.join(_ROLES['name'])} is needed")
    names = [_text(v) for v in own]
    if not all(names):
        raise InputError(f"{where(names.index(''))} has no name; give it one")
    XYZ = np.stack([shapely.get_x(shapes), shapely.get_y(shapes), shapely.get_z(shapes)], axis=1)
    own_system = None if found.crs is None else metric_system(found.crs, f"{path}: CRS")
    XYZ = _in_metres(path, XYZ, own_system, crs, heights)

    def numbers(role: str) -> Floats:
        column = next((fields[n] for n in _ROLES[role] if n in fields), None)
        return np.full(len(names), np.nan) if column is None else _floats(path, role, column)

    roles = next((fields[n] for n in _ROLES["role"] if n in fields), [""] * len(names))
    return _points(names, XYZ, numbers, [_text(v) for v in roles], where)


def _text(value: Any) -> str:
    return "" if value is None or value != value else str(value).strip()


def _floats(path: Path, role: str, column: NDArray[Any]) -> Floats:
    try:
        return np.asarray(column, float)
    except (TypeError, ValueError):
        raise InputError(f"{path}: field {role} does not hold numbers; make it a field of numbers") from None


def write_ground_points(path: Path, points: GroundPoints) -> None:
    """Write ground points as a table with header; it appears complete or not at all."""
    rows = []
    for k, name in enumerate(points.names):
        numbers = ["" if np.isnan(v) else f"{v:.4f}" for v in points.XYZ[k]]
        numbers += ["" if np.isnan(v) else f"{v:.6g}" for v in points.sigma[k]]
        rows.append([name, *numbers, "check" if points.check[k] else "control"])
    write_table(path, [*_NEEDED, "sigma_x", "sigma_y", "sigma_z", "role"], rows)


_ROLES_IMAGE_POINTS = {
    "point": ("point", "name", "point_id", "id", "gcp", "track"),
    "image": ("image", "photo", "file", "filename", "image_name", "cliche"),
    "x": ("x", "column", "col", "x_px", "column_px"),
    "y": ("y", "row", "line", "y_px", "row_px"),
    "sigma": ("sigma", "sigma_px"),
    "sigma_x": ("sigma_x", "sigma_col", "sigma_column"),
    "sigma_y": ("sigma_y", "sigma_row", "sigma_line"),
}
_NEEDED_IMAGE_POINTS = ("point", "image", "x", "y")
_COLUMNS = Columns(
    roles=_ROLES_IMAGE_POINTS,
    needed=_NEEDED_IMAGE_POINTS,
    orders=(_NEEDED_IMAGE_POINTS, (*_NEEDED_IMAGE_POINTS, "sigma"), (*_NEEDED_IMAGE_POINTS, "sigma_x", "sigma_y")),
)


#: Part of the measurements that may be of a point in an image in which it is measured once more.
_FEW = 0.02


def read_image_points(
    path: Path, *, columns: str | None = None, decimal_comma: bool = False, doubtful: list[str] | None = None
) -> ImagePoints:
    """Measured image points of a table."""
    table = read_table(Path(path), _COLUMNS, Dialect(columns, decimal_comma=decimal_comma))
    points, images = table.names("point"), table.names("image")
    spelled = same_images(images)
    point_at = {name: k for k, name in enumerate(dict.fromkeys(points))}
    image_at = {name: k for k, name in enumerate(dict.fromkeys(spelled.values()))}
    image = np.array([image_at[spelled[name]] for name in images], np.int64)
    point = np.array([point_at[name] for name in points], np.int64)
    found = table.numbers("x", "y"), _sigma(table)
    keep = _once(table, image * len(point_at) + point, (points, images), doubtful)
    return ImagePoints(
        images=tuple(image_at),
        points=tuple(point_at),
        image=image[keep],
        point=point[keep],
        xy=found[0][keep],
        sigma=found[1][keep],
    )


def _sigma(table: TextTable) -> np.ndarray:
    sigma = np.stack([table.first_known(role, "sigma") for role in ("sigma_x", "sigma_y")], axis=1)
    bad = np.flatnonzero((sigma <= 0).any(axis=1))
    if len(bad):
        k = int(bad[0])
        raise InputError(f"{table.where(k)}: standard deviation {sigma[k].tolist()} px; it must be positive")
    return sigma


def _once(
    table: TextTable, key: np.ndarray, names: tuple[Sequence[str], Sequence[str]], doubtful: list[str] | None
) -> np.ndarray:
    """Measurements of a point in an image that are the only ones, (n,): of several nothing says which is right."""
    _, of, count = np.unique(key, return_inverse=True, return_counts=True)
    twice = np.asarray(count[of.reshape(-1)] > 1)
    if twice.any():
        first, second = np.flatnonzero(key == key[np.flatnonzero(twice)[0]])[:2]
        what = (
            f"{table.where(second)}: point {names[0][second]!r} is measured in image {names[1][second]!r} in line "
            f"{table.lines[first]} already"
        )
        if doubtful is None or twice.sum() > max(2.0, _FEW * len(key)) or len(key) < 20:
            raise InputError(f"{what}; keep one of the measurements")
        doubtful.append(f"{what}; {int(twice.sum())} such measurements take no part, as nothing says which is right")
    return ~twice


def named_as(points: ImagePoints, names: Sequence[str]) -> tuple[ImagePoints, tuple[str, ...]]:
    """The measurements with the images' names written as in `names`, and the images that are not among these.

    See `photoplan.io.files.ImageNames`. Images that are not known keep their name.
    """
    try:
        found = ImageNames(names).match(points.images)
    except InputError as error:
        raise InputError(f"image points: {error}") from None
    # An image that is not known must not take the name of one that is.
    taken = set(names)
    renamed = [
        known or (f"{image} (unknown)" if image in taken else image) for known, image in zip(found, points.images)
    ]
    unknown = tuple(image for known, image in zip(found, points.images) if known is None)
    return ImagePoints(
        images=tuple(renamed),
        points=points.points,
        image=points.image,
        point=points.point,
        xy=points.xy,
        sigma=points.sigma,
    ), unknown


def write_image_points(path: Path, points: ImagePoints) -> None:
    """Write measurements as a table with header; it appears complete or not at all.

    Standard deviations are written where one is known.
    """
    stated = bool(np.isfinite(points.sigma).any())
    rows = []
    for k in range(len(points)):
        row = [points.points[points.point[k]], points.images[points.image[k]], *(f"{v:.10g}" for v in points.xy[k])]
        if stated:
            row += ["" if np.isnan(v) else f"{v:.6g}" for v in points.sigma[k]]
        rows.append(row)
    write_table(path, [*_NEEDED_IMAGE_POINTS, *(("sigma_x", "sigma_y") if stated else ())], rows)


MAX_BYTES = 100_000_000
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.I)


@dataclass(frozen=True, eq=False)
class GcpList:
    """Content of a list of ground control points."""

    crs: str
    """Horizontal CRS of the ground points."""
    ground: GroundPoints
    """All as control; standard deviations are not stated."""
    points: ImagePoints
    """Their measurements."""


@dataclass(frozen=True)
class _Line:
    number: int
    XYZ: tuple[float, float, float]
    xy: tuple[float, float]
    image: str
    name: str | None


def read_gcp_list(path: Path, crs: str | None = None, height_system: str | None = None) -> GcpList:
    """Control and its measurements."""
    path = Path(path)
    lines = [(n, text.strip()) for n, text in enumerate(read_text(path, MAX_BYTES).split("\n"), 1) if text.strip()]
    if not lines:
        raise InputError(f"{path}: holds no line with data")
    system = metric_system(_crs(f"{path}:{lines[0][0]}", lines[0][1]))
    own = system.crs
    rows = [_line(path, line, text) for line, text in lines[1:] if not text.startswith("#")]
    if not rows:
        raise InputError(f"{path}: holds a CRS and no measurement")
    names = _names(rows)
    places: dict[str, _Line] = {}
    measured: dict[tuple[str, str], int] = {}
    try:
        spelled = same_images(row.image for row in rows)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    for row, name in zip(rows, names):
        first = places.setdefault(name, row)
        if not np.array_equal(first.XYZ, row.XYZ, equal_nan=True):
            raise InputError(f"{path}:{row.number}: point {name!r} has other coordinates than in line {first.number}")
        at = measured.setdefault((name, spelled[row.image]), row.number)
        if at != row.number:
            raise InputError(
                f"{path}:{row.number}: point {name!r} is measured in image {row.image!r} in line {at} already; keep "
                "one of the measurements"
            )
    XYZ = system.to_metres(np.array([row.XYZ for row in places.values()], float), f"{path}: heights")
    XYZ = heights_in(XYZ, own, system.heights, height_system, str(path))
    if crs is not None and not same_crs(own, crs):
        with named_by(path):
            XYZ[:, :2] = crs_step(own, crs)(XYZ[:, :2])
        own = crs
    elif parse_crs(own).is_geographic:
        raise InputError(
            f"{path}: points are geographic ({crs_label(own)}); say which projected CRS they are wanted in"
        )
    ground = GroundPoints(tuple(places), XYZ, np.full((len(places), 3), np.nan), np.zeros(len(places), bool))
    table = [(name, spelled[row.image], *row.xy) for row, name in zip(rows, names)]
    return GcpList(own, ground, ImagePoints.from_rows(table))


def _crs(where: str, text: str) -> str:
    utm = _UTM.fullmatch(text)
    if utm:
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise InputError(f"{where}: UTM zone {zone}; zones are 1 to 60")
        return f"EPSG:{32600 + zone + 100 * (utm[2].upper() == 'S')}"
    if len(text.split()) >= 6 and sum(bool(NUMBER.fullmatch(word)) for word in text.split()[:5]) == 5:
        raise InputError(f"{where}: the first line is a measurement; it must state the CRS, such as EPSG:32632")
    parse_crs(text, where)
    return text


def _line(path: Path, line: int, text: str) -> _Line:
    words = text.split()
    if len(words) < 6:
        raise InputError(f"{path}:{line}: {len(words)} words; X Y Z column row image are needed")
    values = []
    for what, word in zip(("X", "Y", "Z", "column", "row"), words):
        if what == "Z" and word.casefold() == "nan":
            values.append(np.nan)
            continue
        values.append(number(word, f"{path}:{line}: {what}"))
    X, Y, Z, col, row = values
    return _Line(number=line, XYZ=(X, Y, Z), xy=(col, row), image=words[5], name=words[6] if len(words) > 6 else None)


def _names(rows: list[_Line]) -> list[str]:
    """Names of the points; those without one are called after the order of their places."""
    places: dict[tuple[str, ...], str] = {}
    taken = {row.name for row in rows}
    out = []
    for row in rows:
        if row.name is not None:
            out.append(row.name)
            continue
        key = tuple(repr(v) for v in row.XYZ)
        if key not in places:
            count = len(places) + 1
            while f"gcp_{count}" in taken:
                count += 1
            places[key] = f"gcp_{count}"
            taken.add(places[key])
        out.append(places[key])
    return out


def is_gcp_list(path: Path) -> bool:
    """Return whether a text file begins with a CRS, as these files do and tables do not."""
    if path.suffix.lower() != ".txt":
        return False
    try:
        with path.open("rb") as file:
            first = file.read(1000).decode("utf-8-sig", errors="replace").lstrip().split("\n")[0].strip()
    except OSError:
        return False
    return bool(_UTM.fullmatch(first) or re.match(r"EPSG:\d+(\+\d+)?$|\+proj=", first, re.I))


_ROLES_OBSERVED_POSITIONS = {
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
_TEXTS = (".csv", ".txt", ".tsv", ".dat", ".opk")


@dataclass(frozen=True, eq=False)
class PositionTable:
    """Observed positions and attitudes of a file, as it states them."""

    path: Path
    images: tuple[str, ...]
    XYZ: Floats
    """Shape (n, 3), metres."""
    sigma: Floats
    """Standard deviations, shape (n, 3), metres; NaN: not stated."""
    R_ground_camera: Floats | None
    """Shape (n, 3, 3); None: the file has no attitudes."""
    sigma_angle: Floats
    """Standard deviation of each attitude, shape (n,), radians; NaN: not stated."""
    strip: tuple[str, ...]
    """Name of each image's strip; ``"all"`` where the file states none."""
    time: Floats
    """Seconds; the running number of the line where the file states none."""
    notes: tuple[str, ...] = ()
    """Remarks on rows that were left out."""

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
        path,
        Columns(roles=_ROLES_OBSERVED_POSITIONS, needed=_NEEDED),
        Dialect(columns, form.delimiter, form.decimal_comma),
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
        sigma=_sigma_observed_positions(table),
        R_ground_camera=_rotations(table, form),
        sigma_angle=sigma_angle,
        strip=strips,
        time=_times(table),
    )


def _sigma_observed_positions(table: TextTable) -> Floats:
    out = []
    for roles in (("sigma_x", "sigma_xy", "sigma"), ("sigma_y", "sigma_xy", "sigma"), ("sigma_z", "sigma")):
        out.append(table.first_known(*roles))
        _positive(table, roles[0], out[-1])
    return np.stack(out, axis=1)


def _positive(table: TextTable, role: str, values: Floats) -> None:
    bad = np.flatnonzero(values <= 0)
    if len(bad):
        raise InputError(f"{table.where(int(bad[0]))}: {role} = {values[bad[0]]:g}; it must be positive")


def _rotations(table: TextTable, form: TableFormat) -> Floats | None:
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


def _times(table: TextTable) -> Floats:
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
    folder = read_image_folder(path)
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


CLOUD_SUFFIXES = (".las", ".laz", ".ply")
#: What a point has: metres, standard deviation of z in metres, grey value.
_POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("sigma", "<f4"), ("grey", "<f4")])
#: Rows of posts that are read at once; the unit of coordinates in LAS, part of the distance of the posts.
_ROWS, _UNIT = 256, 1e-3
#: Where day and year of making are in the header of LAS, two bytes each.
_LAS_DATE = 90


def check_cloud(path: Path) -> None:
    """Refuse a name that says no format, or a format whose library is missing."""
    kind = path.suffix.lower()
    if kind not in CLOUD_SUFFIXES:
        raise UsageError(f"{path}: {kind or 'no suffix'}; points are written by suffix: {', '.join(CLOUD_SUFFIXES)}")
    if kind != ".ply" and importlib.util.find_spec("laspy") is None:
        raise UsageError(
            f"{path}: LAS and LAZ need laspy; install it with `pip install 'photoplan[points]'`, or say .ply"
        )


def write_cloud(path: Path, heights: Path, sigmas: Path, grey: Path, crs: str, frame: Frame | None = None) -> int:
    """Write the posts of a surface that have a height."""
    write = _write_ply if path.suffix.lower() == ".ply" else _write_las
    try:
        with ExitStack() as opened:
            part = opened.enter_context(scratch(path.parent)) / path.name
            files = [opened.enter_context(open_raster(standing(file), "GTiff")) for file in (heights, sigmas, grey)]
            count = write(part, path, files, crs, frame)
            give_name(part, path)
    except OSError as error:
        raise disk_error(path, error) from error
    return count


def _surface_points(files: Sequence[Any], frame: Frame | None) -> Iterator[NDArray[Any]]:
    """Points by rows of posts."""
    heights, sigmas, grey = files
    finer = grey.width // heights.width
    for row in range(0, heights.height, _ROWS):
        count = min(_ROWS, heights.height - row)
        window = rasterio.windows.Window(0, row, heights.width, count)
        z = heights.read(1, window=window)
        fine = rasterio.windows.Window(0, finer * row, grey.width, finer * count)
        means = grey.read(1, window=fine).reshape(count, finer, heights.width, finer).mean(axis=(1, 3))
        j, i = np.nonzero(np.isfinite(z))
        out = np.empty(len(i), _POINT)
        out["x"], out["y"] = heights.transform @ (i + 0.5, row + j + 0.5)
        out["z"], out["sigma"], out["grey"] = z[j, i], sigmas.read(1, window=window)[j, i], means[j, i]
        yield out if frame is None else _on_ground(out, frame)


def _on_ground(points: NDArray[Any], frame: Frame) -> NDArray[Any]:
    """Points of a frame on the ground, and standard deviations there; without those that it does not have."""
    uvh = np.stack([points[axis] for axis in "xyz"], axis=-1)
    out = points.copy()
    out["x"], out["y"], out["z"] = frame(uvh).T
    out["sigma"] *= np.linalg.norm(frame.jacobian(uvh)[..., 2], axis=-1)
    return np.asarray(out[np.isfinite(out["z"])])


def _write_ply(part: Path, path: Path, files: Sequence[Any], crs: str, frame: Frame | None) -> int:
    count = 0
    with part.open("wb") as file:
        # The count is known at the end: room is left for it.
        file.write(_ply_header(0, frame))
        for points in _surface_points(files, frame):
            file.write(points.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_ply_header(count, frame))
    return count


def _ply_header(count: int, frame: Frame | None) -> bytes:
    kinds = {"<f8": "double", "<f4": "float"}
    along = "Z" if frame is None else "the height over the target"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment photoplan {__version__}; X east, Y north, Z up, sigma of {along}, metres; grey value",
        f"element vertex {count:012d}",
        *(f"property {kinds[_POINT[name].str]} {name}" for name in _POINT.names or ()),
        "end_header",
    ]
    return "\n".join([*lines, ""]).encode()


def _write_las(part: Path, path: Path, files: Sequence[Any], crs: str, frame: Frame | None) -> int:
    import laspy  # type: ignore[import-untyped]  # noqa: PLC0415  # an optional package

    left, bottom, *_ = files[0].bounds
    if frame is not None:
        left, bottom, _ = frame((left, bottom, 0.0)).tolist()
    unit = 10.0 ** np.floor(np.log10(_UNIT * files[0].res[0]) + 1e-9)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, unit), np.array([np.floor(left), np.floor(bottom), 0.0])
    header.generating_software = f"photoplan {__version__}"[:32]
    header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.float32, "of the height, metres"))
    header.add_crs(parse_crs(crs))
    count = 0
    with laspy.open(part, mode="w", header=header, do_compress=path.suffix.lower() == ".laz") as file:
        for points in _surface_points(files, frame):
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points["x"], points["y"], points["z"]
            record.intensity = np.clip(np.rint(points["grey"]), 0, 65535).astype(np.uint16)
            record["sigma"] = points["sigma"]
            record.return_number[:] = record.number_of_returns[:] = 1
            file.write_points(record)
            count += len(points)
    # Equal runs give equal files: laspy states the day of making, zeros that none is stated.
    with part.open("r+b") as written:
        written.seek(_LAS_DATE)
        written.write(bytes(4))
    return count

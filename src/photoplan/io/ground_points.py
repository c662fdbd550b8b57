"""Ground points — control and check — in text tables and GeoPackages.

A table names its columns in the first line: name, x, y, z, then as far as known sigma or sigma_xy and sigma_z or
sigma_x, sigma_y and sigma_z (metres), and role (control or check). An empty z makes horizontal control, empty x and y
make height control. Files without a header, such as the .app files of the French mapping agency (name, class, X, Y, Z),
are read with declared columns: ``"name,-,x,y,z"``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints
from photoplan.errors import InputError
from photoplan.geometry.bounds import odd_place
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.heights import heights_in
from photoplan.geometry.units import MetricSystem, metric_system
from photoplan.io.checks import check_plain_file
from photoplan.io.plain_files import crs_beside
from photoplan.io.tables import Columns, Dialect, read_table, write_table
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
    XYZ: NDArray[np.float64],
    numbers: Callable[[str], NDArray[np.float64]],
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


def _first(*columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The first of several columns that has a value, row by row."""
    out = columns[0]
    for column in columns[1:]:
        out = np.where(np.isnan(out), column, out)
    return out


def _in_metres(
    path: Path, XYZ: NDArray[np.float64], own: MetricSystem | None, wanted: str | None, heights: str | None
) -> NDArray[np.float64]:
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

    def numbers(role: str) -> NDArray[np.float64]:
        column = next((fields[n] for n in _ROLES[role] if n in fields), None)
        return np.full(len(names), np.nan) if column is None else _floats(path, role, column)

    roles = next((fields[n] for n in _ROLES["role"] if n in fields), [""] * len(names))
    return _points(names, XYZ, numbers, [_text(v) for v in roles], where)


def _text(value: Any) -> str:
    return "" if value is None or value != value else str(value).strip()


def _floats(path: Path, role: str, column: NDArray[Any]) -> NDArray[np.float64]:
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

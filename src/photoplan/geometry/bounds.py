"""Numbers that are finite and still cannot be meant: angles, places and heights, judged in one place.

Files, tables and options all ask here, so that what is refused in one is refused in the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Transformer

from photoplan.geometry.crs import crs_label, parse_crs
from photoplan.geometry.rotation import ANGLE_UNITS

#: Map coordinates beyond this lie on no map of the earth, metres.
_FAR = 1e8
#: Heights of anything that is photographed, and of cameras, metres: from ocean trenches to low orbits.
_LOW, MOST_HEIGHT, _ORBIT = -12_000.0, 10_000.0, 1_000_000.0
#: Frame cameras fly lower than this above ground, metres; what is higher is in another unit.
HIGHEST_FLIGHT = 60_000.0
#: How far beyond the area of use of its CRS a place may lie, degrees: neighbouring zones are in use.
_BESIDE = 12.0


def odd_angles(angles: Sequence[float], unit: str, names: Sequence[str] = ()) -> str | None:
    """Why angles cannot be meant; None if they can. One full circle either way is allowed."""
    circle = ANGLE_UNITS[unit]
    worst = max(angles, key=abs, default=0.0)
    name = f"{names[list(angles).index(worst)]} = " if names else ""
    if abs(worst) <= circle * (1 + 1e-9):
        return None
    others = [name for name, full in ANGLE_UNITS.items() if name != unit and abs(worst) <= full]
    fits = f"; is it in {' or '.join(others)}?" if others else ""
    return f"angle {name}{worst:g} is more than a full circle in {unit}{fits}"


def odd_place(XYZ: Sequence[float], *, camera: bool) -> str | None:
    """Why a place (metres; NaN: not known) cannot be that of a camera or a ground point; None if it can."""
    x, y, z = XYZ
    for axis, value in (("X", x), ("Y", y)):
        if abs(value) > _FAR:
            return f"{axis} = {value:g} m lies on no map; are coordinates in millimetres or centimetres?"
    high = _ORBIT if camera else MOST_HEIGHT
    if z < _LOW or z > high:
        return f"Z = {z:g} m; heights lie between {_LOW:g} and {high:g} m: is it in millimetres, or another coordinate?"
    return None


def outside_area(crs: str, XY: ArrayLike) -> NDArray[np.bool_]:
    """Which places (n, 2) lie far outside the area in which a CRS is used, (n,); none where it states no area."""
    XY = np.asarray(XY, float).reshape(-1, 2)
    parsed = parse_crs(crs)
    area = parsed.area_of_use
    if area is None or parsed.geodetic_crs is None:
        return np.zeros(len(XY), bool)
    lon, lat = Transformer.from_crs(parsed, parsed.geodetic_crs, always_xy=True).transform(XY[:, 0], XY[:, 1])
    lon, lat = np.asarray(lon, float), np.asarray(lat, float)
    east = (area.east - area.west) % 360.0
    off = (lon - area.west + _BESIDE) % 360.0 > east + 2 * _BESIDE if east + 2 * _BESIDE < 360.0 else lon != lon
    return np.asarray(off | (lat < area.south - _BESIDE) | (lat > area.north + _BESIDE) | ~np.isfinite(lon + lat))


def area_fault(crs: str, center: ArrayLike) -> str | None:
    """Why a place cannot be in a CRS; None if it can."""
    if not outside_area(crs, np.asarray(center, float)[:2]).any():
        return None
    area = parse_crs(crs).area_of_use
    x, y = np.asarray(center, float)[:2]
    return (
        f"X {x:.0f}, Y {y:.0f} lies far outside the area of {crs_label(crs)} ({area.name[:60] if area else ''}); is it "
        "the right CRS, and are X and Y in the right order?"
    )

"""Plausibility of numbers: angles, positions and heights that are finite but cannot be right.

Files, tables and options all ask here, so that what is refused in one is refused in the others.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from photoplan.geometry.crs import crs_label, fitting_utm, nearest_turn, parse_crs, utm_codes
from photoplan.geometry.pose import ANGLE_UNITS

#: Map coordinates beyond this lie on no map of the earth, metres.
_FAR = 1e8
#: Heights of anything that is photographed, and of cameras, metres: from ocean trenches to low orbits.
_LOW, MOST_HEIGHT, _ORBIT = -12_000.0, 10_000.0, 1_000_000.0
#: Frame cameras fly lower than this above ground, metres; what is higher is in another unit.
HIGHEST_FLIGHT = 60_000.0
_KM_PER_DEGREE = 111.2
#: How far beyond the area of use of its CRS a place may lie, kilometres: neighbouring zones are in use; and how far
#: without a word: maps are used a little past their borders.
_BESIDE, _NOTED = 900.0, 100.0
#: What allows places beyond that.
FORCE = "beyond_area = true in the project (init, convert, dtm build: `beyond_area`)"


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


def beyond_area(crs: str, XY: ArrayLike) -> NDArray[np.float64]:
    """Kilometres by which places (n, 2) lie beyond the area of use of a CRS, (n,).

    0 inside, and if it states no area; infinite for places that the CRS does not have.
    """
    XY = np.asarray(XY, float)[..., :2].reshape(-1, 2)
    parsed = parse_crs(crs)
    area = _area_of_use(parsed)
    if area is None or parsed.geodetic_crs is None:
        return np.zeros(len(XY))
    west, south, east, north = area
    lon, lat = _geographic(parsed, XY)
    wide = (east - west) % 360.0 or 360.0
    # From the middle of the area, whichever way round the earth is shorter.
    from_middle = np.abs(nearest_turn(lon, west + wide / 2, 360.0) - (west + wide / 2))
    with np.errstate(invalid="ignore"):  # infinite where the CRS does not have the place
        beside = (from_middle - wide / 2) * np.cos(np.radians(lat))
        beyond = np.maximum.reduce([beside, south - lat, lat - north, np.zeros(len(XY))]) * _KM_PER_DEGREE
        return np.asarray(np.where(np.isfinite(lon + lat), beyond, np.inf))


def _geographic(crs: CRS, XY: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Longitude from Greenwich and latitude of map points (n, 2), degrees."""
    assert crs.geodetic_crs is not None
    meridian = crs.geodetic_crs.prime_meridian
    first = 0.0 if meridian is None else np.degrees(meridian.longitude * float(meridian.unit_conversion_factor))
    lon, lat = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(XY[:, 0], XY[:, 1])
    unit = np.degrees(crs.geodetic_crs.axis_info[0].unit_conversion_factor)
    return np.asarray(lon, float) * unit + first, np.asarray(lat, float) * unit


def _area_of_use(crs: CRS) -> tuple[float, float, float, float] | None:
    """West, south, east and north of a CRS's area of use, degrees; that of a UTM zone also if it has no code."""
    if crs.area_of_use is not None:
        area = crs.area_of_use
        return area.west, area.south, area.east, area.north
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        stated = crs.to_dict()
    if stated.get("proj") != "utm":
        return None
    east = 6.0 * int(stated["zone"]) - 180.0
    return east - 6.0, *((-80.0, east, 0.0) if "south" in stated else (0.0, east, 84.0))


def area_fault(crs: str, XY: ArrayLike, names: Sequence[str] = ()) -> str | None:
    """Why places (n, 2 or more columns) cannot be in a CRS; None if they can. `names` are those of the places."""
    return _told(crs, XY, names, _BESIDE, "; is it the right CRS, and are X and Y in the right order? If it is meant, "
                 f"{FORCE} allows it")  # fmt: skip


def area_note(crs: str, XY: ArrayLike, names: Sequence[str] = ()) -> str | None:
    """A sentence on places that lie beyond the area of a CRS, but not so far that `area_fault` refuses them."""
    return _told(crs, XY, names, _NOTED, "; is that the CRS of these coordinates?")


def _told(crs: str, XY: ArrayLike, names: Sequence[str], most: float, asks: str) -> str | None:
    XY = np.asarray(XY, float)[..., :2].reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(XY).all(axis=1))
    beyond = beyond_area(crs, XY[known])
    if not (beyond > most).any():
        return None
    worst = int(known[np.argmax(beyond)])
    x, y = XY[worst]
    parsed = parse_crs(crs)
    what = f"{names[worst]!r} at X {x:.0f}, Y {y:.0f}" if len(names) else f"X {x:.0f}, Y {y:.0f}"
    count = int((beyond > most).sum())
    what = what if len(known) == 1 else f"{what} ({count} of {len(known)} places)"
    area = parsed.area_of_use
    of = f"{crs_label(crs)} ({area.name[:60]})" if area is not None else crs_label(crs)
    lon, lat = (float(v[0]) for v in _geographic(parsed, XY[worst : worst + 1]))
    readings = [("are X and Y exchanged? Exchanged they lie inside", XY[known][:, ::-1])]
    zone = (parsed.utm_zone or "")[:-1]
    if zone and (XY[known, 0] // 1e6 == int(zone)).all():
        begins = f"does X begin with {zone}, the number of the zone? Without it they lie inside"
        readings.append((begins, XY[known] % (1e6, np.inf)))
    if np.abs(XY[known]).max() >= 1e7:
        readings.append(("are they millimetres? In metres they lie inside", XY[known] / 1e3))
    likely = next((text for text, meant in readings if not (beyond_area(crs, meant) > _NOTED).any()), None)
    if not np.isfinite(lon + lat):
        return f"{what} has no place in {of}{asks if likely is None else f'; {likely}'}"
    fits = f"; {fitting_utm(crs, lat, lon)} fits there"
    if likely is not None:
        fits, asks = f"; {likely}", ""
    return (
        f"{what} lies {beyond.max():.0f} km outside the area of {of}, at latitude {lat:.4f}°, longitude {lon:.4f}°"
        f"{fits}{asks}"
    )


def is_no_fix(latitude: float, longitude: float) -> bool:
    """Return whether a latitude and a longitude are what receivers without a position write: both exactly 0."""
    return latitude == 0.0 and longitude == 0.0


#: Bounds that are wider than what they should meet by this in both directions may be in another order.
_WIDE = 10.0
Bounds = tuple[float, float, float, float]
#: Orders in which four numbers of bounds are written elsewhere: places of xmin, ymin, xmax, ymax among them.
_ORDERS = {
    "xmin xmax ymin ymax": (0, 2, 1, 3),
    "xmin ymax xmax ymin": (0, 3, 2, 1),
    "xmax ymax xmin ymin": (2, 3, 0, 1),
    "xmax ymin xmin ymax": (2, 1, 0, 3),
    "ymin xmin ymax xmax": (1, 0, 3, 2),
    "ymin ymax xmin xmax": (2, 0, 3, 1),
    "ymax xmin ymin xmax": (1, 2, 3, 0),
}


def bounds_fault(bounds: Sequence[float], crs: str | None = None, covered: Bounds | None = None) -> str | None:
    """Why bounds xmin, ymin, xmax, ymax cannot be meant, with what is probably meant; None if they can."""
    try:
        given = tuple(float(value) for value in bounds) if not isinstance(bounds, str) else ()
    except (TypeError, ValueError):
        given = ()
    if len(given) != 4:
        return f"bounds {str(bounds)[:80]}; needed are four numbers, xmin ymin xmax ymax"
    told = "bounds " + bounds_text(given)
    if not np.isfinite(given).all():
        return f"{told}; needed are xmin ymin xmax ymax, finite numbers"
    if max(map(abs, given)) > _FAR:
        return f"{told}; beyond {_FAR:g} m there is no map"
    ordered = given[0] < given[2] and given[1] < given[3]
    wide = covered is not None and min(_extent(given) / _extent(covered)) > _WIDE
    if ordered and (covered is None or (_meet(given, covered) and not wide)):
        return None
    needed = f"{told}; needed are xmin ymin xmax ymax with xmin < xmax and ymin < ymax"
    likely = []
    for name, order in _ORDERS.items():
        b = tuple(given[k] for k in order)
        size = _extent(b)
        if (size > 0).all() and (covered is None or (_meet(b, covered) and (size / _extent(covered)).max() <= _WIDE)):
            likely.append((float(size.prod()), name, bounds_text(b)))
    if likely:
        _, name, b_text = min(likely)
        return f"{needed}. Given are probably {name}, so {b_text} is meant"
    if not ordered:
        return needed
    assert covered is not None
    if _meet(given, covered):
        return None
    there = None if crs is None else _bounds_elsewhere((given[0], given[1], given[2], given[3]), crs, covered)
    if there is None:
        return None
    return f"{told} are in {there[0]}; needed is {crs_label(crs or '')}: {bounds_text(there[1])}"


def _extent(bounds: Sequence[float]) -> NDArray[np.float64]:
    return np.array([bounds[2] - bounds[0], bounds[3] - bounds[1]])


def bounds_text(bounds: Sequence[float]) -> str:
    """Bounds as they are given to options."""
    return " ".join(f"{value:.10g}" for value in bounds)


def _meet(a: Sequence[float], b: Sequence[float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _bounds_elsewhere(given: Bounds, crs: str, covered: Bounds) -> tuple[str, Bounds] | None:
    """The CRS in which bounds meet others, and what they are in the CRS of these: degrees, Web Mercator, UTM."""
    here = parse_crs(crs)
    if here.geodetic_crs is None:
        return None
    lon, lat = (float(v[0]) for v in _geographic(here, np.array([[(covered[0] + covered[2]) / 2,
                                                                  (covered[1] + covered[3]) / 2]])))  # fmt: skip
    if not np.isfinite(lon + lat):
        return None
    others = {"longitudes and latitudes (EPSG:4326)": "EPSG:4326", "latitudes and longitudes (EPSG:4326)": "EPSG:4326"}
    others |= {code: code for code in ("EPSG:3857", *utm_codes(lat, lon)) if code != crs}
    for name, other in others.items():
        b = (given[1], given[0], given[3], given[2]) if name.startswith("latitudes") else given
        if other == "EPSG:4326" and not (max(abs(b[0]), abs(b[2])) <= 360 and max(abs(b[1]), abs(b[3])) <= 90):
            continue
        try:
            found = Transformer.from_crs(other, here, always_xy=True).transform_bounds(b[0], b[1], b[2], b[3])
        except ProjError:
            continue
        if np.isfinite(found).all() and _meet(found, covered) and max(_extent(found) / _extent(covered)) < _WIDE**2:
            return name, tuple(round(float(value), 3) for value in found)  # type: ignore[return-value]
    return None

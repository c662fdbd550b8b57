"""Coordinate reference systems: axis order (always X east, Y north), transformation, agreement of two systems."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from photoplan.errors import InputError

#: A hundredth of a degree, radians.
_HUNDREDTH = np.pi / 180.0 / 100.0


@lru_cache(maxsize=256)
def parse_crs(text: str, where: str = "CRS") -> CRS:
    """CRS of a string: `EPSG:…`, WKT, or a PROJ string. `where` names it in messages."""
    try:
        crs = CRS.from_user_input(text.strip())
        why = "" if text.strip()[:5].upper() == "EPSG:" else _unusable(crs)
    except (CRSError, ValueError) as error:  # a text may hold bytes that are no text
        why = str(error).split(":")[-1].strip(" )") or "unknown"
    if why:
        raise InputError(
            f"{where}: {text[:120]!r} is not a coordinate reference system ({why}); "
            "give EPSG:nnnn, WKT or a PROJ string"
        )
    return crs


#: A map's metre on the ground: units are converted, projections stretch.
_SCALES = 0.1, 10.0
#: The inverse of a projection undoes it to this, metres (PROJ's LAEA on the earth: tenths of a millimetre).
INVERTED = 1e-3
#: Units of angles, radians: from milliarcseconds to full turns.
_ANGLES = 1e-9, 7.0
#: Radii of bodies that ellipsoids describe, from Phobos to Jupiter, metres; those of planets in kilometres are not.
_RADII = 1e4, 1e8


def _unusable(crs: CRS) -> str:
    """Why a projected CRS describes no map, though it is well formed: numbers may have any size in WKT; else empty."""
    angles = [] if crs.geodetic_crs is None or crs.geodetic_crs.is_geocentric else crs.geodetic_crs.axis_info[:1]
    if not all(_ANGLES[0] < axis.unit_conversion_factor < _ANGLES[1] for axis in angles):
        return f"a unit of angles of {angles[0].unit_conversion_factor:g} rad"
    if not crs.is_projected:
        return ""
    radius = 6378137.0 if crs.ellipsoid is None else crs.ellipsoid.semi_major_metre
    if not _RADII[0] < radius < _RADII[1]:
        return f"a body of radius {radius / 1000:g} km"
    try:
        usable = np.isfinite(_axes_on_ground(crs)).all(axis=(1, 2)).any()
    except ProjError:
        return "PROJ cannot compute with its numbers"
    return (
        ""
        if usable
        else (
            "nowhere is one of its metres near a metre and its inverse leads back: a number of it is wrong, or PROJ "
            "cannot invert it on its body"
        )
    )


def _axes_on_ground(crs: CRS) -> NDArray[np.float64]:
    """Return X and Y (rows) per hundredth of a degree east and north (columns) at places of the earth, (n, 2, 2).

    NaN where the projection is not usable. Some of the places are near the middle of any map; the first is in the
    middle of the area of use, if the CRS states one.
    """
    lon, lat = (v.ravel() for v in np.meshgrid(np.arange(-180.0, 180.0, 15.0), np.arange(-75.0, 80.0, 25.0)))
    area = crs.area_of_use
    if area is not None:
        wide = (area.east - area.west) % 360.0 or 360.0
        lon, lat = np.append(area.west + wide / 2, lon), np.append((area.south + area.north) / 2, lat)
    radius = 6378137.0 if crs.ellipsoid is None else crs.ellipsoid.semi_major_metre
    geodetic = crs.geodetic_crs
    unit = np.radians(1.0) / (1.0 if geodetic is None else geodetic.axis_info[0].unit_conversion_factor)
    transformer = Transformer.from_crs(geodetic, crs, always_xy=True)
    at = np.stack(transformer.transform(lon * unit, lat * unit), axis=-1)
    north = np.stack(transformer.transform(lon * unit, (lat + 0.01) * unit), axis=-1)
    east = np.stack(transformer.transform((lon + 0.01) * unit, lat * unit), axis=-1)
    back = transformer.transform(at[:, 0], at[:, 1], direction="INVERSE")
    with np.errstate(all="ignore"):
        axes = np.stack([east - at, north - at], axis=-1)
        turned = nearest_turn(back[0] / unit - lon, 0.0, 360.0)
        metres = crs.axis_info[0].unit_conversion_factor / (_HUNDREDTH * radius)
        scale = np.linalg.norm(axes[:, :, 1], axis=1) * metres
        close = np.hypot(turned, back[1] / unit - lat) < 1e-6
        axes[~(close & (scale > _SCALES[0]) & (scale < _SCALES[1]))] = np.nan
    return axes


@lru_cache(maxsize=256)
def is_left_handed(text: str) -> bool:
    """Return whether X, Y and heights of a projected CRS are a left-handed system, such as X south and Y west."""
    crs = parse_crs(text)
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    if not crs.is_projected:
        return False
    axes = _axes_on_ground(crs)
    turns = np.linalg.det(axes[np.isfinite(axes).all(axis=(1, 2))])
    return bool(len(turns) and turns[0] < 0)


def nearest_turn(x: ArrayLike, about: ArrayLike, turn: float) -> NDArray[np.float64]:
    """Longitudes, or X of a map that goes round the earth, counted within half a turn about a place."""
    x = np.asarray(x, float)
    with np.errstate(invalid="ignore"):
        return np.asarray(x - turn * np.round((x - about) / turn))


@lru_cache(maxsize=256)
def turn_of(text: str) -> float | None:
    """Length in X of one turn about the earth in a CRS: geographic ones, and maps on a cylinder; None: others."""
    crs = parse_crs(text)
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    if crs.is_geographic:
        return float(2.0 * np.pi / crs.axis_info[0].unit_conversion_factor)
    if not crs.is_projected or crs.geodetic_crs is None:
        return None
    turn = turn_of(crs.geodetic_crs.to_wkt()) or 360.0
    lon = np.arange(-180.0, 180.0, 5.0) / 360.0 * turn
    to_map = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True)
    X, X_north = (np.asarray(to_map.transform(lon, np.full(len(lon), lat * turn / 360.0))[0]) for lat in (0.0, 40.0))
    if not (np.isfinite(X).all() and np.isfinite(X_north).all()):
        return None
    step = float(np.median(np.diff(X)))
    even = step > 0 and np.abs(nearest_turn(np.diff(X) - step, 0.0, step * len(lon))).max() < 1e-6 * step
    return step * len(lon) if even and np.abs(X - X_north).max() < 1e-6 * step else None


def middle_longitude(text: str) -> float | None:
    """Longitude in the middle of a CRS's area of use, or that of its projection, degrees; None: it has none."""
    crs = parse_crs(text)
    area = crs.area_of_use
    if area is not None and abs(area.east - area.west) < 360.0:
        return float(nearest_turn(area.west + (area.east - area.west) % 360.0 / 2, 0.0, 360.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        stated = crs.to_dict()
    if "zone" in stated:
        return 6.0 * float(stated["zone"]) - 183.0
    return float(stated["lon_0"]) if "lon_0" in stated else None


def refuse_inexact(crs: str, XY: ArrayLike) -> None:
    """Refuse a projection which PROJ cannot invert at map points (n, 2): there and back must lead to the same place."""
    parsed = parse_crs(crs)
    XY = np.asarray(XY, float).reshape(-1, 2)
    if not parsed.is_projected or parsed.geodetic_crs is None:
        return
    to_map = Transformer.from_crs(parsed.geodetic_crs, parsed, always_xy=True)
    lonlat = to_map.transform(XY[:, 0], XY[:, 1], direction="INVERSE")
    back = np.stack(to_map.transform(*lonlat), axis=-1)
    off = np.linalg.norm(back - XY, axis=1) * parsed.axis_info[0].unit_conversion_factor
    known = np.isfinite(off)
    if (off[known] > INVERTED).any():
        raise inexact_projection(crs, float(off[known].max()))


def inexact_projection(crs: str, off: float) -> InputError:
    """The error for a projection that PROJ cannot invert on its body: there and back leads so many metres away."""
    ellipsoid = parse_crs(crs).ellipsoid
    a, b = (0.0, 0.0) if ellipsoid is None else (ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre)
    radii = f"{a / 1000:.6g} and {b / 1000:.6g} km"
    return InputError(
        f"CRS {crs_label(crs)!r}: PROJ cannot invert this projection on a body with radii {radii}: there and back "
        f"leads {off:.3g} m away; choose another projection, such as +proj=eqc or +proj=lcc, or a sphere (+R=…)"
    )


def require_projected_metres(text: str, where: str = "CRS") -> CRS:
    """The CRS, if it is projected, horizontal and in metres; else an error that says what to give instead."""
    crs = parse_crs(text, where)
    if crs.is_compound:
        horizontal, vertical = split_compound(text)
        raise InputError(
            f"{where}: {crs.name!r} joins a horizontal and a vertical CRS; give crs = "
            f"{crs_label(horizontal or '')!r} and state heights as height_system = {vertical!r}"
        )
    kind = "geographic" if crs.is_geographic else "geocentric" if crs.is_geocentric else "not projected"
    if not crs.is_projected:
        raise InputError(
            f"{where}: {crs.name!r} is {kind}; a projected CRS in metres is needed, such as the UTM zone of the area"
        )
    units = {axis.unit_name for axis in crs.axis_info[:2]}
    factors = {axis.unit_conversion_factor for axis in crs.axis_info[:2]}
    if factors != {1.0}:
        raise InputError(
            f"{where}: {crs.name!r} is in {', '.join(sorted(units))}; a projected CRS in metres is needed "
            "(inputs in other CRSs are transformed, products are in metres)"
        )
    if is_left_handed(text):
        directions = " and ".join(axis.direction for axis in crs.axis_info[:2])
        raise InputError(
            f"{where}: {crs.name!r} ({crs_label(text)}) counts X and Y to the {directions}, which is left-handed with "
            "heights upwards: no rotation of a camera is right in it; give a CRS with X to the east and Y to the north"
            f"{_east_north_of(crs)}"
        )
    return crs


def _east_north_of(crs: CRS) -> str:
    """Name a CRS with usual axes for the area of another one, in brackets; empty if that states no area."""
    area = crs.area_of_use
    if area is None:
        return ""
    middle = area.west + ((area.east - area.west) % 360.0) / 2
    twin = {"EPSG:5513": "EPSG:5514", "EPSG:2065": "EPSG:5221", "EPSG:5515": "EPSG:5516"}.get(
        canonical_crs(crs.to_wkt())
    )
    return f" ({twin or utm_codes((area.south + area.north) / 2, middle)[0]})"


def split_compound(text: str, where: str = "CRS") -> tuple[str | None, str | None]:
    """Horizontal CRS as a string, and the height system that the text states.

    The second is a vertical CRS's string for a compound CRS, ``"ellipsoidal"`` for a three-dimensional one (its own
    string if its heights are not metres upwards), and None where nothing is said of heights. A local (engineering) CRS
    in metres, or an undefined one of GeoPackage, names no place: both are None, as if nothing was stated.
    """
    crs = parse_crs(text, where)
    if crs.name.casefold().startswith("undefined") or (
        crs.type_name == "Engineering CRS" and all(axis.unit_conversion_factor == 1.0 for axis in crs.axis_info[:2])
    ):
        return None, None
    if crs.is_compound:
        parts = crs.sub_crs_list
        return canonical_crs(parts[0].to_wkt()), canonical_crs(parts[1].to_wkt())
    if len(crs.axis_info) == 3 and not crs.is_geocentric:
        height = crs.axis_info[2]
        metric = height.unit_conversion_factor == 1.0 and height.direction.casefold() == "up"
        return canonical_crs(crs.to_2d().to_wkt()), "ellipsoidal" if metric else canonical_crs(text)
    return canonical_crs(text), None


@lru_cache(maxsize=256)
def canonical_crs(text: str) -> str:
    """The shortest string that means exactly this CRS: `EPSG:…`, else a PROJ string, else WKT on one line."""
    crs = parse_crs(text)
    code = crs.to_authority(min_confidence=100)
    if code is not None and code[0] == "EPSG" and CRS.from_authority(*code) == crs:
        return ":".join(code)
    if crs.is_projected or crs.is_geographic:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            proj = crs.to_proj4().removesuffix(" +type=crs")
        # A PROJ string has no place for most datums, and PROJ calls a CRS without one equal to any with its ellipsoid.
        found = CRS.from_user_input(proj) if proj and len(proj) < 300 else None
        if found is not None and found == crs and _datum_name(found) == _datum_name(crs):
            return str(proj)
    return str(crs.to_wkt())


def _datum_name(crs: CRS) -> str:
    """Name of the datum, or of the ensemble of its realizations; `unknown` if only its ellipsoid is stated."""
    name = "unknown" if crs.datum is None else crs.datum.name.removesuffix(" ensemble")
    return "unknown" if name.casefold().startswith("unknown") else name


def crs_label(text: str) -> str:
    """The CRS in a few words, for people."""
    short = canonical_crs(text)
    return short if len(short) <= 120 else parse_crs(text).name


def same_crs(a: str, b: str) -> bool:
    """Return whether two strings mean the same horizontal CRS; axis order is ignored (X is always east)."""
    if a == b:
        return True
    first, second = (parse_crs(t) for t in (a, b))
    first, second = (c.sub_crs_list[0] if c.is_compound else c for c in (first, second))
    if first.equals(second, ignore_axis_order=True):
        return True
    # Two versions of the EPSG register may name the datum differently; the number says that it is one CRS.
    numbers = [c.to_authority() if c.to_epsg(min_confidence=100) else None for c in (first, second)]
    stated = [c.to_json_dict().get("id") for c in (first, second)]
    return (numbers[0] is not None and numbers[0] == numbers[1]) or (stated[0] is not None and stated[0] == stated[1])


@dataclass(frozen=True)
class CrsStep:
    """An exact transformation of horizontal coordinates; call it with X, Y of shape (..., 2)."""

    source: str
    target: str
    operation: str
    """Name of the coordinate operation, for the run record."""
    accuracy: float | None
    """Its stated accuracy, metres; None if it has none."""
    definition: str
    """PROJ pipeline."""
    about: float | None = None
    """X of the target within half a turn of which results are counted, for CRSs that go round the earth (degrees of
    longitude, or X of a map on a cylinder); None: as PROJ counts them, which is within ±180° of the CRS's middle."""
    _own: threading.local = field(default_factory=threading.local, repr=False, compare=False)

    def __call__(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Coordinates (..., 2) in the source CRS to the target CRS, X east and Y north; NaN stays NaN."""
        XY = np.asarray(XY, float)
        out = self.where_defined(XY)
        lost = ~np.isfinite(out).all(axis=-1) & np.isfinite(XY).all(axis=-1)
        if lost.any():
            x, y = np.atleast_2d(XY[lost])[0]
            raise InputError(
                f"X {x:.3f}, Y {y:.3f} of {crs_label(self.source)} has no coordinates in {crs_label(self.target)}; "
                "is it the right CRS, and are X and Y in the right order?"
            )
        return out

    def where_defined(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Transform points as a call does; points where the operation is not defined become NaN."""
        XY = np.asarray(XY, float)
        X, Y = self._transformer().transform(XY[..., 0], XY[..., 1])
        out = np.stack([np.asarray(X, float), np.asarray(Y, float)], axis=-1)
        out[~(np.isfinite(out) & np.isfinite(XY)).all(axis=-1)] = np.nan
        turn = None if self.about is None else turn_of(self.target)
        if turn is not None and self.about is not None:
            out[..., 0] = nearest_turn(out[..., 0], self.about, turn)
        return out

    def near(self, place: ArrayLike) -> CrsStep:
        """Return the step with results counted about that of a place (X, Y), for maps that go round the earth."""
        x = float(self.where_defined(place)[0])
        if not np.isfinite(x):
            return self
        return CrsStep(
            source=self.source,
            target=self.target,
            operation=self.operation,
            accuracy=self.accuracy,
            definition=self.definition,
            about=x,
        )

    def _transformer(self) -> Transformer:
        # A PROJ object belongs to one thread; every thread makes its own from the same definition.
        if not hasattr(self._own, "transformer"):
            self._own.transformer = Transformer.from_pipeline(self.definition)
        transformer: Transformer = self._own.transformer
        return transformer

    def __reduce__(self) -> tuple[Callable[..., CrsStep], tuple[str | float | None, ...]]:
        return CrsStep, (self.source, self.target, self.operation, self.accuracy, self.definition, self.about)


@lru_cache(maxsize=64)
def crs_step(
    source: str,
    target: str,
    bounds: tuple[float, float, float, float] | None = None,
    about: float | None = None,
) -> CrsStep:
    """Exact step from one horizontal CRS to another."""
    a, b = (parse_crs(t).to_2d() for t in (source, target))
    a, b = (c.sub_crs_list[0] if c.is_compound else c for c in (a, b))
    area = area_of(a, bounds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(a, b, always_xy=True, allow_ballpark=False, area_of_interest=area)
    if not group.transformers or not group.best_available:
        missing = missing_grids(group)
        what = f"the grid {missing[0]} is missing" if missing else "there is none without an inexact fallback"
        own = "" if area is None else _own_utm(source, target, area)
        raise InputError(
            f"no exact transformation from {crs_label(source)} to {crs_label(target)}: {what}; "
            f"give the inputs in one CRS{own}" + (", or install the grid" if missing else "")
        )
    best = group.transformers[0]
    accuracy = best.accuracy if best.accuracy is not None and best.accuracy >= 0 else None
    step = CrsStep(
        source=source,
        target=target,
        operation=best.description,
        accuracy=accuracy,
        definition=best.definition,
        about=about,
    )
    if bounds is not None and np.isfinite(bounds).all():
        x, y = np.linspace(bounds[0], bounds[2], 3), np.linspace(bounds[1], bounds[3], 3)
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        for crs, flat in ((source, a), (target, b)):
            if flat.ellipsoid is not None and 0 < flat.ellipsoid.inverse_flattening < _FLATTENED:
                refuse_inexact(crs, places if crs == source else step.where_defined(places))
    return step


def utm_codes(latitude: float, longitude: float) -> list[str]:
    """The UTM zone of WGS 84 at a place (degrees), then the zones beside it, as EPSG codes."""
    zone = int((longitude + 180) // 6) % 60
    return [f"EPSG:{326 if latitude >= 0 else 327}{(zone + shift) % 60 + 1:02d}" for shift in (0, -1, 1)]


def fitting_utm(crs: str, latitude: float, longitude: float) -> str:
    """Code of the UTM zone at a place (degrees), on the datum of a CRS if that has zones there, else on WGS 84."""
    geographic = parse_crs(crs).geodetic_crs
    here = AreaOfInterest(longitude, latitude, longitude, latitude)
    known = [] if geographic is None else query_utm_crs_info(datum_name=geographic.name, area_of_interest=here)
    zone = utm_codes(latitude, longitude)[0]
    same = [f"{found.auth_name}:{found.code}" for found in known if found.name.endswith(f"zone {int(zone[-2:])}"
            f"{'N' if latitude >= 0 else 'S'}")]  # fmt: skip
    return same[0] if same else zone


def _own_utm(source: str, target: str, area: Any) -> str:
    """Return the UTM zone on the source's datum, to choose instead of a target on another one, or nothing."""
    middle = area.west_lon_degree + (area.east_lon_degree - area.west_lon_degree) % 360.0 / 2
    code = fitting_utm(source, (area.south_lat_degree + area.north_lat_degree) / 2, middle)
    same = parse_crs(code).datum == parse_crs(source).datum and not same_crs(code, target)
    return f", choose a CRS on the datum of the first, such as {code}" if same else ""


def missing_grids(group: TransformerGroup) -> list[str]:
    """Grids that the best operation of a group would need and that are not installed, with their address."""
    for operation in group.unavailable_operations:
        lost = [g for g in operation.grids if not g.available]
        if lost and all(g.url for g in lost):
            return [f"{g.short_name} ({g.url})" for g in lost]
    return [g.short_name for o in group.unavailable_operations[:1] for g in o.grids if not g.available]


#: Bodies with a smaller inverse flattening than this are not like the earth: PROJ's series for it are checked there.
_FLATTENED = 250.0
#: Half the side of the area of a point, degrees.
_POINT = 1e-6


def area_of(crs: CRS, bounds: tuple[float, float, float, float] | None) -> Any:
    """pyproj's area of interest of map bounds; None if there are none or they are nowhere on the earth."""
    if bounds is None:
        return None
    try:
        to_degrees = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        west, south, east, north = to_degrees.transform_bounds(*bounds)
    except ProjError:
        return None
    if not np.isfinite([west, south, east, north]).all():
        return None
    # Longitudes may be counted from 0 to 360°; an area across 180° has its west east of its east.
    wide = (east - west) % 360.0 if abs(east - west) != 360.0 else 360.0
    if east > west and east - west >= 360.0:
        west, east = -180.0, 180.0
    else:
        west = float(nearest_turn(west - _POINT, 0.0, 360.0))
        east = float(nearest_turn(west + wide + 2 * _POINT, 0.0, 360.0))
    # To older PROJ the area of a single point is nowhere.
    return AreaOfInterest(west, south - _POINT, east, north + _POINT)


#: Derivatives of a step between systems are taken over this distance to either side, metres.
_REACH = 50.0


def grid_rotation(step: CrsStep, XY: ArrayLike) -> NDArray[np.float64]:
    """Rotation from the source CRS's axes to the target CRS's axes at points X, Y (..., 2), shape (..., 3, 3).

    It is the difference of the meridian convergences: the nearest rotation to the derivatives of the step, taken
    over ±50 metres. Heights keep their axis.
    """
    for crs in (step.source, step.target):
        if is_left_handed(crs):
            raise InputError(f"{crs_label(crs)} is left-handed with heights upwards: angles have no meaning in it")
    XY = np.asarray(XY, float)
    right, up = np.array([_REACH, 0.0]), np.array([0.0, _REACH])
    along_x = step(XY + right) - step(XY - right)
    along_y = step(XY + up) - step(XY - up)
    # Of a 2 × 2 matrix [[a, b], [c, d]] the nearest rotation has the angle atan2(c − b, a + d).
    angle = np.arctan2(along_x[..., 1] - along_y[..., 0], along_x[..., 0] + along_y[..., 1])
    R = np.zeros((*XY.shape[:-1], 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(angle)
    R[..., 1, 0] = np.sin(angle)
    R[..., 0, 1] = -R[..., 1, 0]
    R[..., 2, 2] = 1.0
    return R


def topocentric_poses(
    origin: tuple[float, float, float], target: str, centers: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of a local tangential system brought into a projected CRS, with the rotation of the axes there."""
    require_projected_metres(target)
    lat, lon, h = origin
    to_degrees = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={h!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    to_map = crs_step("EPSG:4326", target).near((lon, lat))

    def to_ground(enu: NDArray[np.float64]) -> NDArray[np.float64]:
        lon_, lat_, h_ = to_degrees.transform(enu[..., 0], enu[..., 1], enu[..., 2])
        return np.concatenate([to_map(np.stack([lon_, lat_], axis=-1)), np.asarray(h_)[..., None]], axis=-1)

    enu = np.asarray(centers, float).reshape(-1, 3)
    J = np.stack([to_ground(enu + d) - to_ground(enu - d) for d in np.eye(3) * _REACH], axis=-1) / (2 * _REACH)
    if not np.isfinite(J).all():
        raise InputError("positions in east, north and up that lie nowhere on earth; are they metres?")
    # The nearest rotation: the map's scale stretches rows of J and does not turn it.
    U, _, Vt = np.linalg.svd(J)
    return to_ground(enu), U @ Vt


@dataclass(frozen=True)
class Agreement:
    """A similarity in the plane that takes one set to the other, by least squares; NaN where it is not determined."""

    count: int
    """Places that both sets have."""
    shift: float
    """Distance of the middles, metres."""
    turn: float
    """Rotation, radians, counter-clockwise."""
    sigma_turn: float
    """Its standard deviation, errors of neighbouring places taken as independent."""
    scale: float
    scatter: float
    """Standard deviation of a coordinate about the similarity, metres."""
    spread: float
    """Root mean square distance of the places from their middle, metres."""


def agreement(a: ArrayLike, b: ArrayLike) -> Agreement:
    """Similarity from places `a` to `b`, both (n, 2) or more columns, of which X and Y are used; NaN: not known."""
    p, q = (np.asarray(v, float)[:, :2] @ [1.0, 1.0j] for v in (a, b))
    both = np.isfinite(p) & np.isfinite(q)
    p, q = p[both], q[both]
    n, nan = len(p), float("nan")
    if not n:
        return Agreement(count=0, shift=nan, turn=nan, sigma_turn=nan, scale=nan, scatter=nan, spread=nan)
    shift = abs((q - p).mean())
    p, q = p - p.mean(), q - q.mean()
    square = float((np.abs(p) ** 2).sum())
    spread = float(np.sqrt(square / n))
    if n < 3 or square == 0:
        return Agreement(count=n, shift=shift, turn=nan, sigma_turn=nan, scale=nan, scatter=nan, spread=spread)
    factor = (np.conj(p) @ q) / square
    scatter = float(np.sqrt((np.abs(q - factor * p) ** 2).sum() / (2 * n - 4)))
    turn, scale = float(np.angle(factor)), float(abs(factor))
    return Agreement(
        count=n,
        shift=float(shift),
        turn=turn,
        sigma_turn=scatter / float(np.sqrt(square)),
        scale=scale,
        scatter=scatter,
        spread=spread,
    )


def misfit(a: ArrayLike, b: ArrayLike) -> float:
    """Sum of squared differences of places that both sets know, apart from a common shift, square metres."""
    d = np.asarray(b, float)[:, :2] - np.asarray(a, float)[:, :2]
    d = d[np.isfinite(d).all(axis=1)]
    return float(((d - d.mean(axis=0)) ** 2).sum())

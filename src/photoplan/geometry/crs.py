"""Coordinate reference systems: reading them, refusing unfit ones, and exact steps from one to another.

pyproj silently falls back to inexact ("ballpark") operations and returns coordinates unchanged where a grid is
missing. Every transformation here is asked for without that fallback, and its results are looked at.
"""

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
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from photoplan.errors import InputError

#: A hundredth of a degree, radians.
_HUNDREDTH = np.pi / 180.0 / 100.0


@lru_cache(maxsize=256)
def parse_crs(text: str, where: str = "CRS") -> CRS:
    """CRS of a string: `EPSG:…`, WKT, or a PROJ string. `where` names it in messages.

    Raises
    ------
    InputError
        The text is not a CRS.
    """
    try:
        crs = CRS.from_user_input(text.strip())
        why = "" if text.strip()[:5].upper() == "EPSG:" else _unusable(crs)
    except CRSError as error:
        why = str(error).split(":")[-1].strip(" )")
    if why:
        raise InputError(
            f"{where}: {text[:120]!r} is not a coordinate reference system ({why}); "
            "give EPSG:nnnn, WKT or a PROJ string"
        )
    return crs


#: A map's metre on the ground: units are converted, projections stretch.
_SCALES = 0.1, 10.0
#: Radii of bodies that ellipsoids describe, from Phobos to Jupiter, metres; those of planets in kilometres are not.
_RADII = 1e4, 1e8


def _unusable(crs: CRS) -> str:
    """Why a projected CRS describes no map, though it is well formed: numbers may have any size in WKT; else empty."""
    if not crs.is_projected:
        return ""
    radius = 6378137.0 if crs.ellipsoid is None else crs.ellipsoid.semi_major_metre
    if not _RADII[0] < radius < _RADII[1]:
        return f"a body of radius {radius / 1000:g} km"
    # Some of these places are near the middle of any map.
    lon, lat = (v.ravel() for v in np.meshgrid(np.arange(-180.0, 180.0, 15.0), np.arange(-75.0, 80.0, 25.0)))
    try:
        transformer = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True)
        x, y = transformer.transform(lon, lat)
        north = transformer.transform(lon, lat + 0.01)
        back = transformer.transform(x, y, direction="INVERSE")
    except ProjError:
        return "PROJ cannot compute with its numbers"
    with np.errstate(all="ignore"):
        turned = (back[0] - lon + 180.0) % 360.0 - 180.0
        scale = np.hypot(north[0] - x, north[1] - y) * crs.axis_info[0].unit_conversion_factor / (_HUNDREDTH * radius)
        close = np.hypot(turned, back[1] - lat) < 1e-6
        usable = close & (scale > _SCALES[0]) & (scale < _SCALES[1])
    return "" if usable.any() else "nowhere is one of its metres near a metre: a number of it is wrong"


def require_projected_metres(text: str, where: str = "CRS") -> CRS:
    """The CRS, if it is projected, horizontal and in metres; else an error that says what to give instead.

    Raises
    ------
    InputError
        The CRS is geographic, geocentric, local, in feet, or compound.
    """
    crs = parse_crs(text, where)
    if crs.is_compound:
        horizontal, vertical = split_compound(text)
        raise InputError(
            f"{where}: {crs.name!r} joins a horizontal and a vertical CRS; give crs = {crs_label(horizontal)!r} and "
            f"state heights as height_system = {vertical!r}"
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
    return crs


def split_compound(text: str) -> tuple[str, str | None]:
    """Horizontal CRS as a string, and the height system that the text states.

    The second is a vertical CRS's string for a compound CRS, ``"ellipsoidal"`` for a three-dimensional one,
    and None where nothing is said of heights.
    """
    crs = parse_crs(text)
    if crs.is_compound:
        parts = crs.sub_crs_list
        return canonical_crs(parts[0].to_wkt()), canonical_crs(parts[1].to_wkt())
    if len(crs.axis_info) == 3 and not crs.is_geocentric:
        return canonical_crs(crs.to_2d().to_wkt()), "ellipsoidal"
    return canonical_crs(text), None


@lru_cache(maxsize=256)
def canonical_crs(text: str) -> str:
    """The shortest string that means exactly this CRS: `EPSG:…`, else a PROJ string, else WKT on one line."""
    crs = parse_crs(text)
    code = crs.to_authority(min_confidence=100)
    if code is not None and code[0] == "EPSG" and CRS.from_authority(*code) == crs:
        return ":".join(code)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        proj = crs.to_proj4()
    if proj and not crs.is_vertical:
        proj = proj.removesuffix(" +type=crs")
        if CRS.from_user_input(proj) == crs and len(proj) < 300:
            return str(proj)
    return str(crs.to_wkt())


def crs_label(text: str) -> str:
    """The CRS in a few words, for people."""
    short = canonical_crs(text)
    return short if len(short) <= 120 else parse_crs(text).name


def same_crs(a: str, b: str) -> bool:
    """Whether two strings mean the same horizontal CRS; axis order is ignored (X is always east)."""
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
    _own: threading.local = field(default_factory=threading.local, repr=False, compare=False)

    def __call__(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Coordinates (..., 2) in the source CRS to the target CRS, X east and Y north; NaN stays NaN.

        Raises
        ------
        InputError
            A point lies where the operation is not defined.
        """
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
        """As a call; points where the operation is not defined become NaN."""
        XY = np.asarray(XY, float)
        X, Y = self._transformer().transform(XY[..., 0], XY[..., 1])
        out = np.stack([np.asarray(X, float), np.asarray(Y, float)], axis=-1)
        out[~(np.isfinite(out) & np.isfinite(XY)).all(axis=-1)] = np.nan
        return out

    def _transformer(self) -> Transformer:
        # A PROJ object belongs to one thread; every thread makes its own from the same definition.
        if not hasattr(self._own, "transformer"):
            self._own.transformer = Transformer.from_pipeline(self.definition)
        transformer: Transformer = self._own.transformer
        return transformer

    def __reduce__(self) -> tuple[Callable[..., CrsStep], tuple[str | float | None, ...]]:
        return CrsStep, (self.source, self.target, self.operation, self.accuracy, self.definition)


@lru_cache(maxsize=64)
def crs_step(source: str, target: str, bounds: tuple[float, float, float, float] | None = None) -> CrsStep:
    """Exact step from one horizontal CRS to another.

    Parameters
    ----------
    source, target : str
        Strings that pyproj reads; of compound CRSs the horizontal part is taken.
    bounds : tuple of float, optional
        xmin, ymin, xmax, ymax in `source`: where it is used, which decides between operations of different areas.

    Raises
    ------
    InputError
        No operation without a fallback is available; a missing grid is named.
    """
    a, b = (parse_crs(t).to_2d() for t in (source, target))
    a, b = (c.sub_crs_list[0] if c.is_compound else c for c in (a, b))
    area = area_of(a, bounds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(a, b, always_xy=True, allow_ballpark=False, area_of_interest=area)
    if not group.transformers or not group.best_available:
        missing = missing_grids(group)
        what = f"the grid {missing[0]} is missing" if missing else "there is none without an inexact fallback"
        raise InputError(
            f"no exact transformation from {crs_label(source)} to {crs_label(target)}: {what}; "
            "give the inputs in one CRS" + (", or install the grid" if missing else "")
        )
    best = group.transformers[0]
    accuracy = best.accuracy if best.accuracy is not None and best.accuracy >= 0 else None
    return CrsStep(
        source=source, target=target, operation=best.description, accuracy=accuracy, definition=best.definition
    )


def utm_codes(latitude: float, longitude: float) -> list[str]:
    """The UTM zone of WGS 84 at a place (degrees), then the zones beside it, as EPSG codes."""
    zone = int((longitude + 180) // 6) % 60
    return [f"EPSG:{326 if latitude >= 0 else 327}{(zone + shift) % 60 + 1:02d}" for shift in (0, -1, 1)]


def missing_grids(group: TransformerGroup) -> list[str]:
    """Grids that the best operation of a group would need and that are not installed, with their address."""
    for operation in group.unavailable_operations:
        lost = [g for g in operation.grids if not g.available]
        if lost and all(g.url for g in lost):
            return [f"{g.short_name} ({g.url})" for g in lost]
    return [g.short_name for o in group.unavailable_operations[:1] for g in o.grids if not g.available]


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
    # To older PROJ the area of a single point is nowhere.
    return AreaOfInterest(west - _POINT, south - _POINT, east + _POINT, north + _POINT)


#: Derivatives of a step between systems are taken over this distance to either side, metres.
_REACH = 50.0


def grid_rotation(step: CrsStep, XY: ArrayLike) -> NDArray[np.float64]:
    """Rotation from the source CRS's axes to the target CRS's axes at points X, Y (..., 2), shape (..., 3, 3).

    It is the difference of the meridian convergences: the nearest rotation to the derivatives of the step, taken
    over ±50 metres. Heights keep their axis.
    """
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
    """Points of a local tangential system brought into a projected CRS, with the rotation of the axes there.

    Parameters
    ----------
    origin : tuple of float
        Latitude and longitude in degrees (WGS 84) and ellipsoidal height of the system's origin; its axes point
        east, north and up there.
    target : str
        Projected CRS in metres.
    centers : array_like, shape (n, 3)
        East, north, up, metres.

    Returns
    -------
    XYZ : ndarray, shape (n, 3)
        Map coordinates and ellipsoidal height.
    R : ndarray, shape (n, 3, 3)
        Takes the local system's axes to map axes at each point: convergence of meridians and the inclination of the
        two horizons. The map's scale is no rotation and is left out.
    """
    require_projected_metres(target)
    lat, lon, h = origin
    to_degrees = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={h!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    to_map = crs_step("EPSG:4326", target)

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

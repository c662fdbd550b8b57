"""Points and axes carried between maps, geocentric coordinates and local tangential systems.

Programs of computer vision orient images in a Cartesian system: geocentric, or east, north, up about a point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Transformer

from photoplan.errors import InputError
from photoplan.geometry.crs import (
    crs_label,
    crs_step,
    nearest_turn,
    parse_crs,
    require_projected_metres,
    split_compound,
    topocentric_poses,
    turn_of,
)
from photoplan.geometry.local import LocalFrame
from photoplan.geometry.units import metric_system

_Floats = NDArray[np.float64]


def enu_axes(latitude: float, longitude: float) -> _Floats:
    """R_enu_earth (3, 3): geocentric axes to east, north, up at a point, degrees."""
    S, C = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    s, c = np.sin(np.radians(longitude)), np.cos(np.radians(longitude))
    return np.array([[-s, c, 0.0], [-S * c, -S * s, C], [C * c, C * s, S]])


def geocentric_of_geodetic(point: tuple[float, float, float]) -> _Floats:
    """Geocentric coordinates (3,) of latitude, longitude (degrees) and ellipsoidal height, WGS 84."""
    lat, lon, h = point
    return np.array(_to_earth().transform(lon, lat, h), np.float64)


def geodetic_of_geocentric(xyz: ArrayLike) -> tuple[float, float, float]:
    """Latitude, longitude (degrees) and ellipsoidal height of a geocentric point (3,), WGS 84."""
    x, y, z = np.asarray(xyz, float).tolist()
    lon, lat, h = _to_earth().transform(x, y, z, direction="INVERSE")
    return float(lat), float(lon), float(h)


def enu_poses(geodetic: ArrayLike) -> tuple[tuple[float, float, float], _Floats, _Floats]:
    """Points given by latitude and longitude as one tangential system about their middle."""
    points = np.asarray(geodetic, float).reshape(-1, 3)
    earth = np.column_stack(_to_earth().transform(points[:, 1], points[:, 0], points[:, 2]))
    origin = geodetic_of_geocentric(earth.mean(axis=0))
    own = np.stack([enu_axes(lat, lon).T for lat, lon in points[:, :2]])
    return origin, enu_of_geodetic(origin, points), enu_axes(*origin[:2]) @ own


def geodetic_of_enu(origin: tuple[float, float, float], enu: ArrayLike) -> _Floats:
    """Latitude, longitude (degrees, WGS 84) and height of points (n, 3) east, north, up; NaN stays NaN."""
    xyz = np.asarray(enu, float) @ enu_axes(*origin[:2]) + geocentric_of_geodetic(origin)
    lon, lat, h = _to_earth().transform(xyz[:, 0], xyz[:, 1], xyz[:, 2], direction="INVERSE")
    out = np.column_stack([lat, lon, h])
    out[~np.isfinite(xyz).all(axis=1)] = np.nan
    return out


def enu_of_geodetic(origin: tuple[float, float, float], geodetic: ArrayLike) -> _Floats:
    """Inverse of `geodetic_of_enu`; NaN stays NaN."""
    points = np.asarray(geodetic, float)
    earth = np.column_stack(_to_earth().transform(points[:, 1], points[:, 0], points[:, 2]))
    earth[~np.isfinite(earth).all(axis=1)] = np.nan
    return (earth - geocentric_of_geodetic(origin)) @ enu_axes(*origin[:2]).T


def _to_earth() -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
    )


def map_poses(crs: str, xyz: ArrayLike) -> tuple[_Floats, _Floats]:
    """Geocentric points (n, 3) of the datum of a projected CRS as map points, with the map's axes there."""
    xyz = np.asarray(xyz, float).reshape(-1, 3)
    frame = _frame_at(crs, xyz)
    XYZ = frame.from_geocentric(xyz)
    if not np.isfinite(XYZ).all():
        x, y, z = xyz[~np.isfinite(XYZ).all(axis=1)][0]
        raise InputError(
            f"geocentric point {x:.3f}, {y:.3f}, {z:.3f} has no place in {crs_label(crs)}; is it the right CRS?"
        )
    axes = frame.R_local_earth.T @ frame.axes(XYZ)
    if (turn := turn_of(crs)) is not None:  # a map on a cylinder counts X of one block without a jump
        XYZ[:, 0] = nearest_turn(XYZ[:, 0], XYZ[:1, 0], turn)
    return XYZ, axes


def geocentric_poses(crs: str, XYZ: ArrayLike) -> tuple[_Floats, _Floats]:
    """Map points with ellipsoidal heights (n, 3) as geocentric points, with the map's axes there; see `map_poses`."""
    _ellipsoid_of(crs)
    XYZ = np.asarray(XYZ, float).reshape(-1, 3)
    frame = LocalFrame(crs, (float(XYZ[:, 0].mean()), float(XYZ[:, 1].mean())))
    return frame.to_geocentric(XYZ), frame.R_local_earth.T @ frame.axes(XYZ)


def _ellipsoid_of(crs: str) -> tuple[float, float]:
    """Semi-axes of a projected CRS's ellipsoid, metres."""
    projected = require_projected_metres(crs)
    if projected.geodetic_crs is None or projected.ellipsoid is None:
        raise InputError(f"CRS {crs_label(crs)!r} has no ellipsoid; a projected CRS of the earth is needed")
    meridian = projected.prime_meridian
    if meridian is not None and meridian.longitude != 0:
        raise InputError(
            f"CRS {crs_label(crs)!r} counts longitudes from {meridian.name}; geocentric coordinates count from "
            "Greenwich: choose a CRS that does too"
        )
    a = projected.ellipsoid.semi_major_metre
    return a, projected.ellipsoid.semi_minor_metre or a


def _frame_at(crs: str, xyz: _Floats) -> LocalFrame:
    """A local system of the CRS near geocentric points."""
    a, b = _ellipsoid_of(crs)
    to_degrees = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=cart +a={a!r} +b={b!r} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    lon, lat, _ = to_degrees.transform(*xyz.mean(axis=0))
    projected = parse_crs(crs)
    assert projected.geodetic_crs is not None
    unit = projected.geodetic_crs.axis_info[0].unit_conversion_factor / np.radians(1.0)
    forward = Transformer.from_crs(projected.geodetic_crs, projected, always_xy=True)
    X, Y = forward.transform(lon / unit, lat / unit)
    if not np.isfinite([X, Y]).all():
        raise InputError(f"geocentric points near {lat:.4f}°, {lon:.4f}° have no place in {crs_label(crs)}")
    return LocalFrame(crs, (float(X), float(Y)))


def topocentric_of_map(origin: tuple[float, float, float], crs: str, XYZ: ArrayLike) -> tuple[_Floats, _Floats]:
    """Inverse of `photoplan.geometry.crs.topocentric_poses`: map points with height as east, north, up."""
    require_projected_metres(crs)
    XYZ = np.asarray(XYZ, float).reshape(-1, 3)
    lonlat = crs_step(crs, "EPSG:4326")(XYZ[:, :2])
    enu = enu_of_geodetic(origin, np.column_stack([lonlat[:, ::-1], XYZ[:, 2]]))
    for _ in range(2):
        # The two ways through the projection differ by rounding; the step back is the one that readers take.
        back, R = topocentric_poses(origin, crs, enu)
        enu = enu + np.einsum("nji,nj->ni", R, XYZ - back)
    return enu, topocentric_poses(origin, crs, enu)[1]


def is_local_crs(text: str, where: str) -> bool:
    """Whether a text is the WKT of a local system, one without any relation to the earth."""
    if not text.strip().upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return False
    if split_compound(text, where)[0] is not None:
        metric_system(text, where)
    return True


def is_wgs84_geographic(text: str, where: str) -> bool:
    """Whether a CRS states latitude and longitude on WGS 84, or on a datum that coincides with it within metres."""
    crs = parse_crs(text, where)
    if not crs.is_geographic or crs.ellipsoid is None:
        return False
    same = abs(crs.ellipsoid.semi_major_metre - 6378137.0) < 1e-3
    return same and abs((crs.ellipsoid.inverse_flattening or 0.0) - 298.2572) < 1e-3


def legacy_wkt(text: str) -> str:
    """WKT of the first version on one line, which older programs read; where there is none, of the second."""
    crs = parse_crs(text, "CRS")
    try:
        return str(crs.to_wkt("WKT1_GDAL"))
    except Exception:  # pyproj raises different errors for what WKT 1 cannot express
        return str(crs.to_wkt())

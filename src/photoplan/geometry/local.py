"""Local and geocentric systems: tangential planes, bodies, geodetic coordinates, poses in true metres."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer

from photoplan.errors import InputError
from photoplan.geometry.crs import (
    INVERTED,
    CrsStep,
    crs_label,
    crs_step,
    inexact_projection,
    nearest_turn,
    parse_crs,
    require_projected_metres,
    split_compound,
    topocentric_poses,
    turn_of,
)
from photoplan.geometry.heights import HeightStep, height_step
from photoplan.geometry.units import metric_system

WGS84 = "EPSG:4326"
#: Half the distance over which derivatives are taken, metres: truncation and rounding both stay below 1e-10.
_REACH = 100.0
#: An undulation is so even that each turn of the iteration gains four digits.
_TURNS = 4


@dataclass(frozen=True)
class GeodeticGround:
    """Ground coordinates of a project as WGS 84 has them.

    Raises
    ------
    InputError
        There is no exact operation between the CRS and WGS 84.
    HeightSystemError
        The grid that joins the height systems is missing.
    """

    crs: str
    """Projected CRS of the ground."""
    heights: str = "ellipsoidal"
    """Height system of the ground; ``"same"`` is declared to be ellipsoidal."""
    _to_geodetic: CrsStep = field(init=False, repr=False, compare=False)
    _to_map: CrsStep = field(init=False, repr=False, compare=False)
    _to_ellipsoid: HeightStep = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_to_geodetic", crs_step(self.crs, WGS84))
        object.__setattr__(self, "_to_map", crs_step(WGS84, self.crs))
        object.__setattr__(self, "_to_ellipsoid", height_step(self.heights, "ellipsoidal", self.crs))

    @property
    def operations(self) -> tuple[CrsStep | HeightStep, ...]:
        """Return what is done to coordinates and heights, for the run record."""
        heights = () if self._to_ellipsoid.definition is None else (self._to_ellipsoid,)
        return (self._to_geodetic, *heights)

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y and height to longitude, latitude (degrees) and ellipsoidal height; shapes (..., 3).

        NaN where the CRS has no place.

        Raises
        ------
        HeightSystemError
            A point lies outside the grid that joins the height systems.
        """
        XYZ = np.asarray(XYZ, float)
        out = np.empty_like(XYZ)
        out[..., :2] = self._to_geodetic.where_defined(XYZ[..., :2])
        out[..., 2] = self._to_ellipsoid(XYZ)
        return out

    def ellipsoidal(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ellipsoidal height (...) of map X, Y and height (..., 3); raises as a call does."""
        return self._to_ellipsoid(np.asarray(XYZ, float))

    def to_map(self, geodetic: ArrayLike) -> NDArray[np.float64]:
        """The inverse of a call, to 1e-8 m; NaN where the CRS has no place, and outside the grid of the heights.

        A ray may leave the grid above or below the ground that it shows, far from any point that is asked for.
        """
        geodetic = np.asarray(geodetic, float)
        out = np.empty_like(geodetic)
        out[..., :2] = self._to_map.where_defined(geodetic[..., :2])
        out[..., 2] = geodetic[..., 2]
        if self._to_ellipsoid.definition is not None:
            for _ in range(_TURNS):
                out[..., 2] -= self._to_ellipsoid.where_defined(out) - geodetic[..., 2]
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(longitude, latitude, ellipsoidal height) / ∂(X, Y, height), shape (..., 3, 3), degrees and metres."""
        XYZ = np.asarray(XYZ, float)
        steps = np.array([[_REACH, 0, 0], [-_REACH, 0, 0], [0, _REACH, 0], [0, -_REACH, 0]])
        around = self(XYZ[..., None, :] + steps)
        around[..., 0] = nearest_turn(around[..., 0], around[..., :1, 0], 360.0)
        J = np.zeros((*XYZ.shape, 3))
        J[..., 0] = (around[..., 0, :] - around[..., 1, :]) / (2 * _REACH)
        J[..., 1] = (around[..., 2, :] - around[..., 3, :]) / (2 * _REACH)
        J[..., 2, 2] = 1.0
        return J


#: Earth radius where no CRS tells a better one, metres (Ecker 1991, table 4.2).
MEAN_RADIUS = 6_380_000.0
#: Ellipsoids of the earth have a smaller squared eccentricity; what is made for the earth is checked beyond it.
EARTHLIKE = 0.01
#: Turns of the iteration for the inverse of a projection on a flattened body; one gains a digit or half of one.
_TURNS_LOCAL = 30
#: Half the distance over which the mapping's derivative is taken, metres: the mapping is so smooth (its third
#: derivative is of the order 1/R²) that truncation and rounding both stay below 1e-10.


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid of revolution, and the Cartesian axes in its middle."""

    a: float
    """Semi-major axis, metres."""
    e2: float
    """Squared first eccentricity."""

    @classmethod
    def of_radii(cls, equatorial: float, polar: float) -> Ellipsoid:
        """By its semi-axes, metres."""
        return cls(equatorial, 1.0 - (polar / equatorial) ** 2)

    @property
    def b(self) -> float:
        """Semi-minor axis, metres."""
        return self.a * math.sqrt(1.0 - self.e2)

    def up(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Outward normal (..., 3) below Cartesian coordinates (..., 3)."""
        return self.geocentric(*self.geodetic(xyz))[1]

    def geocentric(
        self, lon: NDArray[np.float64], lat: NDArray[np.float64], height: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cartesian coordinates and the outward normal of longitude, latitude (radians) and height, each (..., 3)."""
        sin, cos = np.sin(lat), np.cos(lat)
        up = np.stack([cos * np.cos(lon), cos * np.sin(lon), sin], axis=-1)
        N = self.a / np.sqrt(1.0 - self.e2 * sin * sin)
        xyz = up * (N + height)[..., None]
        xyz[..., 2] -= self.e2 * N * sin
        return xyz, up

    def geodetic(
        self, xyz: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Longitude, latitude (radians) and height of Cartesian coordinates (..., 3)."""
        p, z = np.hypot(xyz[..., 0], xyz[..., 1]), xyz[..., 2]
        b_over_a = math.sqrt(1.0 - self.e2)
        # Bowring's iteration for the parametric latitude: on earth one step is good to 1e-8 m, two to the last digit.
        t = z / (p * b_over_a)
        for _ in range(2 if self.e2 < EARTHLIKE else 12):
            cos = 1.0 / np.sqrt(1.0 + t * t)
            sin = t * cos
            tan = (z + self.e2 / b_over_a * self.a * sin**3) / (p - self.e2 * self.a * cos**3)
            t = b_over_a * tan
        lat = np.arctan(tan)
        sin = np.sin(lat)
        h = p * np.cos(lat) + z * sin - self.a * np.sqrt(1.0 - self.e2 * sin * sin)
        return np.arctan2(xyz[..., 1], xyz[..., 0]), lat, h


@dataclass(frozen=True)
class ProjectedCrs:
    """A map projection with the ellipsoid below it."""

    to_geographic: Transformer
    unit: float
    """Radians in one unit of the geographic coordinates."""
    ellipsoid: Ellipsoid
    crs: str
    """Text as it was given, for messages."""
    sphere: Transformer | None = None
    """The inverse of the same projection of a sphere; None: the body is flattened no more than the earth."""

    def radians(self, XY: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Longitude and latitude in radians of map points (..., 2); NaN where the projection ends."""
        lon, lat = self._inverse(self.to_geographic, XY)
        return (lon, lat) if self.sphere is None else self._inverted(XY, lon, lat)

    def map(self, lon: NDArray[np.float64], lat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points (..., 2) of longitude and latitude in radians; NaN where they do not lead back."""
        out = self._forward(lon, lat)
        # Some inverse projections of PROJ are good to tenths of a millimetre only (LAEA); as `radians` uses them, the
        # difference is taken out here, so that the two are inverse to the last digit.
        back_lon, back_lat = self.radians(out)
        with np.errstate(invalid="ignore"):
            d_lon, d_lat = nearest_turn(back_lon - lon, 0.0, 2.0 * np.pi), back_lat - lat
            lost = ~(self.ellipsoid.a * np.hypot(d_lon * np.cos(lat), d_lat) <= INVERTED)
        exact = self._forward(lon - d_lon, lat - d_lat)
        exact[lost] = np.nan
        return exact

    def _inverted(
        self, XY: NDArray[np.float64], lon: NDArray[np.float64], lat: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Longitude and latitude that the projection takes to map points, from PROJ's inverse of it.

        PROJ's series and iterations are made for the earth; on bodies that are flattened more they stop too early or
        give up. Where they do, the inverse on a sphere is iterated, which gains a digit each time.
        """
        with np.errstate(invalid="ignore"):
            off = np.linalg.norm(self._forward(lon, lat) - XY[..., :2], axis=-1)
            wrong = off > INVERTED
            if 2 * np.count_nonzero(wrong) > np.count_nonzero(np.isfinite(off)):
                raise inexact_projection(self.crs, float(off[wrong].max()))
            todo = ~(off <= INVERTED) & np.isfinite(XY[..., :2]).all(axis=-1)
            if not todo.any():
                return lon, lat
            wanted = XY[todo][:, :2]
            goal = self._inverse(self.sphere, wanted)
            at = goal
            for _ in range(_TURNS_LOCAL):
                here = self._inverse(self.sphere, self._forward(*at))
                at = at[0] + nearest_turn(goal[0] - here[0], 0.0, 2.0 * np.pi), at[1] + goal[1] - here[1]
            found = np.linalg.norm(self._forward(*at) - wanted, axis=-1) <= INVERTED
            lon, lat = np.array(lon), np.array(lat)
            lon[todo], lat[todo] = np.where(found, at[0], np.nan), np.where(found, at[1], np.nan)
        return lon, lat

    def _inverse(
        self, way: Transformer | None, XY: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert way is not None
        lon, lat = way.transform(XY[..., 0], XY[..., 1])
        lon, lat = (np.where(np.isfinite(v), v, np.nan) * self.unit for v in (lon, lat))
        return lon, lat

    def _forward(self, lon: NDArray[np.float64], lat: NDArray[np.float64]) -> NDArray[np.float64]:
        X, Y = self.to_geographic.transform(lon / self.unit, lat / self.unit, direction="INVERSE")
        out = np.stack([np.asarray(X, float), np.asarray(Y, float)], axis=-1)
        out[~np.isfinite(out)] = np.nan
        return out

    def geocentric(self, XYZ: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Geocentric coordinates and the ellipsoid's outward normal of map points with height, each (..., 3)."""
        return self.ellipsoid.geocentric(*self.radians(XYZ), XYZ[..., 2])

    def from_geocentric(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points with ellipsoidal height of geocentric coordinates (..., 3)."""
        lon, lat, h = self.ellipsoid.geodetic(xyz)
        return np.concatenate([self.map(lon, lat), h[..., None]], axis=-1)


@lru_cache(maxsize=64)
def projected_crs(crs: str) -> ProjectedCrs:
    """The projection of a projected CRS in metres; another one is an InputError."""
    projected = require_projected_metres(crs)
    geographic = projected.geodetic_crs
    ellipsoid = projected.ellipsoid
    if geographic is None or ellipsoid is None:
        raise InputError(f"CRS {crs_label(crs)!r} has no ellipsoid; a projected CRS of the earth is needed")
    # A pyproj Transformer keeps one PROJ object per thread.
    transformer = Transformer.from_crs(projected, geographic, always_xy=True)
    flattening = 1.0 / ellipsoid.inverse_flattening if ellipsoid.inverse_flattening else 0.0
    unit = geographic.axis_info[0].unit_conversion_factor
    body = Ellipsoid(ellipsoid.semi_major_metre, flattening * (2.0 - flattening))
    sphere = _sphere_of(projected, body.a) if body.e2 > EARTHLIKE else None
    return ProjectedCrs(to_geographic=transformer, unit=unit, ellipsoid=body, crs=crs, sphere=sphere)


def _sphere_of(crs: CRS, radius: float) -> Transformer:
    """The inverse of a projection as it is on a sphere."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        plain = crs.to_dict()
    for name in ("a", "b", "rf", "f", "ellps", "datum", "R"):
        plain.pop(name, None)
    flat = CRS.from_dict({**plain, "R": radius})
    return Transformer.from_crs(flat, flat.geodetic_crs, always_xy=True)


@dataclass(frozen=True)
class LocalFrame:
    """East, north, up about a point of a map: the Cartesian system in which central projection is strict.

    Heights are taken as ellipsoidal (Ecker 1991, §4.6.5): a geoid undulation that is constant over the product moves
    everything together and does no harm; where it is not, heights are converted before. (Z of the map system is
    measured along the ellipsoid's normal of each point, up of the local system along the origin's.)
    """

    crs: str
    """Projected CRS, as pyproj reads it."""
    origin_XY: tuple[float, float]
    """Map coordinates of the origin, near the product's middle, metres."""
    height: float = 0.0
    """Height of the origin, metres."""
    _projection: ProjectedCrs = field(init=False, repr=False, compare=False)
    _origin: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _R_local_earth: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        projection = projected_crs(self.crs)
        X, Y = (float(v) for v in self.origin_XY)
        at = np.array([X, Y, float(self.height)])
        lon, lat = projection.radians(at)
        if not (np.isfinite(at).all() and np.isfinite([lon, lat]).all()):
            raise InputError(
                f"origin X {X}, Y {Y}, height {self.height} has no position in {crs_label(self.crs)}; are the "
                "coordinates in this CRS?"
            )
        projection.map(lon, lat)
        s, c, S, C = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
        object.__setattr__(self, "origin_XY", (X, Y))
        object.__setattr__(self, "_projection", projection)
        object.__setattr__(self, "_origin", projection.geocentric(at)[0])
        R = np.array([[-s, c, 0.0], [-S * c, -S * s, C], [C * c, C * s, S]])
        object.__setattr__(self, "_R_local_earth", R)

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """The same as `to_local`."""
        return self.to_local(XYZ)

    def to_local(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y and height to east, north, up; shapes (..., 3), metres; NaN where the projection ends."""
        earth, _ = self._projection.geocentric(np.asarray(XYZ, float))
        return (earth - self._origin) @ self._R_local_earth.T

    def to_map(self, enu: ArrayLike) -> NDArray[np.float64]:
        """East, north, up to map X, Y and height; inverse of `to_local` (to the rounding of coordinates, 1e-9 m)."""
        return self._projection.from_geocentric(np.asarray(enu, float) @ self._R_local_earth + self._origin)

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """The same as `to_map`."""
        return self.to_map(displaced)

    @property
    def R_local_earth(self) -> NDArray[np.float64]:
        """Takes geocentric axes to east, north, up, shape (3, 3)."""
        return self._R_local_earth

    def to_geocentric(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y and ellipsoidal height to geocentric coordinates of the map's own datum; shapes (..., 3)."""
        return self._projection.geocentric(np.asarray(XYZ, float))[0]

    def from_geocentric(self, xyz: ArrayLike) -> NDArray[np.float64]:
        """Geocentric coordinates of the map's own datum to map X, Y and ellipsoidal height; shapes (..., 3)."""
        return self._projection.from_geocentric(np.asarray(xyz, float))

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(east, north, up) / ∂(X, Y, height), shape (..., 3, 3), to 1e-10.

        The last column is the ellipsoid's normal, exactly: heights are straight lines.
        """
        XYZ = np.asarray(XYZ, float)
        step = np.zeros((4, *(1,) * (XYZ.ndim - 1), 3))
        step[0, ..., 0], step[1, ..., 0], step[2, ..., 1], step[3, ..., 1] = _REACH, -_REACH, _REACH, -_REACH
        around, _ = self._projection.geocentric(XYZ + step)
        _, up = self._projection.geocentric(XYZ)
        J = np.stack([around[0] - around[1], around[2] - around[3], up * (2.0 * _REACH)], axis=-1) / (2.0 * _REACH)
        return np.asarray(self._R_local_earth @ J, float)

    def axes(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """R_local_map (..., 3, 3): the map's axes at a station — grid east, grid north, height — in the local system.

        Angles of an exterior orientation that refer to the map grid at the station are multiplied from the left by
        it. It holds the meridian convergence and the tilt of the station's horizon. Grid east is taken at right
        angles to grid north, which makes no difference in a conformal projection.
        """
        at = np.array(XYZ, float)
        # Grid north is a direction on the ellipsoid; at 10 km it would differ by 1e-8.
        at[..., 2] = 0.0
        J = self.jacobian(at)
        up = J[..., 2]
        north = J[..., 1] - (J[..., 1] * up).sum(axis=-1, keepdims=True) * up
        north /= np.linalg.norm(north, axis=-1, keepdims=True)
        return np.stack([np.cross(north, up), north, up], axis=-1)

    def scale(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Scale of the map at points (..., 2): length in the map over length on the ellipsoid, along grid north."""
        XY = np.asarray(XY, float)
        at = np.concatenate([XY, np.zeros((*XY.shape[:-1], 1))], axis=-1)
        return 1.0 / np.linalg.norm(self.jacobian(at)[..., 1], axis=-1)


def earth_radius(crs: str, XY: ArrayLike) -> float:
    """Mean radius of curvature (Gauss) of the ellipsoid at a map point (2,), metres."""
    projection = projected_crs(crs)
    _, lat = projection.radians(np.asarray(XY, float))
    a, e2 = projection.ellipsoid.a, projection.ellipsoid.e2
    return float(a * math.sqrt(1.0 - e2) / (1.0 - e2 * np.sin(lat) ** 2))


#: Semi-axes of WGS 84, metres.
EARTH_RADII = (6_378_137.0, 6_356_752.314245179)
#: Half the distance over which derivatives are taken, metres, and of small bodies as a part of their radius.
_REACH_BODY, _PART = 100.0, 2e-5
#: Radii of what a file and a CRS call the same body agree to this part.
_SAME = 0.01


@dataclass(frozen=True)
class BodyGround:
    """Ground coordinates of a project in the axes of its body: metres, z towards the pole, x towards longitude 0.

    On earth the axes are those of WGS 84, with the CRS's own operation to them; elsewhere those of the CRS's own datum.
    """

    crs: str
    """Projected CRS of the ground."""
    heights: str
    """Height system of the ground."""
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres, as the file of the image states them."""
    _geodetic: GeodeticGround | None = field(init=False, repr=False, compare=False)
    _own: ProjectedCrs = field(init=False, repr=False, compare=False)
    _wgs84: Ellipsoid = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ellipsoid = require_projected_metres(self.crs).ellipsoid
        radius = 0.0 if ellipsoid is None else ellipsoid.semi_major_metre
        if abs(radius - self.radii[0]) > _SAME * self.radii[0]:
            raise InputError(
                f"the image shows a body of radius {self.radii[0] / 1000:.1f} km, but the project's CRS "
                f"{crs_label(self.crs)!r} lies on one of {radius / 1000:.1f} km; state a CRS of the right body"
            )
        earth = abs(radius - EARTH_RADII[0]) < _SAME * EARTH_RADII[0]
        object.__setattr__(self, "_geodetic", GeodeticGround(self.crs, self.heights) if earth else None)
        object.__setattr__(self, "_own", projected_crs(self.crs))
        object.__setattr__(self, "_wgs84", Ellipsoid.of_radii(*EARTH_RADII))

    @property
    def bare(self) -> BodyGround:
        """The same with heights above the ellipsoid."""
        return self if self.heights == "ellipsoidal" else BodyGround(self.crs, "ellipsoidal", self.radii)

    @property
    def on_earth(self) -> bool:
        """Return whether the body is the earth."""
        return self._geodetic is not None

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y and height (..., 3) to the body's axes (..., 3); NaN where the CRS has no place."""
        if self._geodetic is None:
            return self._own.geocentric(np.asarray(XYZ, float))[0]
        at = self._geodetic(XYZ)
        return self._wgs84.geocentric(np.radians(at[..., 0]), np.radians(at[..., 1]), at[..., 2])[0]

    def ellipsoidal(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Height above the body's ellipsoid (...) of map points with height (..., 3), metres."""
        return np.asarray(XYZ, float)[..., 2] if self._geodetic is None else self._geodetic.ellipsoidal(XYZ)

    def to_map(self, xyz: ArrayLike) -> NDArray[np.float64]:
        """The inverse of a call."""
        xyz = np.asarray(xyz, float)
        if self._geodetic is None:
            return self._own.from_geocentric(xyz)
        lon, lat, h = self._wgs84.geodetic(xyz)
        return self._geodetic.to_map(np.stack([np.degrees(lon), np.degrees(lat), h], axis=-1))

    def height(self, xyz: ArrayLike) -> NDArray[np.float64]:
        """Height above the body's ellipsoid (...) of points in its axes (..., 3), metres."""
        return self.ellipsoid.geodetic(np.asarray(xyz, float))[2]

    @property
    def ellipsoid(self) -> Ellipsoid:
        """The body's, whose middle and axes are those of the body."""
        return self._own.ellipsoid if self._geodetic is None else self._wgs84

    @property
    def reach(self) -> float:
        """Half the distance over which the map hardly bends, metres: for derivatives."""
        return min(_REACH_BODY, _PART * self.radii[0])

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y, z) / ∂(X, Y, height), shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        steps = self.reach * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
        around = self(XYZ[..., None, :] + steps)
        return np.asarray(np.moveaxis(around[..., ::2, :] - around[..., 1::2, :], -2, -1) / (2 * self.reach))


_Floats = NDArray[np.float64]
#: Degrees of polynomials that are tried, and the height at which the second of them lies, metres.
_DEGREES, _HIGH = (5, 7, 9), 10_000.0
#: What polynomials may leave, in the rounding of the body's radius: there is no more in what they replace.
_ROUNDED = 8 * np.finfo(float).eps
#: Points that are computed together.
_TOGETHER = 16_384
#: Metres by which rounding moves nothing.
_LARGE = 1e-6


@dataclass(frozen=True, eq=False)
class NearGround:
    """Map X, Y and height to the axes of a body, from an origin on the ground.

    A place in the axes of the earth is rounded several times on its way from the map, by 1e-9 m and more each time; of
    a camera that is thrown about, a row more or less is several columns. Around the origin polynomials of the map lead
    to the same places, from the origin, to 1e-11 m of a smooth surface. Further away, and where no polynomial is as
    exact as the coordinates are (wide areas, grids in the way), it is the difference of the rounded places.
    """

    ground: BodyGround
    middle: _Floats
    """Map X and Y (2,) around which polynomials hold."""
    reach: float
    """Largest distance from it along X and along Y, metres."""
    origin: _Floats
    """Place there in the axes of the body, (3,)."""
    coefficients: _Floats | None
    """Polynomials of X, Y, Z on the ellipsoid and of their change up to 10 km above it, (terms, 6), if any."""

    def __call__(self, XYZ: ArrayLike) -> _Floats:
        """Map X, Y and height (n, 3) to the axes of the body, from the origin (n, 3); NaN where the CRS has
        no place.
        """
        XYZ = np.asarray(XYZ, float)
        near = self._is_near(XYZ)
        out = np.empty_like(XYZ)
        if not near.all():
            out[~near] = self.ground(XYZ[~near]) - self.origin
        some = np.flatnonzero(near)
        for first in range(0, len(some), _TOGETHER):
            mine = some[first : first + _TOGETHER]
            out[mine] = self._places(XYZ[mine])
        return out

    def sharpened(self, point: _Floats, S: _Floats, d: _Floats) -> _Floats:
        """Map points (n, 3) where rays meet their heights, without the rounding of the way there.

        `S` and `d` are origins, from the own origin, and unit directions of the rays, each (n, 3).
        """
        near = self._is_near(point)
        if not near.any():
            return point
        assert self.coefficients is not None
        # The terms of first degree are the second and third; rounding is turned well enough by those in the middle.
        by_x, by_y = self.coefficients[1, :3] / self.reach, self.coefficients[2, :3] / self.reach
        away, d = self(point[near]) - S[near], d[near]
        a, b = np.cross(by_y, d), np.cross(by_x, d)
        with np.errstate(divide="ignore", invalid="ignore"):
            move = -np.stack([(away * a).sum(axis=1) / (a @ by_x), (away * b).sum(axis=1) / (b @ by_y)], axis=1)
        out = point.copy()
        out[near, :2] += np.where(np.abs(move).max(axis=1, keepdims=True) < _LARGE, move, 0.0)
        return out

    def _is_near(self, XYZ: _Floats) -> NDArray[np.bool_]:
        if self.coefficients is None:
            return np.zeros(len(XYZ), bool)
        inside = (np.abs(XYZ[:, :2] - self.middle) <= self.reach).all(axis=1)
        return np.asarray(inside & np.isfinite(XYZ[:, 2]))

    def _places(self, XYZ: _Floats) -> _Floats:
        assert self.coefficients is not None
        both = _terms((XYZ[:, :2] - self.middle) / self.reach, len(self.coefficients)) @ self.coefficients
        return np.asarray(both[:, :3] + (self.ground.ellipsoidal(XYZ) / _HIGH)[:, None] * both[:, 3:])


def near_ground(ground: BodyGround, XY: _Floats) -> NearGround:
    """The surroundings of map points (n, 2), with room; NaN is left out."""
    XY = XY[np.isfinite(XY).all(axis=1)]
    if not len(XY):
        return NearGround(ground=ground, middle=np.zeros(2), reach=0.0, origin=np.zeros(3), coefficients=None)
    low, high = XY.min(axis=0), XY.max(axis=0)
    # Cameras that see nearly the same have the same.
    reach = 2.0 ** float(np.ceil(np.log2(0.7 * (high - low).max() + 1000.0)))
    x, y = (np.round((low + high) / 2 / reach * 8) * reach / 8).tolist()
    return _near(ground, x, y, reach)


@lru_cache(maxsize=64)
def _near(ground: BodyGround, x: float, y: float, reach: float) -> NearGround:
    middle = np.array([x, y])
    plain = ground.bare
    origin = plain([x, y, 0.0])

    def above(unit: _Floats) -> _Floats:
        """Places on the ellipsoid, and from there to those above, (n, 6)."""
        flat = np.column_stack([middle + reach * unit, np.zeros(len(unit))])
        foot = plain(flat)
        return np.concatenate([foot - origin, plain(flat + np.array([0.0, 0.0, _HIGH])) - foot], axis=1)

    for degree in _DEGREES if np.isfinite(origin).all() else ():
        nodes = np.cos(np.pi * (np.arange(degree + 3) + 0.5) / (degree + 3))
        unit = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
        places = above(unit)
        if not np.isfinite(places).all():
            break
        count = (degree + 1) * (degree + 2) // 2
        coefficients = np.asarray(np.linalg.lstsq(_terms(unit, count), places, rcond=None)[0], float)
        between = np.cos(np.pi * np.arange(degree + 4) / (degree + 3))
        others = np.stack(np.meshgrid(between, between), axis=-1).reshape(-1, 2)
        miss = np.abs(_terms(others, count) @ coefficients - above(others)).max()
        if miss <= _ROUNDED * ground.radii[0]:
            return NearGround(ground=ground, middle=middle, reach=reach, origin=origin, coefficients=coefficients)
    if not np.isfinite(origin).all():
        origin = np.zeros(3)
    return NearGround(ground=ground, middle=middle, reach=reach, origin=origin, coefficients=None)


def _terms(unit: _Floats, count: int) -> _Floats:
    """Products of powers (n, count) of u and v (n, 2) by rising degree: 1, u, v, u², uv, v², …"""
    u, v = unit.T
    out = np.empty((count, len(unit)))
    out[0] = 1.0
    first, degree = 0, 0
    while first + degree + 1 < count:
        after = first + degree + 1
        np.multiply(out[first:after], u, out=out[after : after + degree + 1])
        np.multiply(out[after - 1], v, out=out[after + degree + 1])
        first, degree = after, degree + 1
    return out.T


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
    """Return whether a text is the WKT of a local system, one without any relation to the earth."""
    if not text.strip().upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return False
    if split_compound(text, where)[0] is not None:
        metric_system(text, where)
    return True


def is_wgs84_geographic(text: str, where: str) -> bool:
    """Return whether a CRS is geographic on WGS 84, or on a datum that coincides with it within metres."""
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

"""Local tangential systems: true Cartesian space around a point of a map projection."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer

from photoplan.errors import InputError
from photoplan.geometry.crs import INVERTED, crs_label, inexact_projection, nearest_turn, require_projected_metres

#: Earth radius where no CRS tells a better one, metres (Ecker 1991, table 4.2).
MEAN_RADIUS = 6_380_000.0
#: Ellipsoids of the earth have a smaller squared eccentricity; what is made for the earth is checked beyond it.
EARTHLIKE = 0.01
#: Turns of the iteration for the inverse of a projection on a flattened body; one gains a digit or half of one.
_TURNS = 30
#: Half the distance over which the mapping's derivative is taken, metres: the mapping is so smooth (its third
#: derivative is of the order 1/R²) that truncation and rounding both stay below 1e-10.
_REACH = 100.0


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
    """As it was given, for messages."""
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
            for _ in range(_TURNS):
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

"""The axes of a body around a place on its map, counted from there: without the rounding of large numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.body import BodyGround

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
    """As far as this from it along X and along Y, metres."""
    origin: _Floats
    """Place there in the axes of the body, (3,)."""
    coefficients: _Floats | None
    """Of X, Y, Z on the ellipsoid and of their change up to 10 km above it, (terms, 6); None: there are none."""

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

"""Frames of targets: planes, walls and cylinders."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Doubles = NDArray[np.float64]
Triple = tuple[float, float, float]
Axes = tuple[Triple, Triple, Triple]

#: Nearest and farthest that is seen along an image, parts and multiples of the distance of its frame.
_NEAREST, _FARTHEST = 0.25, 50.0


def triple(values: _Doubles) -> Triple:
    """A vector (3,) as plain numbers."""
    a, b, c = values.tolist()
    return a, b, c


class Frame(Hashable, Protocol):
    """An invertible mapping of space. A value: hashable, and pickles."""

    @property
    def turn(self) -> float:
        """Length of a whole turn along u, metres; infinite if straight lines stay straight in the frame."""
        ...

    @property
    def heights(self) -> tuple[float, float]:
        """Between which h there is anything; infinite: everywhere."""
        ...

    def top(self, point: _Doubles) -> float:
        """Height above which a camera at a point of the frame (3,) sees nothing; a point may be NaN."""
        ...

    def __call__(self, uvh: ArrayLike) -> _Doubles:
        """Points of the frame (..., 3) to the ground, metres; NaN where there is none."""
        ...

    def inverse(self, XYZ: ArrayLike) -> _Doubles:
        """Ground points (..., 3) to the frame; NaN where it has none."""
        ...

    def jacobian(self, uvh: ArrayLike) -> _Doubles:
        """Derivative of the ground point by u, v, h, shape (..., 3, 3)."""
        ...

    def lines(self, origin: _Doubles, direction: _Doubles, height: float) -> tuple[_Doubles, _Doubles]:
        """Rays of the ground, (..., 3) each, in the frame: a point of each and its unit direction there.

        The point is that at a height where the frame bends distances or rays; NaN where the ray does not get there.
        """
        ...


@dataclass(frozen=True)
class WallFrame:
    """u along a wall to the right, v up on it, h in front of it: a rigid motion."""

    origin: Triple
    """Ground point of u = v = h = 0."""
    axes: Axes
    """Rows: directions of u, v and h on the ground."""

    @property
    def turn(self) -> float:
        """Infinite: lines stay straight."""
        return math.inf

    @property
    def heights(self) -> tuple[float, float]:
        """Everywhere."""
        return -math.inf, math.inf

    def top(self, point: _Doubles) -> float:
        """Return that of the camera."""
        return float(point[2])

    @classmethod
    def facing(cls, origin: Triple, azimuth: float, tilt: float = 0.0) -> WallFrame:
        """The frame of a plane by the azimuth of its outward normal, from north by east, and how far that is raised, °.

        u is level and points to the right of who looks at the wall; a wall of azimuth 180° and tilt 90° is the map.
        """
        (sa, ca), (st, ct) = (sine_cosine(angle) for angle in (azimuth, tilt))
        normal, right = (sa * ct, ca * ct, st), (-ca, sa, 0.0)
        x, y, z = (float(c) + 0.0 for c in np.cross(normal, right))
        return cls(origin, (right, (x, y, z), normal))

    def __call__(self, uvh: ArrayLike) -> _Doubles:
        """Points of the frame (..., 3) to the ground."""
        return np.asarray(np.asarray(uvh, float) @ np.array(self.axes) + self.origin)

    def inverse(self, XYZ: ArrayLike) -> _Doubles:
        """Ground points (..., 3) to the frame."""
        return np.asarray((np.asarray(XYZ, float) - self.origin) @ np.array(self.axes).T)

    def jacobian(self, uvh: ArrayLike) -> _Doubles:
        """Derivative of the ground point, the same everywhere, shape (..., 3, 3)."""
        return np.broadcast_to(np.array(self.axes).T, (*np.shape(uvh), 3))

    def lines(self, origin: _Doubles, direction: _Doubles, height: float) -> tuple[_Doubles, _Doubles]:
        """Their origins and directions in the frame."""
        return self.inverse(origin), direction @ np.array(self.axes).T


@dataclass(frozen=True)
class ImageFrame:
    """Along the rays of a central image: u, v on its plane at a distance D, and h even in parallax.

    XYZ = C + Rᵀ (u, v, −D) / (1 + h / D): a projective mapping that takes the image's centre to infinity. Near h = 0 a
    metre of h is a metre towards the image; planes of constant h across its axis differ by constant parallax.
    """

    origin: Triple
    """Projection centre C."""
    axes: Axes
    """Rows: directions of the image's axes on the ground, the third one against its view."""
    distance: float
    """D, metres along the axis."""

    @property
    def turn(self) -> float:
        """Infinite: lines stay straight."""
        return math.inf

    @property
    def heights(self) -> tuple[float, float]:
        """From 50 times the distance to a quarter of it."""
        return tuple(self.distance * (1 / part - 1) for part in (_FARTHEST, _NEAREST))  # type: ignore[return-value]

    def top(self, point: _Doubles) -> float:
        """Return that of the camera, if it is in front."""
        return float(np.fmin(point[2], self.heights[1]))

    def __call__(self, uvh: ArrayLike) -> _Doubles:
        """Points of the frame (..., 3) to the ground; NaN at and beyond infinity, h ≤ −D."""
        uvh = np.asarray(uvh, float)
        nearer = self._nearer(uvh)
        p = np.concatenate([uvh[..., :2], np.full_like(uvh[..., 2:], -self.distance)], axis=-1) / nearer
        return np.asarray(p @ np.array(self.axes) + self.origin)

    def inverse(self, XYZ: ArrayLike) -> _Doubles:
        """Ground points (..., 3) to the frame; NaN at and behind the image's centre."""
        p = (np.asarray(XYZ, float) - self.origin) @ np.array(self.axes).T
        nearer = self.distance / np.where(p[..., 2:] < 0, -p[..., 2:], np.nan)
        return np.concatenate([p[..., :2] * nearer, self.distance * (nearer - 1)], axis=-1)

    def jacobian(self, uvh: ArrayLike) -> _Doubles:
        """Derivative of the ground point, shape (..., 3, 3)."""
        uvh = np.asarray(uvh, float)
        nearer = self._nearer(uvh)[..., None]
        J = np.zeros((*uvh.shape, 3))
        J[..., 0, 0] = J[..., 1, 1] = 1.0
        J[..., :2, 2] = -uvh[..., :2] / (self.distance * nearer[..., 0])
        J[..., 2, 2] = 1.0 / nearer[..., 0, 0]
        return np.asarray(np.array(self.axes).T @ (J / nearer))

    def lines(self, origin: _Doubles, direction: _Doubles, height: float) -> tuple[_Doubles, _Doubles]:
        """Their points at a height and directions there; NaN where they begin beyond it."""
        towards = np.array(self.axes)[2]
        depth = self.distance / (1.0 + height / self.distance) if height > -self.distance else np.nan
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -(depth + (origin - self.origin) @ towards) / (direction @ towards)
            points = self.inverse(origin + np.where(along > 0, along, np.nan)[..., None] * direction)
            ways = np.linalg.solve(self.jacobian(points), direction[..., None])[..., 0]
            return points, ways / np.linalg.norm(ways, axis=-1, keepdims=True)

    def _nearer(self, uvh: _Doubles) -> _Doubles:
        """Return how many times nearer than the distance points lie, shape (..., 1)."""
        nearer = 1.0 + uvh[..., 2:] / self.distance
        return np.where(nearer > 0, nearer, np.nan)


def sine_cosine(degrees: float) -> tuple[float, float]:
    """Return sine and cosine of an angle; exact for quarters of a circle."""
    quarter, rest = divmod(degrees, 90.0)
    s, c = math.sin(math.radians(rest)), math.cos(math.radians(rest))
    for _ in range(int(quarter) % 4):
        s, c = c, -s
    return s, c


#: Nearest to the axis that there is anything, part of the radius.
_NEAREST_CYLINDER = 0.1


@dataclass(frozen=True)
class CylinderFrame:
    """u along the arc, v along the axis, h towards who looks: to the axis from inside, away from it from outside.

    u is an angle times the radius, so that metres of it are metres of the object at h = 0. Straight rays are bent here.
    """

    origin: Triple
    """A point of the axis, where v = 0."""
    axis: Triple
    """Direction of v, of length 1."""
    middle: Triple
    """Direction from the axis to u = 0, across it, of length 1."""
    radius: float
    """Metres."""
    inside: bool
    """Whether it is seen from inside."""

    @classmethod
    def vault(cls, origin: Triple, azimuth: float, radius: float, tilt: float = 0.0) -> CylinderFrame:
        """From inside: an axis of an azimuth, from north by east, that rises by a tilt, °; u = 0 is uppermost."""
        (sa, ca), (st, ct) = (sine_cosine(angle) for angle in (azimuth, tilt))
        return cls(origin, (sa * ct, ca * ct, st), (-sa * st, -ca * st, ct), radius, True)

    @classmethod
    def column(cls, origin: Triple, azimuth: float, radius: float) -> CylinderFrame:
        """From outside: an axis that stands upright; the surface faces an azimuth where u = 0."""
        sa, ca = sine_cosine(azimuth)
        return cls(origin, (0.0, 0.0, 1.0), (sa, ca, 0.0), radius, False)

    @property
    def turn(self) -> float:
        """Circumference."""
        return 2 * math.pi * self.radius

    @property
    def heights(self) -> tuple[float, float]:
        """From inside up to the axis but for a tenth of the radius, from outside down to there."""
        most = (1 - _NEAREST_CYLINDER) * self.radius
        return (-math.inf, most) if self.inside else (-most, math.inf)

    def top(self, point: _Doubles) -> float:
        """From inside one sees across the axis what is above oneself."""
        return self.heights[1] if self.inside else float(point[2])

    def __call__(self, uvh: ArrayLike) -> _Doubles:
        """Points of the frame (..., 3) to the ground; NaN at the axis."""
        uvh = np.asarray(uvh, float)
        out, _ = self._around(uvh[..., 0])
        return np.asarray(self.origin + self._r(uvh[..., 2])[..., None] * out + uvh[..., 1:2] * np.array(self.axis))

    def inverse(self, XYZ: ArrayLike) -> _Doubles:
        """Ground points (..., 3) to the frame, u up to half a turn to either side."""
        p = np.asarray(XYZ, float) - self.origin
        x, y = p @ np.array(self.middle), p @ self._right
        h = (np.hypot(x, y) - self.radius) * (-1.0 if self.inside else 1.0)
        return np.stack([np.arctan2(y, x) * self.radius, p @ np.array(self.axis), h], axis=-1)

    def jacobian(self, uvh: ArrayLike) -> _Doubles:
        """Derivative of the ground point, shape (..., 3, 3)."""
        uvh = np.asarray(uvh, float)
        out, along = self._around(uvh[..., 0])
        by_u = along * (self._r(uvh[..., 2]) / self.radius)[..., None]
        return np.stack([by_u, np.broadcast_to(self.axis, out.shape), -out if self.inside else out], axis=-1)

    def lines(self, origin: _Doubles, direction: _Doubles, height: float) -> tuple[_Doubles, _Doubles]:
        """Return where rays meet a height (from inside as they leave it, else as they come), and their directions."""
        r = float(self._r(np.array(height)))
        axis = np.array(self.axis)
        p, d = origin - self.origin, direction
        p, d = (a - (a @ axis)[..., None] * axis for a in (p, d))
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b, c = ((x * y).sum(axis=-1) for x, y in ((d, d), (p, d), (p, p)))
            root = np.sqrt(b * b - a * (c - r * r))
            along = (-b + root if self.inside else -b - root) / a
            points = self.inverse(origin + np.where(along > 0, along, np.nan)[..., None] * direction)
            ways = np.linalg.solve(self.jacobian(points), direction[..., None])[..., 0]
            return points, ways / np.linalg.norm(ways, axis=-1, keepdims=True)

    @property
    def _right(self) -> _Doubles:
        """Direction of u where it is 0."""
        right = np.cross(self.axis, self.middle)
        return -right if self.inside else right

    def _around(self, u: _Doubles) -> tuple[_Doubles, _Doubles]:
        """Directions away from the axis and along u, (..., 3) each."""
        s, c = (f(u / self.radius)[..., None] for f in (np.sin, np.cos))
        middle, right = np.array(self.middle), self._right
        return c * middle + s * right, c * right - s * middle

    def _r(self, h: _Doubles) -> _Doubles:
        """Distances from the axis; NaN at and beyond it."""
        r = self.radius - h if self.inside else self.radius + h
        return np.where(r > 0, r, np.nan)

"""A frame over a cylinder: a vault from inside, a column from outside."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.frames import Triple, sine_cosine

_Doubles = NDArray[np.float64]

#: Nearest to the axis that there is anything, part of the radius.
_NEAREST = 0.1


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
    def heights(self) -> tuple[float, float]:
        """From inside up to the axis but for a tenth of the radius, from outside down to there."""
        most = (1 - _NEAREST) * self.radius
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
        """Where rays meet a height, from inside as they leave it, from outside as they come; their directions there."""
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

"""The sun as a projection: parallel rays, so that what it does not see lies in cast shadow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Side of an image that holds every place of a map, pixels of the map's unit.
_SIDE = 1 << 30


@dataclass(frozen=True)
class SunProjection:
    """Ground along the sun's rays onto a plane across them; 1 pixel is a metre."""

    direction: tuple[float, float, float]
    """Unit vector towards the sun: east, north, up."""

    @property
    def size(self) -> tuple[int, int]:
        """Larger than any map."""
        return _SIDE, _SIDE

    field: ClassVar[None] = None
    """Rays are straight."""
    breaks: ClassVar[None] = None
    """They have no breaks."""

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to (x, y, 1)."""
        east, north, _ = self.direction
        level = math.hypot(east, north)
        right = (north / level, -east / level, 0.0) if level > 1e-9 else (1.0, 0.0, 0.0)
        # Down in the image: away from the zenith, across the rays.
        down = np.cross(right, self.direction)
        XYZ = np.asarray(XYZ, float)
        x, y = (XYZ @ np.asarray(axis) + _SIDE / 2 for axis in (right, down))
        return np.stack([x, y, np.ones_like(x)], axis=-1)

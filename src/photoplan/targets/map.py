"""The orthophoto's target: a map grid with height as depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import MapGrid, Placement, Window


@dataclass(frozen=True)
class MapTarget:
    """(u, v) is a pixel of a map grid, h the height."""

    grid: MapGrid

    @property
    def window(self) -> Window:
        """All pixels of the product."""
        return self.grid.window

    @property
    def breaks(self) -> None:
        """A map is nowhere bent."""
        return None

    @property
    def placement(self) -> Placement:
        """The grid's."""
        return self.grid.placement

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        """(u, v, h) of shape (..., 3) to X, Y, Z."""
        uvh = np.asarray(uvh, float)
        return np.concatenate([self.grid.to_map(uvh[..., :2]), uvh[..., 2:]], axis=-1)

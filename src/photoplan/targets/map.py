"""Targets in general, and the map: pixels (u, v) with depth h, and where they lie on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Breaks, MapGrid, Placement, Window


class Target(Protocol):
    """The product's own coordinates: pixel (u, v) = (column, row) and depth h, and where they are on the ground."""

    @property
    def window(self) -> Window:
        """All pixels of the product."""
        ...

    @property
    def breaks(self) -> Breaks | None:
        """Columns and rows, in pixels, at which `to_ground` is bent (facets of a profile); None: nowhere."""
        ...

    @property
    def placement(self) -> Placement:
        """Where they lie in the product's own plane: on the map, on a wall; what its file states."""
        ...

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        """(u, v, h) of shape (..., 3) to ground X, Y, Z of the same shape."""
        ...


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

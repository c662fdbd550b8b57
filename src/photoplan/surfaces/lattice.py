"""Posts of a surface below a product: what lines of sight are followed over."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import MapGrid, Window
from photoplan.targets.base import Target
from photoplan.targets.map import MapTarget


class _Relief(Protocol):
    def relief(self, target: Target, window: Window) -> NDArray[np.float32]: ...


@dataclass(frozen=True, eq=False)
class Lattice:
    """A raster of heights, bilinear in between, and where the pixels of a map are in it."""

    origin: NDArray[np.float64]
    """Column and row of the centre of the map's first pixel, shape (2,)."""
    steps: NDArray[np.float64]
    """What a column and a row of the map are in its columns and rows, shape (2, 2): origin + steps @ (u, v)."""
    read: Callable[[Window], NDArray[np.float32]]
    """Heights of a window, shape (height, width), metres; NaN where there is none, and beyond the surface."""

    @classmethod
    def of_relief(cls, surface: _Relief, grid: MapGrid, parts: float = 1.0) -> Lattice:
        """Relief of a surface at the pixels of a map, each cut into at least so many parts along a side.

        Their number is odd: the middle one has the centre of the pixel.
        """
        times = max(1, math.ceil(parts)) | 1
        finer = MapTarget(
            MapGrid(left=grid.left, top=grid.top, resolution=grid.resolution / times, width=1, height=1, crs=grid.crs)
        )
        return cls(np.full(2, (times - 1) / 2), times * np.eye(2), lambda window: surface.relief(finer, window))

    @property
    def per_pixel(self) -> float:
        """Posts along a pixel, at most."""
        return float(np.linalg.norm(self.steps, axis=0).max())

    def at(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Column and row of places (..., 2) of the map, given in its pixels."""
        return np.asarray(self.origin + np.asarray(uv, float) @ self.steps.T)

    def to_pixels(self, posts: ArrayLike) -> NDArray[np.float64]:
        """Inverse of `at`."""
        return np.asarray((np.asarray(posts, float) - self.origin) @ np.linalg.inv(self.steps).T)

    def around(self, pixels: Window) -> Window:
        """Posts around all centres of a window of the map."""
        (right, bottom) = (end - 1 for end in pixels.stop)
        corners = self.at([(u, v) for u in (pixels.col, right) for v in (pixels.row, bottom)])
        (col, row), (east, south) = np.floor(corners.min(axis=0)), np.floor(corners.max(axis=0)) + 2
        return Window(int(col), int(row), int(east - col), int(south - row))

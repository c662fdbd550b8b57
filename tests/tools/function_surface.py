"""A surface that is a function: the truth of many tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from photoplan.surfaces.raster import RasterSurface


@dataclass(frozen=True)
class FunctionSurface:
    """Z = function(X, Y); NaN = no surface."""

    function: Callable

    def heights(self, XY):
        XY = np.asarray(XY, float)
        return np.asarray(self.function(XY[..., 0], XY[..., 1]), float) + np.zeros(XY.shape[:-1])

    def relief(self, target, window):
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]]
        return self.heights(target.grid.to_map(np.stack([u, v], axis=-1))).astype(np.float32)

    def height_range(self, bounds):
        x, y = np.meshgrid(np.linspace(bounds[0], bounds[2], 65), np.linspace(bounds[1], bounds[3], 65))
        z = self.heights(np.stack([x, y], axis=-1))
        return float(np.nanmin(z)), float(np.nanmax(z))


@dataclass(frozen=True, eq=False)
class ArrayGrid:
    """Posts in memory."""

    heights: np.ndarray

    @property
    def size(self):
        return self.heights.shape[1], self.heights.shape[0]

    def read(self, window):
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]]


def raster_surface(heights, left: float, top: float, mesh: float) -> RasterSurface:
    """Posts (rows from north to south) whose upper-left one lies at left, top."""
    return RasterSurface(ArrayGrid(np.asarray(heights, np.float32)), (left, top), (mesh, mesh))

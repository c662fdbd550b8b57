"""A surface that is a function: the truth of many tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from photoplan.surfaces.base import Hits, Lattice
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
        bounds = np.asarray(bounds, float)
        part = np.linspace(0, 1, 65)
        x = bounds[..., None, 0:1] + part * (bounds[..., None, 2:3] - bounds[..., None, 0:1])
        y = bounds[..., 1:2, None] + part[:, None] * (bounds[..., 3:4, None] - bounds[..., 1:2, None])
        z = self.heights(np.stack(np.broadcast_arrays(x, y), axis=-1)).reshape(*bounds.shape[:-1], -1)
        return np.stack([np.fmin.reduce(z, axis=-1), np.fmax.reduce(z, axis=-1)], axis=-1)

    def lattice(self, grid, window):
        return Lattice.of_relief(self, grid)

    def first_hit(self, paths, bend=0.0):
        """Paths looked at in 4000 places of each piece, then halved: nothing thinner than a step is seen."""
        assert not bend
        paths = np.asarray(paths, float)
        hits = Hits.none(len(paths))
        for i, path in enumerate(paths):
            t = np.linspace(0, len(path) - 1, 4000 * (len(path) - 1) + 1)
            at = np.minimum(t.astype(int), len(path) - 2)

            def point(t, at, path=path):
                return path[at] + (t - at)[..., None] * (path[at + 1] - path[at])

            above = self._above(point(t, at))
            k = np.flatnonzero((above[:-1] >= 0) & (above[1:] < 0))[:1]
            if len(k):
                a, b, at = t[k], t[k + 1], at[k]
                for _ in range(50):
                    middle = (a + b) / 2
                    under = self._above(point(middle, at)) < 0
                    a, b = np.where(under, a, middle), np.where(under, middle, b)
                hits.XYZ[i], hits.along[i], hits.result[i] = point(a, at)[0], a[0], 1
        return hits

    def _above(self, XYZ):
        return XYZ[..., 2] - self.heights(XYZ[..., :2])


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

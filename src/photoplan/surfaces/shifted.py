"""A surface carried into another height system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.lattice import Lattice
from photoplan.surfaces.rays import Hits, chords
from photoplan.targets.base import Target


@dataclass(frozen=True)
class ShiftedSurface:
    """A surface plus a smooth shift of heights, such as the geoid's height above the ellipsoid."""

    surface: Terrain
    shift: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """What is added to the heights at map points (..., 2), metres, shape (...). It is evaluated at nine points of a
    tile and bilinear between them: a geoid bends by less than a millimetre over a tile."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Relief of the surface with the shift added; NaN where there is no surface."""
        nodes = self.shift(target.to_ground(_nodes(window))[..., :2])
        return _raised(self.surface.relief(target, window), nodes, window)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """That of the surface, with the shift added."""
        own = self.surface.lattice(grid, window)

        def read(part: Window) -> NDArray[np.float32]:
            nodes = self.shift(grid.to_map(own.to_pixels(_nodes(part)[..., :2])))
            return _raised(own.read(part), nodes, part)

        return replace(own, read=read)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at map points (..., 2) with the shift added."""
        XY = np.asarray(XY, float)
        return self.surface.heights(XY) + self.shift(XY)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Range of the surface in map bounds (..., 4), widened by the range of the shift at corners and middle."""
        bounds = np.asarray(bounds, float)
        part = np.array([0.0, 0.5, 1.0])
        x = bounds[..., None, 0:1] + part * (bounds[..., None, 2:3] - bounds[..., None, 0:1])
        y = bounds[..., 1:2, None] + part[:, None] * (bounds[..., 3:4, None] - bounds[..., 1:2, None])
        shift = self.shift(np.stack(np.broadcast_arrays(x, y), axis=-1)).reshape(*bounds.shape[:-1], 9)
        return self.surface.height_range(bounds) + np.stack([shift.min(axis=-1), shift.max(axis=-1)], axis=-1)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Where rays first come down onto the surface; see `Terrain.first_hit`."""
        given = np.asarray(paths, float)
        fine, carried = chords(given, bend, self._lowered)
        hits = self.surface.first_hit(carried)
        there = np.isfinite(hits.along)
        hits.XYZ[there, 2] += self.shift(hits.XYZ[there, :2])
        hits.along[there] *= (given.shape[1] - 1) / (fine.shape[1] - 1)
        return hits

    def _lowered(self, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points as the surface that was shifted has them."""
        return np.concatenate([XYZ[..., :2], XYZ[..., 2:] - self.shift(XYZ[..., :2])[..., None]], axis=-1)


def _nodes(window: Window) -> NDArray[np.float64]:
    """(u, v, 0) of nine places over a window, from its first to its last pixel, shape (3, 3, 3)."""
    u = np.linspace(window.col, window.stop[0] - 1, 3)
    v = np.linspace(window.row, window.stop[1] - 1, 3)
    return np.stack([*np.meshgrid(u, v), np.zeros((3, 3))], axis=-1)


def _raised(heights: NDArray[np.float32], shift: NDArray[np.float64], window: Window) -> NDArray[np.float32]:
    """Heights of a window with a shift added that is bilinear between its nodes."""
    u, v, _ = _nodes(window).T
    along_v = np.arange(window.row, window.stop[1])
    along_u = np.arange(window.col, window.stop[0])
    columns = np.stack([np.interp(along_v, v[0], shift[:, i]) for i in range(3)], axis=1)
    full = np.stack([np.interp(along_u, u[:, 0], row) for row in columns])
    return (heights + full).astype(np.float32)

"""A surface of one height: flat ground, a water level, or a test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.lattice import Lattice
from photoplan.surfaces.rays import Hits, TerrainPart, follow
from photoplan.targets.base import Target


@dataclass(frozen=True)
class LevelSurface:
    """The same height everywhere."""

    height: float
    """Metres."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """The height for every pixel of the window, shape (height, width)."""
        return np.full((window.height, window.width), self.height, np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """The height at map points (..., 2), shape (...)."""
        return np.full(np.asarray(XY).shape[:-1], self.height)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """The height, twice, for map bounds (..., 4)."""
        return np.full((*np.shape(bounds)[:-1], 2), self.height)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """The pixels of the map."""
        return Lattice.of_relief(self, grid)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Where rays first come down to the height; see `Terrain.first_hit`."""
        at = np.asarray(paths, float).reshape(-1, np.shape(paths)[-1])[:, :2]
        low, high = np.fmin.reduce(at, axis=0, initial=np.inf), np.fmax.reduce(at, axis=0, initial=-np.inf)
        if not np.isfinite([low, high]).all():
            low, high = np.zeros(2), np.zeros(2)
        inside = (float(low[0]) - 1, float(low[1]) - 1, float(high[0]) + 1, float(high[1]) + 1)
        return follow(LevelParts(self, inside), paths, bend)


@dataclass(frozen=True)
class LevelParts:
    """A level as one part for rays, a single mesh below all of them."""

    surface: LevelSurface
    inside: tuple[float, float, float, float]
    """Its bounds."""

    @property
    def corner(self) -> tuple[float, float]:
        """X, Y of its upper-left corner."""
        return self.inside[0], self.inside[3]

    @property
    def step(self) -> tuple[float, float]:
        """Its width and height, metres."""
        return self.inside[2] - self.inside[0], self.inside[3] - self.inside[1]

    def ranges(self, window: Window) -> NDArray[np.float64]:
        """The height, twice, shape (height, width, 2)."""
        return np.full((window.height, window.width, 2), self.surface.height)

    def range(self, column: int, row: int) -> NDArray[np.float64]:
        """The height, twice."""
        return np.full(2, self.surface.height)

    def part(self, column: int, row: int) -> TerrainPart:
        """The mesh."""
        return TerrainPart(self.corner, self.step, np.zeros((2, 2), np.float32), self.surface.height)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """The height at points."""
        return self.surface.heights(XY)

"""Terrain under a level of water: a lake or a sea, also where the terrain has no heights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.lattice import Lattice
from photoplan.surfaces.level import LevelSurface
from photoplan.surfaces.objects import ObjectSurface
from photoplan.surfaces.rays import Hits
from photoplan.targets.base import Target


@dataclass(frozen=True, eq=False)
class FloodedSurface:
    """The terrain where it is higher than the water, else the water."""

    ground: Terrain
    level: float
    """Height of the water, metres."""
    bounds: tuple[float, float, float, float] | None
    """Map bounds xmin, ymin, xmax, ymax beyond which there is no water; None: it has no end."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixels of a window of a map target; NaN where there is neither ground nor water."""
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        XYZ = target.to_ground(np.stack([u, v, np.zeros_like(u)], axis=-1))
        return self._raised(self.ground.relief(target, window), XYZ).astype(np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """As `relief`, at map points (..., 2), shape (...)."""
        XY = np.asarray(XY, float)
        return self._raised(self.ground.heights(XY), XY)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of ground and water inside map bounds (..., 4), shape (..., 2)."""
        return np.asarray(np.fmax(self.ground.height_range(bounds), self.level))

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """The pixels of the map."""
        return Lattice.of_relief(self, grid)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """What rays meet first: the ground, as `Terrain.first_hit` has it, or the water, whose Z is `level`."""
        ground, water = self.ground.first_hit(paths, bend), LevelSurface(self.level).first_hit(paths, bend)
        first = ~(ground.along <= water.along) & np.isfinite(water.along) & self._inside(water.XYZ)
        water.XYZ[:, 2] = self.level
        for name, values in vars(ground).items():
            values[first] = getattr(water, name)[first]
        return ground

    def _inside(self, XY: NDArray[np.float64]) -> NDArray[np.bool_]:
        if self.bounds is None:
            return np.ones(XY.shape[:-1], bool)
        xmin, ymin, xmax, ymax = self.bounds
        X, Y = XY[..., 0], XY[..., 1]
        return (xmin <= X) & (xmax >= X) & (ymin <= Y) & (ymax >= Y)

    def _raised(self, heights: NDArray[np.floating], XY: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(self._inside(XY), np.fmax(heights, self.level), heights)


def flooded(terrain: Terrain, level: float, bounds: tuple[float, float, float, float] | None) -> Terrain:
    """Terrain under water of a level, metres; objects stand in it."""
    if isinstance(terrain, ObjectSurface):
        return replace(terrain, ground=FloodedSurface(terrain.ground, level, bounds))
    return FloodedSurface(terrain, level, bounds)

"""A surface carried into another height system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Window
from photoplan.surfaces.base import Surface
from photoplan.targets.base import Target


@dataclass(frozen=True)
class ShiftedSurface:
    """A surface plus a smooth shift of heights, such as the geoid's height above the ellipsoid."""

    surface: Surface
    shift: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """What is added to the heights at map points (..., 2), metres, shape (...). It is evaluated at nine points of a
    tile and bilinear between them: a geoid bends by less than a millimetre over a tile."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Relief of the surface with the shift added; NaN where there is no surface."""
        relief = self.surface.relief(target, window)
        u = np.linspace(window.col, window.stop[0] - 1, 3)
        v = np.linspace(window.row, window.stop[1] - 1, 3)
        uvh = np.stack([*np.meshgrid(u, v), np.zeros((3, 3))], axis=-1)
        nodes = self.shift(target.to_ground(uvh)[..., :2])
        along_v = np.arange(window.row, window.stop[1])
        along_u = np.arange(window.col, window.stop[0])
        columns = np.stack([np.interp(along_v, v, nodes[:, i]) for i in range(3)], axis=1)
        full = np.stack([np.interp(along_u, u, row) for row in columns])
        return (relief + full).astype(np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at map points (..., 2) with the shift added."""
        XY = np.asarray(XY, float)
        return self.surface.heights(XY) + self.shift(XY)

    def height_range(self, bounds: tuple[float, float, float, float]) -> tuple[float, float]:
        """Range of the surface, widened by the range of the shift at corners and middle."""
        low, high = self.surface.height_range(bounds)
        xmin, ymin, xmax, ymax = bounds
        points = np.array([(x, y) for x in (xmin, (xmin + xmax) / 2, xmax) for y in (ymin, (ymin + ymax) / 2, ymax)])
        shift = self.shift(points)
        return low + float(shift.min()), high + float(shift.max())

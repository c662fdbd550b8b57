"""A surface of one height: flat ground, a water level, or a test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Window
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

    def height_range(self, bounds: tuple[float, float, float, float]) -> tuple[float, float]:
        """The height, twice."""
        return self.height, self.height

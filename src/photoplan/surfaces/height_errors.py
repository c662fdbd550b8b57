"""Standard deviations of the heights of a surface, whatever knows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Window
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.targets.base import Target


class HeightErrors(Protocol):
    """Standard deviations of heights, metres; NaN where there is no surface or nothing is known of it."""

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """At map points (..., 2), shape (...)."""
        ...

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """At the pixel centres of a window of a map target, shape (height, width)."""
        ...


@dataclass(frozen=True)
class StatedHeightErrors:
    """One standard deviation of the heights everywhere, metres."""

    sigma: float

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """See `HeightErrors`."""
        return np.full(np.shape(XY)[:-1], self.sigma)

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `HeightErrors`."""
        return np.full((window.height, window.width), self.sigma)


@dataclass(frozen=True)
class ModelHeightErrors:
    """The standard deviations that a terrain model holds for its posts, interpolated as its heights are."""

    surface: HybridSurface

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """See `HeightErrors`."""
        return self.surface.sigmas(XY)

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `HeightErrors`."""
        return self.surface.relief_with_sigma(target, window)[1]


@dataclass(frozen=True)
class RasterHeightErrors:
    """A raster of standard deviations beside one of heights, bilinear in between."""

    raster: Terrain
    """Its values are standard deviations; a value below zero tells nothing."""

    def sigmas(self, XY: ArrayLike) -> NDArray[np.float64]:
        """See `HeightErrors`."""
        return _known(self.raster.heights(XY)).astype(float)

    def __call__(self, target: Target, window: Window) -> NDArray[np.floating]:
        """See `HeightErrors`."""
        return _known(self.raster.relief(target, window))


def _known(values: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.where(values >= 0, values, np.nan)

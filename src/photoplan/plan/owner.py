"""Which source paints which pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.targets.base import Target


class Ownership(Protocol):
    """A rule that gives every pixel of a product to one source, before any pixel moves.

    What a pixel gets depends on the pixel alone, never on the window in which it is asked for, so that tiles join.
    """

    def owner(self, target: Target, window: Window, relief: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Row of the table of sources, plus one, for every pixel of a window; 0: no source.

        Parameters
        ----------
        target : Target
        window : Window
            Pixels of the product.
        relief : ndarray, shape (height, width), float32
            h of each pixel; NaN where there is no surface.

        Returns
        -------
        ndarray, shape (height, width), uint16
        """
        ...


@dataclass(frozen=True, eq=False)
class GivenOwners:
    """Owners that somebody has drawn: a raster over the whole product."""

    raster: NDArray[np.uint16]
    """Row of the table of sources, plus one; 0: nobody. Shape (height, width) of the product."""

    def __post_init__(self) -> None:
        if self.raster.ndim != 2 or self.raster.dtype != np.uint16:
            raise UsageError(f"owners of shape {self.raster.shape} and type {self.raster.dtype}; a raster of uint16")

    def owner(self, target: Target, window: Window, relief: NDArray[np.float32]) -> NDArray[np.uint16]:
        """The part of the raster that lies in the window."""
        right, bottom = window.stop
        if window & target.window != window or self.raster.shape != (target.window.height, target.window.width):
            raise UsageError(f"owners of shape {self.raster.shape} do not cover {window} of {target.window}")
        return np.ascontiguousarray(self.raster[window.row : bottom, window.col : right])

"""What every surface can do, and what terrain can do beyond that."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.lattice import Lattice
from photoplan.surfaces.rays import Hits
from photoplan.targets.base import Target


class Surface(Protocol):
    """Where the object is: a depth h for every pixel of a target."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Depth h of every pixel centre of `window`, shape (height, width), metres; NaN where there is no surface."""
        ...


class Terrain(Surface, Protocol):
    """A surface over the map whose heights can be asked for, and that rays can be followed to."""

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...), metres; NaN where there is no surface."""
        ...

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Lower and upper bound of the heights inside map bounds xmin, ymin, xmax, ymax (..., 4), shape (..., 2).

        Never narrower than the surface inside; cheap for many boxes and when asked again. NaN, NaN where there is no
        surface.
        """
        ...

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """Heights that, bilinear in between, are as good as all of them, around a window of a map.

        At best the surface's own posts; else the pixels of the map, cut as finely as the surface needs it.
        """
        ...

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Where rays first come down onto the surface, from above it."""
        ...

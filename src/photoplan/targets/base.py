"""Targets in general: what every one of them can do."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Breaks, Placement, Window


class Target(Protocol):
    """The product's own coordinates: pixel (u, v) = (column, row) and depth h, and where they are on the ground."""

    @property
    def window(self) -> Window:
        """All pixels of the product."""
        ...

    @property
    def breaks(self) -> Breaks | None:
        """Columns and rows, in pixels, at which `to_ground` is bent (facets of a profile); None: nowhere."""
        ...

    @property
    def placement(self) -> Placement:
        """Where they lie in the product's own plane: on the map, on a wall; what its file states."""
        ...

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        """(u, v, h) of shape (..., 3) to ground X, Y, Z of the same shape."""
        ...

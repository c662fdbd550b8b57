"""What every surface can do."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Window
from photoplan.targets.base import Target


class Surface(Protocol):
    """Where the object is: a depth h for every pixel of a target."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Depth h of every pixel centre of `window`, shape (height, width), metres; NaN where there is no surface."""
        ...

    def height_range(self, bounds: tuple[float, float, float, float]) -> tuple[float, float]:
        """Lowest and highest height inside map `bounds`; NaN, NaN where there is no surface."""
        ...

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...); NaN where there is no surface."""
        ...

"""A map as a projection: a raster that lies on the ground is a source like any image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Placement


@dataclass(frozen=True, eq=False)
class MapProjection:
    """From the ground straight down onto the pixels of a raster, whatever the height (Ecker 1991, eq. 5.3).

    All of it is linear, so that over any target whose ground is projective it is exact in one box of anchors; only
    another CRS bends it.
    """

    placement: Placement
    carry: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes X, Y of the product's CRS (..., 2) to the raster's; None if they are the same."""

    field: ClassVar[None] = None
    """Nothing happens in the raster."""
    breaks: ClassVar[None] = None
    """Maps are smooth."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the raster, pixels."""
        return self.placement.size

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to (x, y, 1)."""
        XY = np.asarray(XYZ, float)[..., :2]
        if self.carry is not None:
            XY = self.carry(XY)
        a, b, c, d, e, f = self.placement.coefficients
        X, Y = XY[..., 0] - c, XY[..., 1] - f
        det = a * e - b * d
        return np.stack([(e * X - b * Y) / det - 0.5, (a * Y - d * X) / det - 0.5, np.ones_like(X)], axis=-1)

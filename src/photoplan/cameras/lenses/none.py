"""No distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class NoLens:
    """Central projection without any deviation."""

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """The point itself, shapes (..., 2)."""
        return np.array(t, float)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """The point itself, shapes (..., 2)."""
        return np.array(t, float)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """Unit matrices, shape (..., 2, 2)."""
        return np.broadcast_to(np.eye(2), (*np.shape(t), 2)).copy()

"""What every lens can do."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Lens(Protocol):
    """The deviation of a real lens from central projection.

    Points are dimensionless tangent coordinates t = (x, y) / c about the principal point, x right, y up: t = (tan αx,
    tan αy) of the ideal ray. *Distortion* is the direction ideal → real: where the lens puts a ray. *Correction* is the
    opposite direction, real → ideal: what has to be done to a measured point. Coefficients of every class describe
    distortion; a set of coefficients that was determined as a correction is wrapped in `Reversed`.
    """

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        ...

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), exact to 1e-12; NaN where there is no solution."""
        ...

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        ...

    def __hash__(self) -> int:
        """Lenses are values: frozen, comparable, usable as keys."""
        ...

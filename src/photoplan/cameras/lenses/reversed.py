"""A lens whose coefficients were determined as a correction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.lenses.inverse import determinant


@dataclass(frozen=True)
class Reversed:
    """The lens that undoes another: its distortion is the other's correction, exactly.

    Calibration programs of the classical school state x_ideal = x_measured + Δx(x_measured). With Δ as coefficients
    of `lens`, `Reversed(lens)` puts ideal points where they were measured.
    """

    lens: Lens
    """The lens whose `distort` takes real to ideal coordinates."""

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2); NaN where there is no solution."""
        return self.lens.undistort(t)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), in closed form."""
        return self.lens.distort(t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        J = self.lens.jacobian(self.lens.undistort(t))
        inverse = np.empty_like(J)
        inverse[..., 0, 0], inverse[..., 1, 1] = J[..., 1, 1], J[..., 0, 0]
        inverse[..., 0, 1], inverse[..., 1, 0] = -J[..., 0, 1], -J[..., 1, 0]
        return inverse / determinant(J)[..., None, None]

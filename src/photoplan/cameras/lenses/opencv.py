"""The lens of OpenCV's calibration: rational radial factor and tangential terms."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.lenses.inverse import decentred, decentred_jacobian, newton_inverse
from photoplan.errors import InputError


@dataclass(frozen=True)
class OpenCV:
    """OpenCV's eight coefficients, in its own order, as distortion.

    The coefficients are those of OpenCV, whose y axis points down; the class turns them into photoplan's system
    (y up), where p1 and p2 change places and p1 its sign. ::

        g  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
        x' = x g + 2 p1 x y + p2 (r² + 2x²)          (y down)
        y' = y g + p1 (r² + 2y²) + 2 p2 x y
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        top, bottom = self._fraction(_radius2(t))
        return decentred(t, top if bottom is None else top / bottom, self.p2, -self.p1)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        return newton_inverse(self.distort, self.jacobian, t, t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r2 = _radius2(t)
        top, bottom = self._fraction(r2)
        slope = self.k1 + r2 * (2.0 * self.k2 + r2 * (3.0 * self.k3))
        if bottom is None:
            return decentred_jacobian(t, top, slope, self.p2, -self.p1)
        factor = top / bottom
        slope_bottom = self.k4 + r2 * (2.0 * self.k5 + r2 * (3.0 * self.k6))
        return decentred_jacobian(t, factor, (slope - factor * slope_bottom) / bottom, self.p2, -self.p1)

    def _fraction(self, r2: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Numerator and denominator of the radial factor; None where there is no denominator."""
        top = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        if not (self.k4 or self.k5 or self.k6):
            return top, None
        return top, 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))


def _radius2(t: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = t[..., 0], t[..., 1]
    return x * x + y * y

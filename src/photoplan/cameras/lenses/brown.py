"""Brown's lens: radial and decentring distortion with affinity and shear."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.lenses.inverse import decentred, decentred_jacobian, newton_inverse
from photoplan.errors import InputError


@dataclass(frozen=True)
class Brown:
    """Radial k1–k4, decentring p1–p2, affinity b1 and shear b2, as *distortion* of tangent coordinates, y up.

    ::

        xd = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2x²) + 2 p2 x y
        yd = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p2 (r² + 2y²) + 2 p1 x y
        x' = xd (1 + b1) + yd b2
        y' = yd

    A positive k1 moves points outwards. Programs that apply the same formula with y *down* (Agisoft) have p2 and b2 of
    opposite sign: see `from_y_down`. Programs that apply it to measured coordinates (the classical correction of
    Brown 1971) need `Reversed(Brown(…))`; mind whether their correction is added or subtracted.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")
        if self.b1 <= -1.0:
            raise InputError(f"{self!r}: b1 must be larger than −1, or the image is turned inside out")

    @classmethod
    def from_image_units(
        cls,
        c: float,
        *,
        k: tuple[float, ...] = (),
        p: tuple[float, float] = (0.0, 0.0),
        b: tuple[float, float] = (0.0, 0.0),
    ) -> Brown:
        """From coefficients that act on image coordinates instead of tangents.

        Parameters
        ----------
        c : float
            Camera constant in the unit of the coefficients: millimetres (k1 in mm⁻², p1 in mm⁻¹) or pixels.
        k : tuple of up to four floats
            k1 [unit⁻²], k2 [unit⁻⁴], k3 [unit⁻⁶], k4 [unit⁻⁸].
        p : (float, float)
            p1, p2 [unit⁻¹].
        b : (float, float)
            b1, b2, without unit. Coefficients that are added to c as pixels (Agisoft) are divided by c first.

        Raises
        ------
        InputError
            The camera constant is not positive, or there are more than four radial coefficients.
        """
        if not (math.isfinite(c) and c > 0):
            raise InputError(f"camera constant {c}; a positive number in the unit of the coefficients is needed")
        if len(k) > 4:
            raise InputError(f"{len(k)} radial coefficients {k}; Brown's lens has at most four")
        k1, k2, k3, k4 = (*k, 0.0, 0.0, 0.0, 0.0)[:4]
        return cls(k1 * c**2, k2 * c**4, k3 * c**6, p[0] * c, p[1] * c, *b, k4 * c**8)

    @classmethod
    def from_y_down(
        cls, *, k: tuple[float, ...] = (), p: tuple[float, float] = (0.0, 0.0), b: tuple[float, float] = (0.0, 0.0)
    ) -> Brown:
        """From coefficients of the same formula in a system with y down; only p2 and b2 change their sign."""
        k1, k2, k3, k4 = (*k, 0.0, 0.0, 0.0, 0.0)[:4]
        return cls(k1=k1, k2=k2, k3=k3, p1=p[0], p2=-p[1], b1=b[0], b2=-b[1], k4=k4)

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        out = decentred(t, self._factor(t), self.p1, self.p2)
        if self.b1 or self.b2:
            out[..., 0] += self.b1 * out[..., 0] + self.b2 * out[..., 1]
        return out

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        return newton_inverse(self.distort, self.jacobian, t, t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r2 = _radius2(t)
        slope = self.k1 + r2 * (2.0 * self.k2 + r2 * (3.0 * self.k3 + r2 * 4.0 * self.k4))
        J = decentred_jacobian(t, self._factor(t), slope, self.p1, self.p2)
        if self.b1 or self.b2:
            J[..., 0, :] += self.b1 * J[..., 0, :] + self.b2 * J[..., 1, :]
        return J

    def _factor(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        r2 = _radius2(t)
        return 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))


def _radius2(t: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = t[..., 0], t[..., 1]
    return x * x + y * y

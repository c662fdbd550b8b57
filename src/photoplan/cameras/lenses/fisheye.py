"""OpenCV's fisheye lens: a polynomial in the angle of incidence."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.lenses.inverse import radial_jacobian
from photoplan.errors import InputError

_ITERATIONS = 60


@dataclass(frozen=True)
class Fisheye:
    """Equidistant projection with four coefficients: r' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), θ = arctan r.

    Being radial, the coefficients of OpenCV's `fisheye` module serve unchanged with y up. Rays of 90° and more off the
    axis have no tangent: image points beyond that circle have no ideal point and give NaN.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        theta = np.arctan(r)
        return t * (_sinc_like(theta, r) * self._factor(theta))[..., None]

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN beyond 90° or a fold."""
        t = np.asarray(t, float)
        rd = np.hypot(t[..., 0], t[..., 1])
        theta = np.minimum(rd, 0.5 * math.pi)
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                step = (theta * self._factor(theta) - rd) / self._slope(theta)
                theta = theta - step
                if not (np.abs(step) > 4e-16 + 2e-15 * np.abs(theta)).any():
                    break
            miss = np.abs(theta * self._factor(theta) - rd)
            good = (miss <= 1e-12 * (1.0 + rd)) & (theta >= 0) & (theta < 0.5 * math.pi) & (self._slope(theta) > 0)
            r = np.tan(np.where(good, theta, np.nan))
            # At the centre both radii are zero and their ratio is the inverse of the slope there, 1.
            ratio = np.where(rd > 0, r / np.where(rd > 0, rd, 1.0), 1.0)
        return t * ratio[..., None]

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        theta = np.arctan(r)
        across = _sinc_like(theta, r) * self._factor(theta)
        along = self._slope(theta) / (1.0 + r * r)
        return radial_jacobian(t, r, across, along)

    def _factor(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        q = theta * theta
        return 1.0 + q * (self.k1 + q * (self.k2 + q * (self.k3 + q * self.k4)))

    def _slope(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        q = theta * theta
        return 1.0 + q * (3.0 * self.k1 + q * (5.0 * self.k2 + q * (7.0 * self.k3 + q * 9.0 * self.k4)))


def _sinc_like(theta: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray[np.float64]:
    """θ / r with its limit 1 at the centre."""
    return np.where(r > 0, theta / np.where(r > 0, r, 1.0), 1.0)

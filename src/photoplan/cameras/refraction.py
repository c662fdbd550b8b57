"""Atmospheric refraction as a rise of the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.warped import inverse_by_newton

# ICAO standard atmosphere: temperature falls by 6.5 K/km from 288.15 K to 11 km and stays; density follows from
# hydrostatic equilibrium. Refractivity n − 1 is proportional to density.
_LAPSE = 0.0065 / 288.15
_POWER = 9.80665 / (287.053 * 0.0065) - 1.0
_TROPOPAUSE = 11_000.0
_SCALE_HEIGHT = 287.053 * 216.65 / 9.80665
_SEA_LEVEL = 277.0e-6
_TOP = _SEA_LEVEL * (1.0 - _LAPSE * _TROPOPAUSE) ** _POWER

#: Below this difference of heights the integral is replaced by its series, metres.
_NEAR = 2.0


def _profile(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """n − 1 at height z, and its integral from sea level to z."""
    u = 1.0 - _LAPSE * np.minimum(z, _TROPOPAUSE)
    fall = np.exp(-np.maximum(z - _TROPOPAUSE, 0.0) / _SCALE_HEIGHT)
    inside = _SEA_LEVEL * u**_POWER
    value = inside * fall
    integral = (_SEA_LEVEL - inside * u) / (_LAPSE * (_POWER + 1.0)) + _TOP * _SCALE_HEIGHT * (1.0 - fall)
    return value, integral


def _slopes(z: float) -> tuple[float, float, float]:
    """First three derivatives of n − 1."""
    value = float(_profile(np.asarray(z))[0])
    if z >= _TROPOPAUSE:
        return -value / _SCALE_HEIGHT, value / _SCALE_HEIGHT**2, -value / _SCALE_HEIGHT**3
    q = _LAPSE / (1.0 - _LAPSE * z)
    first, second = -_POWER * q * value, _POWER * (_POWER - 1.0) * q**2 * value
    return first, second, -(_POWER - 2.0) * q * second


@dataclass(frozen=True)
class Refraction:
    """Where a point of the ground seems to be, seen from a camera through the standard atmosphere.

    In horizontal layers of air (Snell) a ray that arrives at height H under the angle α from the nadir left the ground
    at h under the chord α − K tan α, with K = ∫ (n − n_H) dz / (H − h) from h to H. For the standard atmosphere
    that is the closed formula of Saastamoinen 1972 (*Refraction*, Photogrammetric Engineering 38), here continued above
    11 km. The point then seems to lie higher on its own vertical by

        K s² / (H − h),   s = distance to the camera,

    which holds in every direction of view, stays finite near the horizon, and reads k s² / 2R in surveyors' terms.
    Applied to the ground, it is right for tilted images too. A warp for `WarpedCamera`, in map coordinates; heights
    are those above sea level.
    """

    center: tuple[float, float, float]
    """Projection centre X0, Y0, Z0 in map coordinates, metres."""

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground points (..., 3) to the places where they seem to be."""
        out = np.array(XYZ, float)
        rise, _ = self._rise(out[..., 2])
        out[..., 2] += rise * ((out - self.center) ** 2).sum(axis=-1)
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the true point, shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        away = XYZ - self.center
        rise, change = self._rise(XYZ[..., 2])
        J = np.zeros((*XYZ.shape, 3))
        J[..., 0, 0] = J[..., 1, 1] = 1.0
        J[..., 2, :] = 2.0 * rise[..., None] * away
        J[..., 2, 2] += 1.0 + change * (away**2).sum(axis=-1)
        return J

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Where displaced points (..., 3) are; NaN where there is no such point."""
        return inverse_by_newton(self, displaced)

    def _rise(self, h: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """K / (H − h) at ground heights h, per metre, and its derivative by h."""
        H = self.center[2]
        n_H, integral_H = _profile(np.asarray(H))
        n, integral = _profile(h)
        drop = H - h
        near = np.abs(drop) < _NEAR
        D = np.where(near, 1.0, drop)
        far_rise = (integral_H - integral - D * n_H) / D**2
        far_change = (2.0 * far_rise - (n - n_H) / D) / D
        first, second, third = _slopes(H)
        near_rise = -first / 2.0 + drop * (second / 6.0 - drop * third / 24.0)
        near_change = -second / 6.0 + drop * third / 12.0
        return np.where(near, near_rise, far_rise), np.where(near, near_change, far_change)

    def angle(self, alpha: float, height: float) -> float:
        """K tan α: how much farther from the nadir a point at `height` seems to lie, radians."""
        rise, _ = self._rise(np.asarray(height, float))
        return float(rise) * (self.center[2] - height) * math.tan(alpha)

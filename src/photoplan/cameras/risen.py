"""Displacements of the ground that only move heights: a round earth and refraction, and exaggeration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.rotation import dot


@dataclass(frozen=True)
class EarthBend:
    """Ground at a horizontal distance s from the camera is lowered by b s² (Ecker 1991, eq. 5.6 and 5.7).

    b = (1 − k) / 2R for an earth of radius R and a coefficient of refraction k. A warp for `WarpedCamera`.
    """

    center: tuple[float, float]
    """X0, Y0 of the camera in map coordinates, metres."""
    bend: float
    """b, 1/m."""

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map points (..., 3) to where they lie over a plane that touches the earth below the camera."""
        out = np.array(XYZ, float)
        out[..., 2] -= self.bend * self._squared(out)
        return out

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Points over the plane back to the map."""
        out = np.array(displaced, float)
        with np.errstate(invalid="ignore"):  # what lies on no map is at infinity
            out[..., 2] += self.bend * self._squared(out)
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        J = np.broadcast_to(np.eye(3), (*XYZ.shape, 3)).copy()
        J[..., 2, :2] = -2.0 * self.bend * (XYZ[..., :2] - self.center)
        return J

    def _squared(self, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        away = XYZ[..., :2] - self.center
        return dot(away, away)


@dataclass(frozen=True)
class Exaggeration:
    """Heights are stretched about one that stays (Ecker 1991, eq. 5.9). A warp for `WarpedCamera`."""

    reference: float
    """The height that stays, metres."""
    factor: float

    def __post_init__(self) -> None:
        if not 0.01 <= self.factor <= 1000:
            raise UsageError(f"exaggeration {self.factor}; a factor from 0.01 to 1000 is needed")

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) with stretched heights."""
        return self._stretched(XYZ, self.factor)

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) with their own heights."""
        return self._stretched(displaced, 1.0 / self.factor)

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        return np.broadcast_to(np.diag([1.0, 1.0, self.factor]), (*np.shape(XYZ), 3))

    def _stretched(self, XYZ: ArrayLike, factor: float) -> NDArray[np.float64]:
        out = np.array(XYZ, float)
        out[..., 2] = self.reference + (out[..., 2] - self.reference) * factor
        return out

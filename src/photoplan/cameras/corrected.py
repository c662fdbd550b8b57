"""Earth curvature as a correction of image coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.curvature import Warp, WarpedCamera, inverse_by_newton
from photoplan.cameras.frame import FrameCamera
from photoplan.errors import InputError


@dataclass(frozen=True)
class CurvatureCorrection:
    """Ecker 1991, eq. 4.16, for computations that treat map coordinates as if they were Cartesian.

    The equation states by how much the image coordinates that are computed from map coordinates are too long:

        Δx = x / 2R · (r² (Z0 − Z) / c² − 2 Z),    heights above the nadir point.

    Here the same amount is taken off in the equivalent vertical image, as a displacement of the ground towards the
    nadir. For a vertical image that is the equation itself; for a tilted one it stays right, where the
    equation about the principal point would not. Terms of second order in distance / R are neglected.

    Points whose ray is so flat that the formula runs back (d² > R (Z0 − Z) / 2, more than 15 flying heights away even
    from 14 km) and points above the camera give NaN.
    """

    center: tuple[float, float, float]
    """Projection centre X0, Y0, Z0 in map coordinates, metres."""
    nadir_height: float
    """Height of the ground below the camera, metres."""
    radius: float
    """Earth radius increased by that height, metres."""

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise InputError(f"earth radius {self.radius}; a positive number of metres is needed")

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map points (..., 3) to the points that a Cartesian projection takes to their true image."""
        out = np.array(XYZ, float)
        dx, dy, factor, _ = self._terms(out)
        out[..., 0] = self.center[0] + dx * factor
        out[..., 1] = self.center[1] + dy * factor
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Derivative of the displaced by the given point, shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        dx, dy, factor, depth = self._terms(XYZ)
        by_x, by_y = -dx / (self.radius * depth), -dy / (self.radius * depth)
        by_z = (1.0 - (dx * dx + dy * dy) / (2.0 * depth * depth)) / self.radius
        J = np.zeros((*XYZ.shape, 3))
        J[..., 0, 0], J[..., 0, 1], J[..., 0, 2] = factor + dx * by_x, dx * by_y, dx * by_z
        J[..., 1, 0], J[..., 1, 1], J[..., 1, 2] = dy * by_x, factor + dy * by_y, dy * by_z
        J[..., 2, 2] = 1.0
        return J

    def inverse(self, displaced: ArrayLike) -> NDArray[np.float64]:
        """Return where displaced points (..., 3) are; NaN where there is no such point."""
        return inverse_by_newton(self, displaced)

    def _terms(
        self, XYZ: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Distances from the nadir, the factor that shortens them, and the depth below the camera."""
        dx, dy = XYZ[..., 0] - self.center[0], XYZ[..., 1] - self.center[1]
        depth = self.center[2] - XYZ[..., 2]
        d2 = dx * dx + dy * dy
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > 0) & (d2 <= 0.5 * self.radius * depth), depth, np.nan)
        factor = 1.0 - (d2 / depth - 2.0 * (XYZ[..., 2] - self.nadir_height)) / (2.0 * self.radius)
        return dx, dy, factor, depth


def corrected_camera(
    frame: FrameCamera, nadir_height: float, radius: float, before: tuple[Warp, ...] = ()
) -> WarpedCamera:
    """A frame camera in map coordinates with earth curvature as a correction (Ecker 1991, §4.6.5.2)."""
    X, Y, Z = frame.center.tolist()
    correction = CurvatureCorrection((X, Y, Z), nadir_height, radius)
    return WarpedCamera(frame, (*before, correction), frame.center, 1.0 / radius)

"""Exterior orientation as a value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.geometry.rotation import angles_from_rotation, rotation_from_angles

#: Unknowns of a pose, in the order of covariances: centre, and small rotations about the axes of the camera
#: (R ← R · exp[δ]×).
UNKNOWNS = ("X0", "Y0", "Z0", "rotation about x", "rotation about y", "rotation about z")


@dataclass(frozen=True, eq=False)
class Pose:
    """Exterior orientation: where the projection centre is and how the camera axes lie in ground space.

    `~pose` is the inverse motion, `a @ b` is the motion b followed by a.
    """

    center: NDArray[np.float64]
    """Projection centre X0, Y0, Z0 in ground coordinates, shape (3,), metres."""

    R_ground_camera: NDArray[np.float64]
    """Rotation from camera axes to ground axes, shape (3, 3) (Ecker 1991, eq. 3.3)."""

    def __post_init__(self) -> None:
        center = np.array(self.center, float)
        R = np.array(self.R_ground_camera, float)
        if center.shape != (3,) or not np.isfinite(center).all():
            raise InputError(f"projection centre {self.center!r}; three finite coordinates are needed")
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise InputError("rotation matrix is not a right-handed rotation")
        center.setflags(write=False)
        R.setflags(write=False)
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "R_ground_camera", R)

    @classmethod
    def from_angles(cls, center: ArrayLike, angles: ArrayLike, order: str = "opk") -> Pose:
        """Pose from a projection centre and three angles in radians, in the sequence of `order`."""
        return cls(np.asarray(center, float), rotation_from_angles(angles, order))

    @property
    def opk(self) -> NDArray[np.float64]:
        """ω, φ, κ in radians."""
        return angles_from_rotation(self.R_ground_camera)

    @property
    def tilt(self) -> float:
        """Angle between the optical axis and the nadir direction, radians: 0 for a strictly vertical image."""
        return float(np.arccos(np.clip(self.R_ground_camera[2, 2], -1.0, 1.0)))

    def to_ground(self, xyz_camera: ArrayLike) -> NDArray[np.float64]:
        """Camera coordinates (origin at the projection centre) to ground, shapes (..., 3)."""
        return np.asarray(xyz_camera, float) @ self.R_ground_camera.T + self.center

    def to_camera(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground coordinates to camera axes with origin at the projection centre, shapes (..., 3)."""
        return (np.asarray(XYZ, float) - self.center) @ self.R_ground_camera

    def __invert__(self) -> Pose:
        return Pose(-self.R_ground_camera.T @ self.center, self.R_ground_camera.T)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.R_ground_camera @ other.center + self.center, self.R_ground_camera @ other.R_ground_camera)

"""A camera in forty lines that shares nothing with the package's cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Vantage
from photoplan.geometry.pose import Pose


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Frame camera with square pixels and, if asked, cubic radial distortion."""

    pose: Pose
    focal: float
    size: tuple[int, int]
    k1: float = 0.0
    field: None = None
    """Its distortion stays in the anchors."""
    breaks: None = None

    @property
    def center(self) -> NDArray[np.float64]:
        return self.pose.center

    @property
    def vantage(self) -> Vantage:
        return Vantage(self.center)

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        c = self.pose.to_camera(XYZ)
        w = -c[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = c[..., 0] / w, c[..., 1] / w
            bend = 1 + self.k1 * (x * x + y * y) if self.k1 else 1.0
        col = (self.size[0] - 1) / 2
        row = (self.size[1] - 1) / 2
        return np.stack([self.focal * c[..., 0] * bend + col * w, -self.focal * c[..., 1] * bend + row * w, w], axis=-1)

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert not self.k1
        xy = np.asarray(xy, float)
        x = (xy[..., 0] - (self.size[0] - 1) / 2) / self.focal
        y = -(xy[..., 1] - (self.size[1] - 1) / 2) / self.focal
        d = np.stack([x, y, -np.ones_like(x)], axis=-1) @ self.pose.R_ground_camera.T
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return np.broadcast_to(self.center, d.shape), d

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        XYZ = np.asarray(XYZ, float)
        columns = []
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-3
            plus, minus = self.project_homogeneous(XYZ + step), self.project_homogeneous(XYZ - step)
            columns.append((plus[..., :2] / plus[..., 2:] - minus[..., :2] / minus[..., 2:]) / 2e-3)
        return np.stack(columns, axis=-1)


def vertical(size: tuple[int, int] = (8000, 6000), focal: float = 12500.0, k1: float = 0.0) -> Pinhole:
    """A nearly vertical image 800 m above the origin of a local map."""
    return Pinhole(Pose.from_angles((1000, 2000, 800), np.radians((2, -3, 40))), focal, size, k1)

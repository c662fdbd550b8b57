"""Points intersected from images with known orientation: what tie points are judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, project
from photoplan.cameras.observed import ImagePoints
from photoplan.geometry.grid import Window

__all__ = ["ArrayPixels", "reprojection"]


@dataclass(frozen=True, eq=False)
class ArrayPixels:
    """An image in memory, (bands, rows, columns)."""

    values: NDArray
    valid: NDArray | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.values.shape[2], self.values.shape[1]

    def read(self, window: Window) -> tuple[NDArray, NDArray | None]:
        assert window.size and window == window & Window(0, 0, *self.size), "windows lie inside the image"
        part = (slice(window.row, window.stop[1]), slice(window.col, window.stop[0]))
        return self.values[:, *part], None if self.valid is None else self.valid[part]


def reprojection(points: ImagePoints, cameras: Sequence[Camera]) -> NDArray:
    """Measured minus computed position of points that are intersected from all their images, (n, 2), pixels.

    `cameras` are those of `points.images`. Least squares in the images, started from the point nearest to all rays.
    """
    n = len(points.points)
    origin, direction = np.empty((len(points), 3)), np.empty((len(points), 3))
    rows = [points.image == k for k in range(len(cameras))]
    for camera, here in zip(cameras, rows):
        origin[here], direction[here] = camera.rays(points.xy[here])
    P = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    N, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(N, points.point, P)
    np.add.at(b, points.point, np.einsum("nij,nj->ni", P, origin))
    XYZ = np.linalg.solve(N, b[..., None])[..., 0]
    residual, J = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
    for step in range(4):
        for camera, here in zip(cameras, rows):
            at = XYZ[points.point[here]]
            residual[here], J[here] = points.xy[here] - project(camera, at), camera.derivatives(at)
        if step == 3:
            break
        N, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
        np.add.at(N, points.point, J.transpose(0, 2, 1) @ J)
        np.add.at(b, points.point, np.einsum("nji,nj->ni", J, residual))
        XYZ += np.linalg.solve(N, b[..., None])[..., 0]
    return residual

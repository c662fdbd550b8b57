"""Normals of the ground where rays have hit it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.hybrid import _weights
from photoplan.kernels.jit import inner
from photoplan.kernels.raycast import Faces, _cell


@inner
def _bilinear_normal(posts: NDArray[np.float32], x: float, y: float, out: NDArray[np.float64]) -> None:
    """Normal of the mesh at a position; along a line whose other side is missing that of the line."""
    col = min(max(np.int64(np.floor(x)), 0), posts.shape[1] - 2)
    row = min(max(np.int64(np.floor(y)), 0), posts.shape[0] - 2)
    h00, h01 = np.float64(posts[row, col]), np.float64(posts[row, col + 1])
    h10, h11 = np.float64(posts[row + 1, col]), np.float64(posts[row + 1, col + 1])
    fx, fy = x - col, y - row
    by_x = (h01 - h00) + fy * ((h11 - h10) - (h01 - h00))
    by_y = (h10 - h00) + fx * ((h11 - h01) - (h10 - h00))
    out[0], out[1], out[2] = -by_x, -by_y, 1.0


@inner
def _face_normal(
    faces: Faces, m: int, ray: NDArray[np.float64], t: float, wall: bool, out: NDArray[np.float64]
) -> bool:
    """Normal of the triangle that a ray is on just before t, or of the wall on an edge that it crosses there."""
    vertices, corners, start, frame = faces
    size = max(abs(ray[3]), abs(ray[4]), 1e-300)
    best, nearest = -2, np.inf
    for f in range(start[m], start[m + 1]):
        if wall:
            for k in range(3):
                a, b = corners[f, k], corners[f, (k + 1) % 3]
                ax = (vertices[a, 0] - frame[0]) * frame[2] - ray[0]
                ay = (frame[1] - vertices[a, 1]) * frame[2] - ray[1]
                ex = (vertices[b, 0] - vertices[a, 0]) * frame[2]
                ey = (vertices[a, 1] - vertices[b, 1]) * frame[2]
                across = ray[3] * ey - ray[4] * ex
                if across != 0.0:
                    off = abs((ax * ey - ay * ex) / across - t)
                    s = (ax * ray[4] - ay * ray[3]) / across
                    if off < nearest and -1e-6 <= s <= 1.0 + 1e-6:
                        nearest = off
                        out[0], out[1], out[2] = ey, -ex, 0.0
            continue
        at = t - 1e-7 / size
        _, _, _, key = _weights(vertices, corners, f, frame, ray[0] + at * ray[3], ray[1] + at * ray[4])
        if key == -2 or (best >= 0 and key >= best):
            continue
        best = key
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        # In meshes, y downwards.
        area = (ux * vy - uy * vx) * frame[2]
        out[0], out[1], out[2] = (uy * vz - uz * vy) / area, -(uz * vx - ux * vz) / area, 1.0
        if key == -1:
            break
    return best != -2 or nearest < np.inf


@inner
def _hit_normal(
    posts: NDArray[np.float32], faces: Faces, ray: NDArray[np.float64], wall: bool, out: NDArray[np.float64]
) -> None:
    """Normal of the ground where a ray has hit it at ray[7], of no length in particular, with x and y in meshes and y
    downwards: (−∂h/∂x, −∂h/∂y, 1) on the surface, level on a wall."""
    t = ray[7]
    x, y = ray[0] + t * ray[3], ray[1] + t * ray[4]
    if faces[2].shape[0] > 0:
        m = _cell(y, ray[4], posts.shape[0] - 1) * (posts.shape[1] - 1) + _cell(x, ray[3], posts.shape[1] - 1)
        if faces[2][m + 1] > faces[2][m] and _face_normal(faces, m, ray, t, wall, out):
            return
    if wall:
        # A border of meshes.
        along_x = abs(x - np.rint(x)) < abs(y - np.rint(y))
        out[0], out[1], out[2] = (1.0, 0.0, 0.0) if along_x else (0.0, 1.0, 0.0)
    else:
        _bilinear_normal(posts, x, y, out)

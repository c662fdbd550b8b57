"""Visibility in the image plane (Behr 1989, §6.3.2.2): a depth buffer of triangles, in plain NumPy.

Shares nothing with lines of sight: all that may be in the way is projected into the image, the nearest wins.
"""

from __future__ import annotations

import numpy as np

from photoplan.cameras.base import project


def depth_buffer(camera, triangles, finer: int):
    """One over the depth of what is nearest in each of finer × finer parts of the image's pixels; 0: nothing."""
    width, height = (n * finer for n in camera.size)
    buffer = np.zeros((height, width))
    homogeneous = camera.project_homogeneous(triangles)
    for corner in homogeneous[(homogeneous[..., 2] > 0).all(axis=1)]:
        near = 1.0 / corner[:, 2]
        x, y = (corner[:, k] * near * finer + (finer - 1) / 2 for k in (0, 1))
        area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0])
        c0, r0 = max(0, int(np.ceil(x.min()))), max(0, int(np.ceil(y.min())))
        c1, r1 = min(width, int(np.floor(x.max())) + 1), min(height, int(np.floor(y.max())) + 1)
        if area == 0 or c0 >= c1 or r0 >= r1:
            continue
        col, row = np.arange(c0, c1), np.arange(r0, r1)[:, None]
        b = ((col - x[0]) * (y[2] - y[0]) - (row - y[0]) * (x[2] - x[0])) / area
        c = ((x[1] - x[0]) * (row - y[0]) - (y[1] - y[0]) * (col - x[0])) / area
        # One over the depth is linear in the image.
        value = near[0] + b * (near[1] - near[0]) + c * (near[2] - near[0])
        part = buffer[r0:r1, c0:c1]
        inside = (b >= 0) & (c >= 0) & (b + c <= 1) & (value > part)
        part[inside] = value[inside]
    return buffer


def hidden_in_buffer(camera, XYZ, buffer, finer: int, near):
    """Whether something is nearer than places (..., 3), by more than `near` metres (...); False outside the image."""
    homogeneous = camera.project_homogeneous(XYZ)
    xy = project(camera, XYZ)
    inside = ((xy >= -0.5) & (xy <= np.array(camera.size) - 0.5)).all(axis=-1)
    col, row = (np.rint(np.nan_to_num(xy[..., k]) * finer + (finer - 1) / 2).astype(int) for k in (0, 1))
    at = buffer[row.clip(0, buffer.shape[0] - 1), col.clip(0, buffer.shape[1] - 1)]
    return inside & (at * (homogeneous[..., 2] - near) > 1.0)


def posts_as_triangles(heights, XY):
    """Two triangles for every mesh of posts (rows, cols) at map points (rows, cols, 2)."""
    p = np.concatenate([XY, heights[..., None]], axis=-1)
    a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]
    return np.concatenate([np.stack([a, b, c], axis=-2), np.stack([b, d, c], axis=-2)]).reshape(-1, 3, 3)

"""Smooth figures between nodes of a tile, and what errors in the image and of the depth do on the ground."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel

#: Figures of a place that the spread is computed from: the ray's run (2), covariance in the tile (3), ground (9).
FIGURES = 14


@kernel
def between_nodes(
    nodes: NDArray[np.float64], low: float, high: float, relief: NDArray[np.float32], out: NDArray[np.float64]
) -> None:
    """Interpolate trilinearly from the first to the last pixel of a tile, and between two depths.

    Parameters
    ----------
    nodes : ndarray, shape (layers, rows, cols, k)
        Two or more along each axis, at equal distances.
    low, high : float
        Depth of the first and of the last layer.
    relief : ndarray, shape (height, width), float32
        Depth of each pixel.
    out : ndarray, shape (height, width, k)
        Is written; NaN where the depth or a node around is NaN.
    """
    layers, rows, cols, count = nodes.shape
    height, width = relief.shape
    for i in range(height):
        y = i * (rows - 1) / max(height - 1, 1)
        r = min(int(y), rows - 2)
        y -= r
        for j in range(width):
            h = np.float64(relief[i, j])
            if math.isnan(h):
                for k in range(count):
                    out[i, j, k] = np.nan
                continue
            x = j * (cols - 1) / max(width - 1, 1)
            c = min(int(x), cols - 2)
            x -= c
            z = (h - low) / (high - low) * (layers - 1)
            a = min(max(int(z), 0), layers - 2)
            z -= a
            for k in range(count):
                total = 0.0
                for b in range(2):
                    upper = nodes[a + b, r, c, k] * (1 - x) + nodes[a + b, r, c + 1, k] * x
                    lower = nodes[a + b, r + 1, c, k] * (1 - x) + nodes[a + b, r + 1, c + 1, k] * x
                    total += (upper * (1 - y) + lower * y) * (z if b else 1 - z)
                out[i, j, k] = total


@kernel
def spread_out(
    figures: NDArray[np.float64], slope: NDArray[np.float64], sigma: NDArray[np.float64], out: NDArray[np.float32]
) -> None:
    """Standard deviations and error ellipse of what places show.

    With e the displacement on the level through a place, t the run of its ray (tile units per depth), s the slope and
    dh the error of the depth, what is shown lies off by (u, v) = e − t (dh + z) and z = s (u, v) + dh.

    Parameters
    ----------
    figures : ndarray, shape (n, 14)
        t_u, t_v; variances and covariance uu, uv, vv of e; derivatives of X, of Y, of Z by u, v and depth.
    slope : ndarray, shape (n, 2)
        Derivatives of the depth by u and v.
    sigma : ndarray, shape (n,)
        Standard deviation of the depth.
    out : ndarray, shape (6, n), float32
        Is written: standard deviations of X, Y, Z, semi-axes and azimuth (degrees from Y to X, 0 to 180) of the
        ellipse in X, Y; NaN where a figure is NaN or the surface is turned away from the ray.
    """
    B = np.empty((3, 3))
    G = np.empty((3, 3))
    for n in range(len(sigma)):
        tu, tv, uu, uv, vv = figures[n, :5]
        su, sv = slope[n, 0], slope[n, 1]
        facing = 1.0 + su * tu + sv * tv
        variance = sigma[n] * sigma[n]
        if not facing > 0.0 or math.isnan(uu + variance):
            for band in range(6):
                out[band, n] = np.nan
            continue
        B[0, 0], B[0, 1], B[0, 2] = 1.0 - tu * su / facing, -tu * sv / facing, -tu / facing
        B[1, 0], B[1, 1], B[1, 2] = -tv * su / facing, 1.0 - tv * sv / facing, -tv / facing
        B[2, 0], B[2, 1], B[2, 2] = su / facing, sv / facing, 1.0 / facing
        for a in range(3):
            for b in range(3):
                G[a, b] = 0.0
                for k in range(3):
                    G[a, b] += figures[n, 5 + 3 * a + k] * B[k, b]
        xx = G[0, 0] ** 2 * uu + 2 * G[0, 0] * G[0, 1] * uv + G[0, 1] ** 2 * vv + G[0, 2] ** 2 * variance
        yy = G[1, 0] ** 2 * uu + 2 * G[1, 0] * G[1, 1] * uv + G[1, 1] ** 2 * vv + G[1, 2] ** 2 * variance
        zz = G[2, 0] ** 2 * uu + 2 * G[2, 0] * G[2, 1] * uv + G[2, 1] ** 2 * vv + G[2, 2] ** 2 * variance
        xy = G[0, 0] * G[1, 0] * uu + (G[0, 0] * G[1, 1] + G[0, 1] * G[1, 0]) * uv + G[0, 1] * G[1, 1] * vv
        xy += G[0, 2] * G[1, 2] * variance
        middle, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        out[0, n], out[1, n], out[2, n] = math.sqrt(xx), math.sqrt(yy), math.sqrt(max(zz, 0.0))
        out[3, n], out[4, n] = math.sqrt(middle + half), math.sqrt(max(middle - half, 0.0))
        out[5, n] = (90.0 - math.degrees(0.5 * math.atan2(2.0 * xy, xx - yy))) % 180.0

"""Rays against bilinear patches and triangles one by one, in plain NumPy: the twin of views."""

from __future__ import annotations

import numpy as np


def over_patches(heights, left, top, mesh, start, ways, bend=0.0):
    """Distance, in lengths of the ways, at which each ray comes down through a bilinear patch; infinite: nowhere.

    `heights` (rows from north to south) are posts; `start` (3,) lies above ground or outside; `ways` (n, 3).
    """
    first = np.full(len(ways), np.inf)
    rows, cols = heights.shape
    b = bend * (ways[:, 0] ** 2 + ways[:, 1] ** 2)
    with np.errstate(all="ignore"):
        for row in range(rows - 1):
            for col in range(cols - 1):
                # Position in the patch, linear in t: px + qx t, py + qy t.
                px, qx = (start[0] - left) / mesh - col, ways[:, 0] / mesh
                py, qy = (top - start[1]) / mesh - row, -ways[:, 1] / mesh
                low, high = np.zeros(len(ways)), np.full(len(ways), np.inf)
                for p, q in ((px, qx), (py, qy)):
                    ends = np.sort(np.stack([(0 - p) / q, (1 - p) / q]), axis=0)
                    still = q == 0
                    inside = 0 <= p <= 1
                    low = np.maximum(low, np.where(still, 0 if inside else np.inf, ends[0]))
                    high = np.minimum(high, np.where(still, np.inf if inside else -np.inf, ends[1]))
                h00, h01 = heights[row, col], heights[row, col + 1]
                h10, h11 = heights[row + 1, col], heights[row + 1, col + 1]
                a, c, d = h01 - h00, h10 - h00, h00 - h01 - h10 + h11
                # Ray less ground: C + B t + A t².
                A = b - d * qx * qy
                B = ways[:, 2] - a * qx - c * qy - d * (px * qy + py * qx)
                C = start[2] - h00 - a * px - c * py - d * px * py
                root = np.sqrt(B * B - 4 * A * C)
                for t in ((-B - root) / (2 * A), (-B + root) / (2 * A), np.where(np.abs(A) < 1e-14, -C / B, np.nan)):
                    falls = B + 2 * A * t < 0
                    good = (t >= low - 1e-12) & (t <= high + 1e-12) & (t > 0) & falls
                    first = np.where(good & (t < first), t, first)
    return first


def over_triangles(corners, start, ways):
    """The same for triangles (m, 3, 3) from either side (Möller and Trumbore); and which one, −1: none."""
    first, which = np.full(len(ways), np.inf), np.full(len(ways), -1)
    with np.errstate(all="ignore"):
        for k, (a, b, c) in enumerate(corners):
            e, f = b - a, c - a
            p = np.cross(ways, f)
            det = p @ e
            s = start - a
            u = (p @ s) / det
            q = np.cross(s, e)
            v = (ways @ q) / det
            t = (f @ q) / det
            good = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < first)
            first, which = np.where(good, t, first), np.where(good, k, which)
    return first, which

"""Where the pixels of a tile lie in an image, with values that are known at nodes: what choosing images needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def between_nodes(
    relief: NDArray[np.float32],
    nodes: NDArray[np.float64],
    levels: tuple[float, float],
    corner: tuple[int, int],
    spacing: int,
    size: tuple[float, float],
    xy: NDArray[np.float64],
    near: NDArray[np.float64],
    values: NDArray[np.float32],
) -> None:
    """Positions and k values of each pixel, by linear interpolation in (u, v, h) between nodes.

    nodes (2, rows, columns, 3 + k): homogeneous position and values at two levels; the first node lies `corner`
    (columns, rows) before the first pixel. Writes xy (height, width, 2), near (height, width), the distance from the
    border of an image of a size (width, height), negative outside, and values (k, height, width); NaN without surface,
    and at and behind the camera's plane.
    """
    height, width = relief.shape
    low, thick = levels[0], levels[1] - levels[0]
    found = np.empty(nodes.shape[3])
    for i in range(height):
        v = (i + corner[1]) / spacing
        row = min(np.int64(v), nodes.shape[1] - 2)
        fv = v - row
        for j in range(width):
            u = (j + corner[0]) / spacing
            col = min(np.int64(u), nodes.shape[2] - 2)
            fu = u - col
            fh = (np.float64(relief[i, j]) - low) / thick
            for k in range(nodes.shape[3]):
                total = 0.0
                for level in range(2):
                    upper = nodes[level, row, col, k] * (1.0 - fu) + fu * nodes[level, row, col + 1, k]
                    lower = nodes[level, row + 1, col, k] * (1.0 - fu) + fu * nodes[level, row + 1, col + 1, k]
                    total += (fh if level == 1 else 1.0 - fh) * (upper + fv * (lower - upper))
                found[k] = total
            w = found[2] if found[2] > 0.0 else np.nan
            xy[i, j, 0] = found[0] / w
            xy[i, j, 1] = found[1] / w
            x, y = abs(xy[i, j, 0] - 0.5 * (size[0] - 1.0)), abs(xy[i, j, 1] - 0.5 * (size[1] - 1.0))
            near[i, j] = min(0.5 * size[0] - x, 0.5 * size[1] - y)
            for k in range(3, nodes.shape[3]):
                values[k - 3, i, j] = found[k] if w > 0.0 else np.nan


@kernel
def add_penalties(
    near: NDArray[np.float64],
    values: NDArray[np.float32],
    slope: NDArray[np.float32],
    drawn: NDArray[np.uint16],
    border: tuple[float, float, float, float],
    sloped: tuple[float, float, float],
    ahead: tuple[float, int, float],
) -> None:
    """Make smooth penalties, the first of values (4, height, width), those of an image; see `plan.choice`.

    Parameters
    ----------
    near : ndarray, shape (height, width)
        Distance from the image's border, pixels; outside, and where it is not known, the penalty becomes infinite.
    values, slope : ndarray of float32, shapes (4, height, width) and (2, height, width)
        The last two values are how many columns and rows a line of sight moves per metre; slope of the ground.
    drawn : ndarray of uint16, shape (height, width)
        Numbers that somebody has given to pixels; empty: nobody has.
    border : four floats
        Its weight, how far it counts, and a margin and what that costs.
    sloped : three floats
        What a doubled area counts, and the least and largest area of a pixel on the slope beside that on the level.
    ahead : (float, int, float)
        A rank that is added, the image's number, and what it is worth that it was given the pixel.
    """
    given = drawn.shape[0] > 0
    for i in range(near.shape[0]):
        for j in range(near.shape[1]):
            total, n = np.float64(values[0, i, j]), near[i, j]
            if not n >= 0.0 or np.isnan(total):
                values[0, i, j] = np.inf
                continue
            if sloped[0] > 0.0:
                larger = abs(1.0 - values[2, i, j] * slope[0, i, j] - values[3, i, j] * slope[1, i, j])
                total -= sloped[0] * np.log2(min(max(larger, sloped[1]), sloped[2]))
            rim = max(1.0 - n / border[1], 0.0)
            total += border[0] * rim * rim + ahead[0]
            if given and drawn[i, j] == ahead[1]:
                total -= ahead[2]
            if n < border[2]:
                total += border[3]
            values[0, i, j] = total

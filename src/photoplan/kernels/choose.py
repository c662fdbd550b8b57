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
    xy: NDArray[np.float64],
    values: NDArray[np.float32],
) -> None:
    """Positions and k values of each pixel, by linear interpolation in (u, v, h) between nodes.

    nodes (2, rows, columns, 3 + k): homogeneous position and values at two levels; the first node lies `corner`
    (columns, rows) before the first pixel. Writes xy (height, width, 2) and values (k, height, width); NaN without
    surface, and at and behind the camera's plane.
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
            for k in range(3, nodes.shape[3]):
                values[k - 3, i, j] = found[k] if w > 0.0 else np.nan

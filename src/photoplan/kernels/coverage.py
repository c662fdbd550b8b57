"""Share of each pixel's area that a polygon covers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def cover(outline: NDArray[Any], total: NDArray[Any]) -> None:
    """Area to the right of every edge, summed with the sign of its direction: 0 outside a polygon, ±1 inside.

    An edge is cut at the borders of pixels; a piece in a pixel covers a trapezoid of it and all pixels to its right.

    Parameters
    ----------
    outline : ndarray, shape (n, 2)
        Column and row of the vertices, the first pixel from 0 to 1; finite.
    total : ndarray, shape (rows, columns + 1)
        Filled; its last column is without meaning.
    """
    rows, columns = total.shape[0], total.shape[1] - 1
    total[:] = 0.0
    for i in range(outline.shape[0]):
        j = i + 1 if i + 1 < outline.shape[0] else 0
        sign = 1.0 if outline[i, 1] < outline[j, 1] else -1.0
        upper, lower = (i, j) if sign > 0.0 else (j, i)
        ax, ay = outline[upper, 0], outline[upper, 1]
        dx, dy = outline[lower, 0] - ax, outline[lower, 1] - ay
        if dy == 0.0:
            continue
        for row in range(int(np.floor(min(max(ay, 0.0), rows))), int(np.ceil(max(min(ay + dy, rows), 0.0)))):
            top, bottom = max((row - ay) / dy, 0.0), min((row + 1 - ay) / dy, 1.0)
            if top >= bottom:
                continue
            left, right = ax + top * dx, ax + bottom * dx
            if left > right:
                left, right = right, left
            height = sign * (bottom - top) * dy
            at, more = left, True
            while more:
                stop = right
                if at < 0.0:
                    stop = min(right, 0.0)
                elif at < columns:
                    stop = min(right, np.floor(at) + 1.0)
                area = height * (stop - at) / (right - left) if right > left else height
                x = min(max((at + stop) / 2.0, 0.0), float(columns))
                column = min(int(x), columns - 1)
                total[row, column] += area * (column + 1 - x)
                total[row, column + 1] += area * (x - column)
                at, more = stop, stop < right
    for row in range(rows):
        for column in range(1, columns):
            total[row, column] += total[row, column - 1]

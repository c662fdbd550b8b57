"""Lines of a width in pixels: how much of each pixel they cover."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel


@inner
def _below(d: float, a: float, b: float) -> float:
    """Part of a pixel, a square, on one side of a line at a distance d from its centre; a ≥ b ≥ 0 are the parts of the
    line's normal along the sides of the pixel."""
    far = abs(d)
    if far >= 0.5 * (a + b):
        tail = 0.0
    elif far <= 0.5 * (a - b):
        tail = 0.5 - far / a
    else:
        tail = (0.5 * (a + b) - far) ** 2 / (2.0 * a * b)
    return 1.0 - tail if d > 0.0 else tail


@kernel
def draw_strokes(segments: NDArray[Any], width: float, cover: NDArray[Any]) -> None:
    """Cover pixels with segments that have round ends.

    A pixel has the part of its area that a stripe of this width takes, so that a line's sum over the pixels is its
    width by its length, in every direction and wherever it lies between the pixels; where segments meet the larger
    counts. Ends are round nearly.

    Parameters
    ----------
    segments : ndarray, shape (n, 4)
        Column and row of both ends; (0, 0) is the centre of the first pixel.
    width : float
        Pixels.
    cover : ndarray, shape (rows, columns), float32
        Raised to the part of each pixel that is covered, 0 to 1.
    """
    rows, columns = cover.shape
    half, reach = width / 2.0, width / 2.0 + 0.75
    for i in range(segments.shape[0]):
        x, y, u, v = segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3]
        dx, dy = u - x, v - y
        squared = dx * dx + dy * dy
        first, last = max(0.0, np.ceil(min(y, v) - reach)), min(rows - 1.0, np.floor(max(y, v) + reach))
        for row in range(int(first), int(last) + 1):
            begin, end = 0.0, 1.0
            if abs(dy) > 1e-9:
                # The part of the segment that comes near this row.
                begin, end = (row - reach - y) / dy, (row + reach - y) / dy
                begin, end = max(min(begin, end), 0.0), min(max(begin, end), 1.0)
            left = min(x + begin * dx, x + end * dx) - reach
            right = max(x + begin * dx, x + end * dx) + reach
            for column in range(int(max(0.0, np.ceil(left))), int(min(columns - 1.0, np.floor(right))) + 1):
                px, py, t = column - x, row - y, 0.0
                if squared > 0.0:
                    t = min(max((px * dx + py * dy) / squared, 0.0), 1.0)
                px, py = px - t * dx, py - t * dy
                away = np.sqrt(px * px + py * py)
                if away > reach:
                    continue
                # The normal of the line; on its axis that of the segment.
                if away > 1e-9:
                    nx, ny = abs(px) / away, abs(py) / away
                elif squared > 0.0:
                    nx, ny = abs(dy) / np.sqrt(squared), abs(dx) / np.sqrt(squared)
                else:
                    nx, ny = 1.0, 0.0
                a, b = max(nx, ny), min(nx, ny)
                value = _below(away + half, a, b) - _below(away - half, a, b)
                if value > cover[row, column]:
                    cover[row, column] = value

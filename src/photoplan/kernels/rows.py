"""A field that belongs to the rows of the image: at which row of a turbulent flight each pixel of a run is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner


@inner
def _at_row(nodes: NDArray[np.float32], row: int, place: tuple[int, float], h: float, c: int) -> float:
    """Shift along x or y (c) of a row of the nodes; place: column and fraction in it."""
    col, fx = place
    left = nodes[row, col, c] + h * nodes[row, col, c + 2]
    right = nodes[row, col + 1, c] + h * nodes[row, col + 1, c + 2]
    return left + fx * (right - left)


@inner
def _root(a: float, b: float, c: float, d: float) -> float:
    """Where the cubic convolution of values at −1, 0, 1, 2 is 0, between 0 and 1; b <= 0 < c."""
    c1, c2, c3 = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
    low, high, t = 0.0, 1.0, b / (b - c)
    for _ in range(12):
        value = ((c3 * t + c2) * t + c1) * t + b
        if value > 0.0:
            high = t
        else:
            low = t
        slope = (3.0 * c3 * t + 2.0 * c2) * t + c1
        new = t - value / slope if slope != 0.0 else low
        if not (new >= low and new <= high):
            new = 0.5 * (low + high)
        step = new - t
        t = new
        if abs(step) < 1e-6:
            break
    return t


@inner
def add_rows(
    frame: NDArray[np.float64],
    nodes: NDArray[np.float32],
    origin: NDArray[np.float64],
    heights: NDArray[np.float32],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
) -> None:
    """Add a field that belongs to rows: the first row is found at which a position is seen; NaN where there is none.

    Between the rows shifts are cubic. In the last column of the nodes stands how far the rows up to each have come at
    most, so that none before it needs to be looked at.
    """
    per_x, per_y, nowhere = frame[2], frame[3], np.float32(np.nan)
    first_x, first_y = (origin[0] - frame[0]) * per_x, (origin[1] - frame[1]) * per_y
    last_x, last, furthest = nodes.shape[1] - 2, nodes.shape[0] - 3, nodes.shape[1] - 1
    line = 1
    for i in range(dx.shape[0]):
        x, y, h = first_x + dx[i] * per_x, first_y + dy[i] * per_y, heights[i] - frame[5]
        if not (x >= 0.0 and x < last_x and y == y):
            dx[i], dy[i] = nowhere, nowhere
            continue
        place = (int(x), x - np.floor(x))
        while line > 1 and nodes[line, furthest, 0] > y:
            line -= 1
        while line <= last and nodes[line + 1, furthest, 0] <= y:
            line += 1
        row, c = line, 0.0
        while row <= last:
            c = (row + 1) - per_y * _at_row(nodes, row + 1, place, h, 1) - y
            if c > 0.0:
                break
            row += 1
        line = min(line, last)
        b = 1.0 if row > last else row - per_y * _at_row(nodes, row, place, h, 1) - y
        if b > 0.0:
            dx[i], dy[i] = nowhere, nowhere
            continue
        a = (row - 1) - per_y * _at_row(nodes, row - 1, place, h, 1) - y
        d = (row + 2) - per_y * _at_row(nodes, row + 2, place, h, 1) - y
        t = _root(a, b, c, d)
        dy[i] += np.float32((row + t - y) / per_y)
        a, b = _at_row(nodes, row - 1, place, h, 0), _at_row(nodes, row, place, h, 0)
        c, d = _at_row(nodes, row + 1, place, h, 0), _at_row(nodes, row + 2, place, h, 0)
        c1, c2, c3 = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
        dx[i] += np.float32(((c3 * t + c2) * t + c1) * t + b)

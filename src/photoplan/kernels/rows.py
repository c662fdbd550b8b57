"""A field that belongs to the rows of the image: at which row of a turbulent flight each pixel of a run is seen.

Nodes are (rows, columns, 5): shift along x and y, the change of both per metre of height, and the furthest ideal row
that any row up to this one sees between this column of nodes and the next.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner


@inner
def _at_row(nodes: NDArray[np.float32], row: int, place: tuple[int, float, float], c: int) -> float:
    """Shift along x or y (c) of a row of the nodes; place: column, fraction in it, height."""
    col, fx, h = place
    left = nodes[row, col, c] + h * nodes[row, col, c + 2]
    right = nodes[row, col + 1, c] + h * nodes[row, col + 1, c + 2]
    return left + fx * (right - left)


@inner
def _root(c1: float, c2: float, c3: float, b: float, start: float) -> float:
    """Where ((c3·t + c2)·t + c1)·t + b is 0, between 0 and 1; b <= 0, and the value at 1 is above 0."""
    low, high, t = 0.0, 1.0, start
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
def column_of(frame: NDArray[np.float64], nodes: NDArray[np.float32], x: float) -> tuple[int, float]:
    """Column of the nodes left of an ideal x in the window, and the fraction in it; −1 beyond the nodes and for NaN."""
    at = (x - frame[0]) * frame[2]
    if not (at >= 0.0 and at < nodes.shape[1] - 1):
        return -1, 0.0
    return int(at), at - np.floor(at)


@inner
def shift_across(
    frame: NDArray[np.float64], nodes: NDArray[np.float32], y: float, place: tuple[int, float, float]
) -> float:
    """How far the row y of the window lies beside the straight flight: each row has a place of its own across."""
    at = min(max((y - frame[1]) * frame[3], 0.0), nodes.shape[0] - 1.0)
    row = int(at)
    value = _at_row(nodes, row, place, 0)
    part = at - row
    # Rows of a reduced image lie between nodes.
    if part > 0.0:
        value += part * (_at_row(nodes, row + 1, place, 0) - value)
    return value


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

    Between the rows shifts are cubic.
    """
    per_y, nowhere = frame[3], np.float32(np.nan)
    first_y, last = (origin[1] - frame[1]) * per_y, nodes.shape[0] - 3
    line = 1
    for i in range(dx.shape[0]):
        col, fx = column_of(frame, nodes, origin[0] + dx[i])
        y = first_y + dy[i] * per_y
        if not (col >= 0 and y == y):
            dx[i], dy[i] = nowhere, nowhere
            continue
        place = (col, fx, np.float64(heights[i]) - frame[5])
        while line > 1 and nodes[line, col, 4] * per_y > y:
            line -= 1
        while line <= last and nodes[line + 1, col, 4] * per_y <= y:
            line += 1
        line = min(line, last)
        row, b, c = line, 1.0, line - per_y * _at_row(nodes, line, place, 1) - y
        while row <= last:
            b, c = c, (row + 1) - per_y * _at_row(nodes, row + 1, place, 1) - y
            if c > 0.0:
                break
            row += 1
        if row > last or not b <= 0.0:
            dx[i], dy[i] = nowhere, nowhere
            continue
        a = (row - 1) - per_y * _at_row(nodes, row - 1, place, 1) - y
        d = (row + 2) - per_y * _at_row(nodes, row + 2, place, 1) - y
        c1, c2, c3 = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
        t = _root(c1, c2, c3, b, b / (b - c))
        dy[i] += np.float32((row + t - y) / per_y)
        a, b = _at_row(nodes, row - 1, place, 0), _at_row(nodes, row, place, 0)
        c, d = _at_row(nodes, row + 1, place, 0), _at_row(nodes, row + 2, place, 0)
        c1, c2, c3 = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
        dx[i] += np.float32(((c3 * t + c2) * t + c1) * t + b)

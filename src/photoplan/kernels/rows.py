"""A field that belongs to the rows of the image: at which row of a turbulent flight each pixel of a run is seen.

Nodes are (rows, columns, 5): shift along x and y, the change of both per metre of height, and the furthest ideal row
that any row up to this one sees between this column of nodes and the next. Kernels take them by cells, see `row_cells`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner

CELL = 9
"""Numbers of a cell; what tells such a field from others."""
#: What may be left of a row, rows.
_LEFT = np.float32(2e-6)


def row_cells(nodes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Nodes (rows, columns, 5) as cells (rows, columns − 1, CELL).

    Shift along x at the left node, its change per metre, and how much more both are at the right node; the same along
    y; the furthest ideal row.
    """
    left, more = nodes[:, :-1], np.diff(nodes, axis=1)
    parts = [np.stack([left[..., c], left[..., c + 2], more[..., c], more[..., c + 2]], axis=-1) for c in (0, 1)]
    return np.concatenate([*parts, left[..., 4:]], axis=-1)


@inner
def _at_row(cells: NDArray[np.float32], row: int, place: tuple[Any, ...], c: int) -> Any:
    """Shift along x (c = 0) or y (c = 4) of a row; place: column of the cell, fraction in it, height; float32."""
    col, fx, h = np.uint64(place[0]), place[1], place[2]
    cell = cells[np.uint64(row), col]
    return (cell[c] + h * cell[c + 1]) + fx * (cell[c + 2] + h * cell[c + 3])


@inner
def _root(c1: Any, c2: Any, c3: Any, b: Any, start: Any) -> Any:
    """Where ((c3·t + c2)·t + c1)·t + b is 0, between 0 and 1; b <= 0, and the value at 1 is above 0; float32."""
    low, high, t = np.float32(0.0), np.float32(1.0), start
    two, three, half = np.float32(2.0), np.float32(3.0), np.float32(0.5)
    for _ in range(12):
        value = ((c3 * t + c2) * t + c1) * t + b
        if value > 0.0:
            high = t
        else:
            low = t
        slope = (three * c3 * t + two * c2) * t + c1
        new = t - value / slope if slope != 0.0 else low
        if not (new >= low and new <= high):
            new = half * (low + high)
        step = new - t
        t = new
        # What is left after a step of Newton's method goes with its square, and with how bent the cubic is.
        if step * step * abs(c2 + three * c3 * t) <= _LEFT * abs(slope):
            break
    return t


@inner
def column_of(frame: NDArray[np.float64], cells: NDArray[np.float32], x: float) -> tuple[int, Any]:
    """Column of the cell of an ideal x in the window, and the fraction in it; −1 beyond the nodes and for NaN."""
    at = (x - frame[0]) * frame[2]
    if not (at >= 0.0 and at < cells.shape[1]):
        return -1, np.float32(0.0)
    return int(at), np.float32(at - np.floor(at))


@inner
def shift_of_row(cells: NDArray[np.float32], row: int, place: tuple[Any, ...]) -> Any:
    """How far a row of the cells lies beside the straight flight."""
    return _at_row(cells, row, place, 0)


@inner
def shift_across(frame: NDArray[np.float64], cells: NDArray[np.float32], y: float, place: tuple[Any, ...]) -> Any:
    """How far the row y of the window lies beside the straight flight: each row has a place of its own across."""
    at = min(max((y - frame[1]) * frame[3], 0.0), cells.shape[0] - 1.0)
    row = int(at)
    value = _at_row(cells, row, place, 0)
    part = np.float32(at - row)
    # Rows of a reduced image lie between nodes.
    if part > 0.0:
        value += part * (_at_row(cells, row + 1, place, 0) - value)
    return value


@inner
def add_rows(
    frame: NDArray[np.float64],
    cells: NDArray[np.float32],
    origin: NDArray[np.float64],
    heights: NDArray[np.float32],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
) -> None:
    """Add a field that belongs to rows: the first row is found at which a position is seen; NaN where there is none.

    Between the rows shifts are cubic.
    """
    nowhere, per_y, level = np.float32(np.nan), np.float32(frame[3]), np.float32(frame[5])
    first_x, first_y = origin[0], (origin[1] - frame[1]) * frame[3]
    last = cells.shape[0] - 3
    line = 1
    for i in range(dx.shape[0]):
        col, fx = column_of(frame, cells, first_x + dx[i])
        y = first_y + dy[i] * frame[3]
        if not (col >= 0 and y == y):
            dx[i], dy[i] = nowhere, nowhere
            continue
        place = (col, fx, heights[i] - level)
        column = np.uint64(col)
        while line > 1 and cells[np.uint64(line), column, 8] * per_y > y:
            line -= 1
        while line <= last and cells[np.uint64(line + 1), column, 8] * per_y <= y:
            line += 1
        line = min(line, last)
        # How far rows see behind the position; relative to it, so that single precision does.
        row, b, c = line, np.float32(1.0), np.float32(line - y) - per_y * _at_row(cells, line, place, 4)
        while row <= last:
            b, c = c, np.float32(row + 1 - y) - per_y * _at_row(cells, row + 1, place, 4)
            if c > 0.0:
                break
            row += 1
        if row > last or not b <= 0.0:
            dx[i], dy[i] = nowhere, nowhere
            continue
        a = np.float32(row - 1 - y) - per_y * _at_row(cells, row - 1, place, 4)
        d = np.float32(row + 2 - y) - per_y * _at_row(cells, row + 2, place, 4)
        c1, c2, c3 = _cubic(a, b, c, d)
        t = _root(c1, c2, c3, b, b / (b - c))
        dy[i] += (np.float32(row - y) + t) / per_y
        b = _at_row(cells, row, place, 0)
        c1, c2, c3 = _cubic(
            _at_row(cells, row - 1, place, 0), b, _at_row(cells, row + 1, place, 0), _at_row(cells, row + 2, place, 0)
        )
        dx[i] += ((c3 * t + c2) * t + c1) * t + b


@inner
def _cubic(a: Any, b: Any, c: Any, d: Any) -> tuple[Any, Any, Any]:
    """Factors of t, t² and t³ of the cubic convolution of values at −1, 0, 1, 2; float32."""
    half, three = np.float32(0.5), np.float32(1.5)
    return half * (c - a), a - np.float32(2.5) * b + np.float32(2.0) * c - half * d, half * (d - a) + three * (b - c)

"""Bilinear heights from a regular grid of posts.

One rule for both functions: positions are (x, y) = (column, row) of posts. A position on a post (to 1e-6 of a cell)
needs that post alone, one on a grid line two, any other four. NaN in a post that is needed gives NaN. In the outer half
cell the edge value is continued; farther outside the result is NaN.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

_ON_POST = 1e-6
# Lattices coarser than this many posts skip most of a row; there is then nothing to gain from whole rows.
_SPARSE = 2.0


@inner
def _post(x: float, count: int) -> tuple[Any, Any]:
    """Lower post and weight of the upper one, −1 if outside; the upper post is used only if its weight is not 0."""
    if not (x >= -0.5 - _ON_POST and x <= count - 0.5 + _ON_POST):
        return -1, 0.0
    x = min(max(x, 0.0), count - 1.0)
    nearest = np.floor(x + 0.5)
    if abs(x - nearest) <= _ON_POST:
        return np.int64(nearest), 0.0
    lower = np.floor(x)
    return np.int64(lower), x - lower


@inner
def _bilinear(grid: NDArray[np.float32], col: int, row: int, fx: float, fy: float) -> float:
    right, below = (1 if fx > 0.0 else 0), (1 if fy > 0.0 else 0)
    upper, lower = grid[row, col], grid[row + below, col]
    a = upper + fx * (grid[row, col + right] - upper) if right else upper
    b = lower + fx * (grid[row + below, col + right] - lower) if right else lower
    return a + fy * (b - a) if below else a


@inner
def _blend_row(grid: NDArray[np.float32], row: int, fy: float, first: int, line: NDArray[np.float32]) -> None:
    """line[k] = grid at column first + k, fractional row row + fy."""
    upper = grid[row, first : first + line.shape[0]]
    if fy > 0.0:
        weight = np.float32(fy)
        lower = grid[row + 1, first : first + line.shape[0]]
        for k in range(line.shape[0]):
            line[k] = upper[k] + weight * (lower[k] - upper[k])
    else:
        for k in range(line.shape[0]):
            line[k] = upper[k]


@inner
def _dense_row(
    line: NDArray[np.float32], picks: NDArray[np.int32], weights: NDArray[np.float32], target: NDArray[Any]
) -> None:
    """Linear interpolation along one row; a post without weight is not touched by NaN beside it."""
    none = np.float32(0.0)
    for i in range(target.shape[0]):
        k, weight = picks[i], weights[i]
        a, b = line[k], line[k + 1]
        between = a + weight * (b - a)
        target[i] = a if weight == none else between


@kernel
def _lattice(
    grid: NDArray[np.float32], columns: tuple[float, float], rows: tuple[float, float], result: NDArray[Any]
) -> None:
    """See `sample_lattice`; columns = (x0, dx), rows = (y0, dy)."""
    ny, nx = result.shape
    picks, weights = np.empty(nx, np.int32), np.empty(nx, np.float32)
    first, last, start, stop = grid.shape[1], 0, nx, 0
    for i in range(nx):
        post, fraction = _post(columns[0] + i * columns[1], grid.shape[1])
        picks[i], weights[i] = post, np.float32(fraction)
        if post >= 0:
            first, last = min(first, post), max(last, post)
            start, stop = min(start, i), i + 1
    if start >= stop:
        return
    for i in range(start, stop):
        picks[i] -= first
    sparse = abs(columns[1]) > _SPARSE
    # One more element than the last post: its right neighbour is read, though with no weight at the grid's edge.
    line = np.zeros(last - first + 2, np.float32)
    inside = min(last - first + 2, grid.shape[1] - first)
    for j in range(ny):
        row, fy = _post(rows[0] + j * rows[1], grid.shape[0])
        if row < 0:
            continue
        if sparse:
            for i in range(start, stop):
                result[j, i] = _bilinear(grid, first + picks[i], row, weights[i], fy)
        else:
            _blend_row(grid, row, fy, first, line[:inside])
            _dense_row(line, picks[start:stop], weights[start:stop], result[j, start:stop])


def sample_lattice(
    grid: NDArray[np.float32], x0: float, dx: float, nx: int, y0: float, dy: float, ny: int
) -> NDArray[np.float32]:
    """Heights of a lattice parallel to the grid.

    Parameters
    ----------
    grid : ndarray, shape (rows, cols), float32
        Posts; NaN = no height.
    x0, dx, nx : float, float, int
        Column of the first point in posts, step, number of columns; the step may be negative.
    y0, dy, ny : float, float, int
        The same for rows.

    Returns
    -------
    ndarray, shape (ny, nx), float32
        NaN where a post with weight is NaN, or more than half a cell outside.
    """
    result = np.full((ny, nx), np.nan, np.float32)
    if grid.size and result.size:
        grid = np.ascontiguousarray(grid, np.float32)
        _lattice(grid, (float(x0), float(dx)), (float(y0), float(dy)), result)
    return result


@kernel
def _points(grid: NDArray[np.float32], xy: NDArray[np.float64], result: NDArray[Any]) -> None:
    for i in range(xy.shape[0]):
        col, fx = _post(xy[i, 0], grid.shape[1])
        row, fy = _post(xy[i, 1], grid.shape[0])
        if col >= 0 and row >= 0:
            result[i] = _bilinear(grid, col, row, fx, fy)


def sample_points(grid: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float32]:
    """Heights at scattered points.

    Parameters
    ----------
    grid : ndarray, shape (rows, cols), float32
        Posts; NaN = no height.
    xy : ndarray, shape (n, 2), float64
        Column and row in posts; NaN gives NaN.

    Returns
    -------
    ndarray, shape (n,), float32
        NaN as in `sample_lattice`.
    """
    result = np.full(len(xy), np.nan, np.float32)
    if grid.size and result.size:
        _points(np.ascontiguousarray(grid, np.float32), np.ascontiguousarray(xy, np.float64), result)
    return result

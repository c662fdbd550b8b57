"""Lowest and highest posts of blocks of a height grid, block in block: what lets rays skip terrain."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

Pyramid = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]
"""Lowest and highest posts of all levels, and start, rows, columns of each level: see `pyramid_of`."""


@inner
def _ranges(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> None:
    """Lowest and highest post of each mesh, or of its triangles; NaN does not count; inf and −inf: there is none."""
    for j in range(low.shape[0]):
        for i in range(low.shape[1]):
            bottom, top = np.float32(np.inf), np.float32(-np.inf)
            m = j * low.shape[1] + i
            if start.shape[0] > 0 and start[m + 1] > start[m]:
                for f in range(start[m], start[m + 1]):
                    for k in range(3):
                        z = vertices[corners[f, k], 2]
                        # Rounded to float32, a bound must still be one.
                        bottom = min(bottom, np.float32(z - abs(z) * 1e-6))
                        top = max(top, np.float32(z + abs(z) * 1e-6))
            else:
                for k in range(4):
                    h = posts[j + (k >> 1), i + (k & 1)]
                    bottom = h if h < bottom else bottom
                    top = h if h > top else top
            low[j, i], high[j, i] = bottom, top


@inner
def _halve(fine: NDArray[np.float32], coarse: NDArray[np.float32], sign: float) -> None:
    """Of four blocks each the highest for sign 1, the lowest for −1."""
    for j in range(coarse.shape[0]):
        for i in range(coarse.shape[1]):
            best = np.float32(-np.inf)
            for row in range(2 * j, min(2 * j + 2, fine.shape[0])):
                for col in range(2 * i, min(2 * i + 2, fine.shape[1])):
                    value = np.float32(sign) * fine[row, col]
                    best = value if value > best else best
            coarse[j, i] = np.float32(sign) * best


@kernel
def _fill(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64],
    corners: NDArray[np.int32],
    start: NDArray[np.int64],
    levels: NDArray[np.int64],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> None:
    """Ranges of the meshes, then of each level from the one below."""
    for n in range(levels.shape[0]):
        first, rows, columns = levels[n]
        here = slice(first, first + rows * columns)
        bottom, top = low[here].reshape(rows, columns), high[here].reshape(rows, columns)
        if n == 0:
            _ranges(posts, vertices, corners, start, bottom, top)
            continue
        first, rows, columns = levels[n - 1]
        below = slice(first, first + rows * columns)
        _halve(low[below].reshape(rows, columns), bottom, -1.0)
        _halve(high[below].reshape(rows, columns), top, 1.0)


def pyramid_of(
    posts: NDArray[np.float32],
    vertices: NDArray[np.float64] | None = None,
    corners: NDArray[np.int32] | None = None,
    start: NDArray[np.int64] | None = None,
) -> Pyramid:
    """Ranges of blocks of 1, 2, 4 … meshes.

    Parameters
    ----------
    posts : ndarray, shape (rows, cols), float32
        At least two posts each way; NaN = no height.
    vertices, corners, start : ndarray, optional
        Triangles of `MeshFaces`; meshes that have some count by these.

    Returns
    -------
    low, high : ndarray, float32
        All levels, one after the other, row by row; inf and −inf where a block has no height.
    levels : ndarray, shape (n, 3), int64
        Start in `low` and `high`, rows and columns of each level.
    """
    if vertices is None or corners is None or start is None:
        vertices, corners, start = np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.int64)
    levels = _levels(posts.shape[0] - 1, posts.shape[1] - 1)
    low, high = np.empty((2, int(levels[-1].sum()) - 1), np.float32)
    _fill(posts, vertices, corners, start, levels, low, high)
    return low, high, levels


@lru_cache(maxsize=64)
def _levels(rows: int, columns: int) -> NDArray[np.int64]:
    """Start, rows and columns of each level; the last one has one block."""
    levels = [(0, rows, columns)]
    while max(rows, columns) > 1:
        start = levels[-1][0] + rows * columns
        rows, columns = (rows + 1) // 2, (columns + 1) // 2
        levels.append((start, rows, columns))
    return np.array(levels, np.int64)


@inner
def leave(block: int, level: int, start: float, step: float) -> float:
    """Parameter at which a line leaves a block in one direction of the grid; infinite if it runs along it."""
    if step > 0.0:
        return (((block + 1) << level) - start) / step
    if step < 0.0:
        return ((block << level) - start) / step
    return np.inf

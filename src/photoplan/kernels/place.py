"""First step of a tile: where each pixel's taps begin, their fractions, and what kind of pixel it is.

Nothing here depends on the type of the pixels, so it is compiled once for all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.position import RUN, cell_space, locate_run
from photoplan.kernels.rows import CELL

EMPTY, INTERIOR, BORDER, AVERAGE = 0, 1, 2, 3
"""Kinds of pixels: outside or without relief; all taps inside and valid; some not; averaged over a wider kernel."""

NOTHING, ALL, SOME = 0, 1, 2
"""Whether a run has no pixel, only pixels, or some pixels of kind INTERIOR."""


def empty_block(count: int) -> tuple[Any, ...]:
    """Working space for `count` runs.

    Returns
    -------
    tuple of arrays
        corner (count, 2) int64: column and row to be added to those of `taps`;
        taps (count, 2, RUN) int32: column and row of the first tap of each pixel;
        part (count, 2, RUN) float32: g along x and y;
        fill (count,) uint8: NOTHING, ALL, SOME;
        kind (count, RUN) uint8: kind of each pixel, where `fill` is not ALL;
        ideal (count, RUN) float32: x of each pixel from `corner` on, without a field that belongs to rows; else unused.
    """
    return (
        np.empty((count, 2), np.int64),
        np.empty((count, 2, RUN), np.int32),
        np.empty((count, 2, RUN), np.float32),
        np.empty((count, RUN), np.uint8),
        np.empty(count, np.uint8),
        np.empty((count, RUN), np.float32),
    )


@inner
def _split(
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
    edges: tuple[Any, ...],
    inner_edges: tuple[Any, ...],
    shift: float,
    located: tuple[Any, ...],
    kind: NDArray[Any],
) -> tuple[Any, Any]:
    """Whole and fractional positions of a run, relative to its origin; returns the counts of BORDER and INTERIOR.

    edges: left, top, right, bottom of the image, float32; inner_edges: lowest and highest column and row whose taps are
    all inside the source, int32; shift: 1/2 to round to the nearest, 0 to round down. Positions beyond the edges and
    NaN become 0.
    """
    left, top, right, bottom = edges
    low_col, low_row, high_col, high_row = inner_edges
    columns, rows, across, down = located
    half, nothing = np.float32(0.5), np.float32(0.0)
    # The outer edge of the last pixel still belongs to it, also when rounding to the nearest.
    last_x, last_y = np.ceil(right - half), np.ceil(bottom - half)
    placed, interior = np.int32(0), np.int32(0)
    for i in range(dx.shape[0]):
        x, y = dx[i], dy[i]
        good = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        x = x if good else nothing
        y = y if good else nothing
        fx, fy = np.floor(x + shift), np.floor(y + shift)
        fx = last_x if fx > last_x else fx
        fy = last_y if fy > last_y else fy
        col, row = np.int32(fx), np.int32(fy)
        columns[i], rows[i] = col, row
        across[i] = x - fx - half
        down[i] = y - fy - half
        whole = good & (col >= low_col) & (col <= high_col) & (row >= low_row) & (row <= high_row)
        kind[i] = np.int32(good) + np.int32(good) - np.int32(whole)
        placed += np.int32(good)
        interior += np.int32(whole)
    return placed - interior, interior


@inner
def _limit(value: float) -> np.int32:
    """As int32, cut where no position within a run can reach."""
    return np.int32(min(max(value, -(1 << 30)), 1 << 30))


@inner
def _look_at_mask(
    solid: NDArray[np.uint8],
    corner: NDArray[np.int64],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    kind: NDArray[Any],
) -> int:
    """Turn INTERIOR pixels with an invalid tap into BORDER; returns how many."""
    count = 0
    for i in range(kind.shape[0]):
        if kind[i] == INTERIOR and solid[corner[1] + rows[i], corner[0] + columns[i]] == 0:
            kind[i] = BORDER
            count += 1
    return count


@kernel
def place_runs(
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    relief: NDArray[np.float32],
    offset: tuple[int, int],
    frame: tuple[Any, ...],
    block: tuple[Any, ...],
    out_valid: NDArray[np.bool_],
) -> int:
    """Place the pixels of some runs.

    Parameters
    ----------
    anchors : tuple
        rects, box_start, box_heights, corners, field_frame, field, as in `rectify_tile`.
    runs : (k, 5) int32
        See `tile_runs`.
    relief : (rows, cols) float32
    offset : (col, row)
        First pixel of `relief` in the tile's pixels.
    frame : tuple
        taps; width and height of the source; `solid_patches` of its mask or an empty array; border (4 numbers).
    block : tuple
        See `empty_block`; filled.
    out_valid : (rows, cols) bool
        Filled: True where INTERIOR.

    Returns
    -------
    int
        Number of BORDER pixels.
    """
    taps, width, height, solid, border = frame
    corner, first, part, kind, fill, ideal = block
    by_rows = anchors[5].shape[2] == CELL
    before, shift = max(taps // 2 - 1, 0), np.float32(0.5 if taps == 1 else 0.0)
    origin = np.empty(2)
    located_by = (origin, np.empty((4, 3)), cell_space())
    moved, kinds = np.empty((2, RUN), np.float32), np.empty(RUN, np.int32)
    doubtful = 0
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        dx, dy = moved[0, :n], moved[1, :n]
        locate_run(anchors, runs[k], relief[row, col : col + n], located_by, dx, dy)
        edges = (
            np.float32(border[0] - origin[0]),
            np.float32(border[1] - origin[1]),
            np.float32(border[2] - origin[0]),
            np.float32(border[3] - origin[1]),
        )
        if by_rows:
            for i in range(n):
                ideal[k, i] = located_by[2][1][i] + np.float32(before)
        x0, y0 = np.int64(origin[0]) - before, np.int64(origin[1]) - before
        corner[k, 0], corner[k, 1] = x0, y0
        reach = (_limit(-x0), _limit(-y0), _limit(width - taps - x0), _limit(height - taps - y0))
        located = (first[k, 0], first[k, 1], part[k, 0], part[k, 1])
        some, whole = _split(dx, dy, edges, reach, shift, located, kinds)
        valid_line = out_valid[row, col : col + n]
        if whole == n and solid.size == 0:
            fill[k] = ALL
            for i in range(n):
                valid_line[i] = True
            continue
        line = kind[k]
        for i in range(n):
            line[i] = kinds[i]
        if solid.size > 0:
            lost = _look_at_mask(solid, corner[k], first[k, 0], first[k, 1], line[:n])
            some, whole = some + lost, whole - lost
        fill[k] = SOME if whole > 0 else NOTHING
        doubtful += some
        for i in range(n):
            valid_line[i] = line[i] == INTERIOR
    return doubtful

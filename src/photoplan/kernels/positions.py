"""Positions of a tile's pixels in its source window, from anchors, and the taps of the resampling kernel there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel, maker

# Line offsets: at which image line of a turbulent flight each pixel of a run is seen.
#
# Nodes are (rows, columns, 5): shift along x and y, the change of both per metre of height, and the furthest ideal row
# that any row up to this one sees between this column of nodes and the next. Kernels take them by cells, see
# `line_offset_cells`.


CELL = 9
"""Numbers of a cell; what tells such a field from others."""
#: What may be left of a row, rows.
_LEFT = np.float32(2e-6)


def line_offset_cells(nodes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Nodes (rows, columns, 5) as cells (rows, columns − 1, CELL).

    Shift along x at the left node, its change per metre, and how much more both are at the right node; the same along
    y; the furthest ideal row.
    """
    left, more = nodes[:, :-1], np.diff(nodes, axis=1)
    parts = [np.stack([left[..., c], left[..., c + 2], more[..., c], more[..., c + 2]], axis=-1) for c in (0, 1)]
    return np.concatenate([*parts, left[..., 4:]], axis=-1)


@inner
def _offset_at(cells: NDArray[np.float32], row: int, place: tuple[Any, ...], c: int) -> Any:
    """Shift along x (c = 0) or y (c = 4) of a row; place: column of the cell, fraction in it, height; float32."""
    col, fx, h = np.uint64(place[0]), place[1], place[2]
    cell = cells[np.uint64(row), col]
    return (cell[c] + h * cell[c + 1]) + fx * (cell[c + 2] + h * cell[c + 3])


@inner
def _cubic_root(c1: Any, c2: Any, c3: Any, b: Any, start: Any) -> Any:
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
def offset_column(frame: NDArray[np.float64], cells: NDArray[np.float32], x: float) -> tuple[int, Any]:
    """Column of the cell of an ideal x in the window, and the fraction in it; −1 beyond the nodes and for NaN."""
    at = (x - frame[0]) * frame[2]
    if not (at >= 0.0 and at < cells.shape[1]):
        return -1, np.float32(0.0)
    return int(at), np.float32(at - np.floor(at))


@inner
def line_offset(cells: NDArray[np.float32], row: int, place: tuple[Any, ...]) -> Any:
    """How far a row of the cells lies beside the straight flight."""
    return _offset_at(cells, row, place, 0)


@inner
def line_offset_at(frame: NDArray[np.float64], cells: NDArray[np.float32], y: float, place: tuple[Any, ...]) -> Any:
    """How far the row y of the window lies beside the straight flight: each row has a place of its own across."""
    at = min(max((y - frame[1]) * frame[3], 0.0), cells.shape[0] - 1.0)
    row = int(at)
    value = _offset_at(cells, row, place, 0)
    part = np.float32(at - row)
    # Rows of a reduced image lie between nodes.
    if part > 0.0:
        value += part * (_offset_at(cells, row + 1, place, 0) - value)
    return value


@inner
def add_line_offsets(
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
        col, fx = offset_column(frame, cells, first_x + dx[i])
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
        row, b, c = line, np.float32(1.0), np.float32(line - y) - per_y * _offset_at(cells, line, place, 4)
        while row <= last:
            b, c = c, np.float32(row + 1 - y) - per_y * _offset_at(cells, row + 1, place, 4)
            if c > 0.0:
                break
            row += 1
        if row > last or not b <= 0.0:
            dx[i], dy[i] = nowhere, nowhere
            continue
        a = np.float32(row - 1 - y) - per_y * _offset_at(cells, row - 1, place, 4)
        d = np.float32(row + 2 - y) - per_y * _offset_at(cells, row + 2, place, 4)
        c1, c2, c3 = _cubic_convolution(a, b, c, d)
        t = _cubic_root(c1, c2, c3, b, b / (b - c))
        dy[i] += (np.float32(row - y) + t) / per_y
        b = _offset_at(cells, row, place, 0)
        c1, c2, c3 = _cubic_convolution(
            _offset_at(cells, row - 1, place, 0),
            b,
            _offset_at(cells, row + 1, place, 0),
            _offset_at(cells, row + 2, place, 0),
        )
        dx[i] += ((c3 * t + c2) * t + c1) * t + b


@inner
def _cubic_convolution(a: Any, b: Any, c: Any, d: Any) -> tuple[Any, Any, Any]:
    """Factors of t, t² and t³ of the cubic convolution of values at −1, 0, 1, 2; float32."""
    half, three = np.float32(0.5), np.float32(1.5)
    return half * (c - a), a - np.float32(2.5) * b + np.float32(2.0) * c - half * d, half * (d - a) + three * (b - c)


# Positions in the source window.
#
# Pixels are taken in runs of up to `RUN` columns of one row of a rectangle. The coefficients of a run are computed in
# double precision and refer to a whole source pixel near its middle; what is left per pixel is small, so single
# precision holds it to about 1e-5 pixel wherever the run lies in the source.


RUN = 256
"""Columns of a rectangle that share one set of coefficients."""


@inner
def run_coefficients(
    rect: NDArray[np.int32],
    heights: NDArray[np.float32],
    corners: NDArray[np.float64],
    u_ref: int,
    edges: tuple[Any, ...],
    coef: NDArray[np.float64],
) -> float:
    """One row of a box as polynomials in (u − u_ref, h − h_ref): fills coef (4, 3), returns h_ref.

    coef[:, c] are the factors of 1, u, h and u·h for c = x·w, y·w, w. `edges` are the weights of the rectangle's upper
    and lower edge: those of `row_weights` for the values, (−1, 1) / height for their derivatives along v.
    """
    a, b = edges
    width = float(rect[2] - rect[0])
    s = (u_ref - rect[0] + 0.5) / width
    rise = heights[1] - heights[0]
    h_ref = np.float64(np.float32(0.5 * (heights[0] + heights[1])))
    q = (h_ref - heights[0]) / rise if rise > 0.0 else 0.0
    per_metre = 1.0 / rise if rise > 0.0 else 0.0
    for c in range(3):
        p00 = a * corners[0, c] + b * corners[2, c]
        p01 = a * corners[1, c] + b * corners[3, c]
        p10 = a * corners[4, c] + b * corners[6, c]
        p11 = a * corners[5, c] + b * corners[7, c]
        along_u = p01 - p00
        along_h = p10 - p00
        twist = (p11 - p10) - along_u
        coef[0, c] = p00 + s * along_u + q * (along_h + s * twist)
        coef[1, c] = (along_u + q * twist) / width
        coef[2, c] = (along_h + s * twist) * per_metre
        coef[3, c] = twist / width * per_metre
    return h_ref


@inner
def row_weights(rect: NDArray[np.int32], v: int) -> tuple[float, float]:
    """Weights of a rectangle's upper and lower edge in row v."""
    t = (v - rect[1] + 0.5) / (rect[3] - rect[1])
    return 1.0 - t, t


@inner
def shift_origin(origin: NDArray[np.float64], coef: NDArray[np.float64]) -> None:
    """Refer coefficients to `origin`."""
    for k in range(4):
        coef[k, 0] -= origin[0] * coef[k, 2]
        coef[k, 1] -= origin[1] * coef[k, 2]


@inner
def middle_of_run(rect: NDArray[np.int32], run: NDArray[np.int32]) -> int:
    """Column that a run's coefficients refer to: its middle as the rectangle has it. Crops must get the same bytes."""
    return run[2] + min(RUN, rect[2] - run[2]) // 2


@inner
def run_origin(coef: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
    """Whole source pixel at the middle of the run, relative to which `_run_positions` works."""
    for c in range(2):
        value = np.floor(coef[0, c] / coef[0, 2])
        # Far or undefined positions are outside every window; the kernels only need a number that converts.
        origin[c] = value if abs(value) < 1e9 else 0.0


@inner
def to_single(coef: NDArray[np.float64], c: int) -> tuple[Any, ...]:
    """Factors of 1, u, h, u·h of component c in single precision."""
    return np.float32(coef[0, c]), np.float32(coef[1, c]), np.float32(coef[2, c]), np.float32(coef[3, c])


@inner
def _run_positions(
    coef: NDArray[np.float64],
    u_first: float,
    heights: NDArray[np.float32],
    h_ref: float,
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
) -> None:
    """Positions of a run from coefficients shifted to its origin; NaN heights give NaN.

    u_first is the first column relative to the reference column of `coef`.
    """
    x0, x1, x2, x3 = to_single(coef, 0)
    y0, y1, y2, y3 = to_single(coef, 1)
    w0, w1, w2, w3 = to_single(coef, 2)
    h0, first, one = np.float32(h_ref), np.float32(u_first), np.float32(1.0)
    for i in range(heights.shape[0]):
        u = first + np.float32(np.int32(i))
        h = heights[i] - h0
        inverse = one / ((w0 + w1 * u) + h * (w2 + w3 * u))
        dx[i] = ((x0 + x1 * u) + h * (x2 + x3 * u)) * inverse
        dy[i] = ((y0 + y1 * u) + h * (y2 + y3 * u)) * inverse


@inner
def _take_higher(
    heights: NDArray[np.float32],
    low: float,
    higher_x: NDArray[np.float32],
    higher_y: NDArray[np.float32],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
) -> None:
    """Take the higher box's positions where the height is not below it."""
    for i in range(heights.shape[0]):
        if heights[i] >= low:
            dx[i], dy[i] = higher_x[i], higher_y[i]


@maker
def cell_space() -> tuple[Any, ...]:
    """Working space of `find_cells` for one run."""
    return np.empty(RUN, np.int32), np.empty(RUN, np.float32), np.empty(RUN, np.float32)


@inner
def find_cells(
    frame: NDArray[np.float64],
    nodes: NDArray[np.float32],
    origin: NDArray[np.float64],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
    work: tuple[Any, ...],
) -> None:
    """Cells of the field and fractions within them for positions relative to `origin`.

    Fills work = (first element of each cell in the flat nodes, −1 beyond the nodes and for NaN; fractions along x, y).
    """
    cell, along_x, along_y = work
    rows, cols = nodes.shape[0], nodes.shape[1]
    first_x = np.float32((origin[0] - frame[0]) * frame[2])
    first_y = np.float32((origin[1] - frame[1]) * frame[3])
    per_x, per_y = np.float32(frame[2]), np.float32(frame[3])
    last_x, last_y, stride = np.float32(cols - 1), np.float32(rows - 1), np.float32(cols)
    nothing = np.float32(0.0)
    for i in range(dx.shape[0]):
        x, y = first_x + dx[i] * per_x, first_y + dy[i] * per_y
        inside = (x >= nothing) & (x < last_x) & (y >= nothing) & (y < last_y)
        x = x if inside else nothing
        y = y if inside else nothing
        col, row = np.floor(x), np.floor(y)
        along_x[i], along_y[i] = x - col, y - row
        first = np.int32(2) * np.int32(row * stride + col)
        cell[i] = first if inside else np.int32(-1)


@inner
def _add_field(
    nodes: NDArray[np.float32], work: tuple[Any, ...], dx: NDArray[np.float32], dy: NDArray[np.float32]
) -> None:
    """Add the field to the positions of a run, bilinear between nodes; positions beyond the nodes become NaN."""
    cell, along_x, along_y = work
    table = nodes.reshape(-1)
    # Unsigned, or every access would ask for a negative index.
    below = np.uint64(2 * nodes.shape[1])
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    for i in range(dx.shape[0]):
        a = np.uint64(np.uint32(max(cell[i], np.int32(0))))
        b = a + below
        fx, fy = along_x[i], along_y[i]
        upper_x = table[a] + fx * (table[a + two] - table[a])
        upper_y = table[a + one] + fx * (table[a + three] - table[a + one])
        lower_x = table[b] + fx * (table[b + two] - table[b])
        lower_y = table[b + one] + fx * (table[b + three] - table[b + one])
        dx[i] += upper_x + fy * (lower_x - upper_x)
        dy[i] += upper_y + fy * (lower_y - upper_y)
    nowhere = np.float32(np.nan)
    for i in range(dx.shape[0]):
        dx[i] = dx[i] if cell[i] >= 0 else nowhere
        dy[i] = dy[i] if cell[i] >= 0 else nowhere


@maker
def locate_run(
    anchors: tuple[Any, ...],
    run: NDArray[np.int32],
    heights: NDArray[np.float32],
    frame: tuple[Any, ...],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
) -> None:
    """Positions of the pixels of one run, relative to the run's origin.

    Parameters
    ----------
    anchors : tuple
        rects, box_start, box_heights, corners, field_frame, field, as in `rectify_tile`.
    run : (5,) int32
        A line of `tile_runs`.
    heights : (n,) float32
    frame : (origin (2,), coef (4, 3), working space for the field)
        Filled: the whole source pixel to be added to dx, dy; the coefficients of the highest box; of a field that
        belongs to rows, the x without it in the second part of the working space.
    dx, dy : (n,) float32
        Filled. With several boxes piled up, a pixel keeps what the highest box not above it says; heights below the
        lowest box are taken by that one.
    """
    rects, box_start, box_heights, corners, field_frame, field = anchors
    origin, coef, work = frame
    rect, lowest = rects[run[0]], box_start[run[0]]
    u_ref, edges = middle_of_run(rect, run), row_weights(rect, run[1])
    for box in range(lowest, box_start[run[0] + 1]):
        h_ref = run_coefficients(rect, box_heights[box], corners[box], u_ref, edges, coef)
        if box == lowest:
            run_origin(coef, origin)
        shift_origin(origin, coef)
        if box == lowest:
            _run_positions(coef, run[3] - u_ref, heights, h_ref, dx, dy)
        else:
            higher = np.empty((2, RUN), np.float32)
            _run_positions(coef, run[3] - u_ref, heights, h_ref, higher[0], higher[1])
            _take_higher(heights, np.float32(box_heights[box, 0]), higher[0], higher[1], dx, dy)
    if field.shape[2] == CELL:
        for i in range(dx.shape[0]):
            work[1][i] = dx[i]
        add_line_offsets(field_frame, field, origin, heights, dx, dy)
    elif field.size > 0:
        find_cells(field_frame, field, origin, dx, dy, work)
        _add_field(field, work, dx, dy)


@inner
def _next_span(line: NDArray[np.uint16], mine: int, first: int, end: int) -> tuple[int, int]:
    """First and end column of the next pixels of `line` that are `mine`; first = end where there are none."""
    while first < end and line[first] != mine:
        first += 1
    last = first
    while last < end and line[last] == mine:
        last += 1
    return first, last


@kernel
def _write_runs(
    rects: NDArray[np.int32],
    chosen: NDArray[np.int64],
    offset: tuple[int, int],
    size: tuple[int, int],
    owned: tuple[Any, ...],
    runs: NDArray[np.int32],
) -> int:
    """Fill `runs` as far as it has room; returns how many there are."""
    owner, mine, (left, top, right, bottom) = owned
    left, top = max(left, offset[0]), max(top, offset[1])
    right, bottom = min(right, offset[0] + size[1]), min(bottom, offset[1] + size[0])
    count = 0
    for index in chosen:
        last_column = min(rects[index, 2], right)
        for v in range(max(rects[index, 1], top), min(rects[index, 3], bottom)):
            for u_run in range(rects[index, 0], last_column, RUN):
                u, end = max(u_run, left), min(u_run + RUN, last_column)
                while u < end:
                    last = end
                    if owner.size > 0:
                        line = owner[v - offset[1]]
                        first, last = _next_span(line, mine, u - offset[0], end - offset[0])
                        u, last = first + offset[0], last + offset[0]
                        if u == last:
                            break
                    if count < runs.shape[0]:
                        runs[count, 0], runs[count, 1], runs[count, 2] = index, v, u_run
                        runs[count, 3], runs[count, 4] = u, last
                    count += 1
                    u = last
    return count


Owned = tuple[NDArray[np.uint16], int, Sequence[int]]
"""Which pixels a source paints: a raster of owners and its number in it, and the part of the tile where this number is
found: first column, first row, end column, end row."""

ALL_MINE: Owned = (np.empty((0, 0), np.uint16), 0, (0, 0, 2**31, 2**31))
"""Every pixel belongs to the one source."""


def tile_runs(
    rects: NDArray[np.int32],
    chosen: NDArray[np.int64],
    offset: tuple[int, int],
    size: tuple[int, int],
    owned: Owned = ALL_MINE,
) -> NDArray[np.int32]:
    """Runs of the rectangles `chosen` inside `size` (rows, columns) pixels from `offset` (column, row) on.

    The raster of `owned` has that size. A run that is cut at the border of
    such pixels keeps the column from which its coefficients hold, and with it every bit of its positions.

    Returns (k, 5) int32: rectangle, row, column from which the run's coefficients hold, first and end column; in the
    tile's pixels.
    """
    columns = np.maximum(rects[chosen, 2] - rects[chosen, 0], 0) // RUN + 1
    room = int((np.maximum(rects[chosen, 3] - rects[chosen, 1], 0) * columns).sum())
    runs = np.empty((room, 5), np.int32)
    count = _write_runs(rects, chosen, offset, size, owned, runs)
    if count > room:
        runs = np.empty((count, 5), np.int32)
        _write_runs(rects, chosen, offset, size, owned, runs)
    return runs[:count]


@kernel
def _positions(
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    relief: NDArray[np.float32],
    offset: tuple[int, int],
    result: NDArray[Any],
) -> None:
    frame = (np.empty(2), np.empty((4, 3)), cell_space())
    origin = frame[0]
    moved = np.empty((2, RUN), np.float32)
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        dx, dy = moved[0, :n], moved[1, :n]
        locate_run(anchors, runs[k], relief[row, col : col + n], frame, dx, dy)
        for i in range(n):
            result[row, col + i, 0] = origin[0] + dx[i]
            result[row, col + i, 1] = origin[1] + dy[i]


def positions(
    anchors: tuple[NDArray[Any], ...], relief: NDArray[np.float32], offset: tuple[int, int] = (0, 0)
) -> NDArray[np.float32]:
    """Source positions of the pixels of a tile, as the engine uses them.

    Parameters
    ----------
    anchors : tuple of arrays
        See `rectify_tile`.
    relief : ndarray, shape (rows, cols), float32
        Height of every pixel; NaN where there is no surface.
    offset : (column, row)
        First pixel of `relief` in the tile's pixels.

    Returns
    -------
    ndarray, shape (rows, cols, 2), float32
        (x, y) in pixels of the source window; NaN where there is no surface, no rectangle, or none of the image.
    """
    result = np.full((*relief.shape, 2), np.nan, np.float32)
    runs = tile_runs(anchors[0], np.arange(len(anchors[0])), offset, relief.shape)
    field = line_offset_cells(anchors[5]) if anchors[5].shape[2] == 5 else anchors[5]
    _positions((*anchors[:5], field), runs, np.ascontiguousarray(relief, np.float32), offset, result)
    return result


# Taps: where those of each pixel begin, their fractions, and what kind of pixel it is.
#
# Nothing here depends on the type of the pixels, so it is compiled once for all of them.


EMPTY, INTERIOR, BORDER, AVERAGE = 0, 1, 2, 3
"""Kinds of pixels: outside or without relief; all taps inside and valid; some not; averaged over a wider kernel."""

NOTHING, ALL, SOME = 0, 1, 2
"""Whether a run has no pixel, only pixels, or some pixels of kind INTERIOR."""


def tap_block(count: int) -> tuple[Any, ...]:
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
def _split_positions(
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
def _clip_int32(value: float) -> np.int32:
    """As int32, cut where no position within a run can reach."""
    return np.int32(min(max(value, -(1 << 30)), 1 << 30))


@inner
def _apply_mask(
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
def find_taps(
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
        See `tap_block`; filled.
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
        reach = (_clip_int32(-x0), _clip_int32(-y0), _clip_int32(width - taps - x0), _clip_int32(height - taps - y0))
        located = (first[k, 0], first[k, 1], part[k, 0], part[k, 1])
        some, whole = _split_positions(dx, dy, edges, reach, shift, located, kinds)
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
            lost = _apply_mask(solid, corner[k], first[k, 0], first[k, 1], line[:n])
            some, whole = some + lost, whole - lost
        fill[k] = SOME if whole > 0 else NOTHING
        doubtful += some
        for i in range(n):
            valid_line[i] = line[i] == INTERIOR
    return doubtful

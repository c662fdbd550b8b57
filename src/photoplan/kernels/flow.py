"""Where water flows over a grid of heights: filled pits, the way down from every cell, and sums along it.

Cells are numbered row · columns + column. The flood rises from the edge of the terrain inwards (priority flood: Barnes,
Lehman, Mulla 2014, *Computers & Geosciences* 62), so that every cell is reached from a cell that is not higher. The
order in which cells are reached never falls; whatever flows downhill flows to a cell that was reached before, and one
pass along the order, or against it, sums along all ways.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

#: Neighbours from east, counter-clockwise; direction d of a cell is its position here.
COLUMN = np.array([1, 1, 0, -1, -1, -1, 0, 1], np.int64)
ROW = np.array([0, -1, -1, -1, 0, 1, 1, 1], np.int64)
_DIAGONAL = np.sqrt(2.0)


@inner
def _push(keys: NDArray[np.float32], cells: NDArray[np.int32], size: int, key: float, cell: int) -> None:
    """Add to a heap of `size` elements; the lowest key is at 0."""
    i = size
    while i > 0:
        parent = (i - 1) >> 1
        if keys[parent] <= key:
            break
        keys[i], cells[i] = keys[parent], cells[parent]
        i = parent
    keys[i], cells[i] = key, cell


@inner
def _pop(keys: NDArray[np.float32], cells: NDArray[np.int32], size: int) -> None:
    """Take the lowest away; `size` is what is left."""
    key, cell = keys[size], cells[size]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], cells[i] = keys[child], cells[child]
        i = child
    keys[i], cells[i] = key, cell


@inner
def _edge(heights: NDArray[np.float32], row: int, col: int) -> bool:
    """Whether water can leave the terrain from a cell."""
    rows, columns = heights.shape
    if row == 0 or col == 0 or row == rows - 1 or col == columns - 1:
        return True
    found = False
    for d in range(8):
        found |= np.isnan(heights[row + ROW[d], col + COLUMN[d]])
    return found


@kernel
def flood(
    heights: NDArray[np.float32], filled: NDArray[np.float32], order: NDArray[np.int32], origin: NDArray[np.int32]
) -> int:
    """Fill all pits up to where they spill.

    Parameters
    ----------
    heights : ndarray, shape (rows, cols), float32
        NaN = no terrain: water leaves there, and over the edge of the grid.
    filled : ndarray, shape (rows, cols), float32
        Result: heights, at least those of the way out.
    order : ndarray, shape (rows · cols,), int32
        Result: cells in the order in which the flood reaches them; their filled heights never fall.
    origin : ndarray, shape (rows · cols,), int32
        Result: the cell from which the flood came, −1 on the edge.

    Returns
    -------
    int
        Number of cells with terrain: that many elements of `order` are set.
    """
    rows, columns = heights.shape
    count = rows * columns
    keys, cells = np.empty(count, np.float32), np.empty(count, np.int32)
    level = np.empty(count, np.int32)
    reached = np.zeros((rows, columns), np.uint8)
    heap = first = last = done = 0
    for row in range(rows):
        for col in range(columns):
            filled[row, col] = heights[row, col]
            if not np.isnan(heights[row, col]) and _edge(heights, row, col):
                _push(keys, cells, heap, heights[row, col], row * columns + col)
                heap += 1
                reached[row, col] = 1
                origin[row * columns + col] = -1
    while heap > 0 or first < last:
        # Cells as high as the water's level wait in a queue, so that plains are crossed on the shortest ways to any
        # of their rims.
        if first == last:
            here = keys[0]
            while heap > 0 and keys[0] == here:
                level[last] = cells[0]
                last += 1
                heap -= 1
                _pop(keys, cells, heap)
        cell = level[first]
        first += 1
        order[done] = cell
        done += 1
        row, col = cell // columns, cell % columns
        here = filled[row, col]
        for d in range(8):
            j, i = row + ROW[d], col + COLUMN[d]
            if j < 0 or i < 0 or j >= rows or i >= columns or reached[j, i] or np.isnan(heights[j, i]):
                continue
            reached[j, i] = 1
            origin[j * columns + i] = cell
            if heights[j, i] <= here:
                filled[j, i] = here
                level[last] = j * columns + i
                last += 1
            else:
                _push(keys, cells, heap, heights[j, i], j * columns + i)
                heap += 1
    return done


@kernel
def steepest(filled: NDArray[np.float32], origin: NDArray[np.int32], receiver: NDArray[np.int32]) -> None:
    """Cell into which each cell flows (D8: O'Callaghan, Mark 1984): the neighbour with the steepest way down.

    On plains and filled pits it is where the flood came from; `receiver` is −1 where water leaves the terrain, and −2
    where there is none.
    """
    rows, columns = filled.shape
    for row in range(rows):
        for col in range(columns):
            cell = row * columns + col
            here = filled[row, col]
            if np.isnan(here):
                receiver[cell] = -2
                continue
            best, to = 0.0, np.int64(origin[cell])
            for d in range(8):
                j, i = row + ROW[d], col + COLUMN[d]
                if j < 0 or i < 0 or j >= rows or i >= columns:
                    continue
                fall = np.float64(here) - np.float64(filled[j, i])
                if d & 1:
                    fall /= _DIAGONAL
                if fall > best:
                    best, to = fall, j * columns + i
            receiver[cell] = to


@kernel
def directions(receiver: NDArray[np.int32], out: NDArray[np.int8]) -> None:
    """Direction of every cell's flow by its receiver: position in `COLUMN` and `ROW`, or the receiver's −1 or −2."""
    rows, columns = out.shape
    for row in range(rows):
        for col in range(columns):
            to = np.int64(receiver[row * columns + col])
            out[row, col] = -2 if to == -2 else -1
            if to >= 0:
                for d in range(8):
                    if row + ROW[d] == to // columns and col + COLUMN[d] == to % columns:
                        out[row, col] = d


@kernel
def accumulate(order: NDArray[np.int32], receiver: NDArray[np.int32], sums: NDArray[np.float64]) -> None:
    """Add to every cell what flows into it; `sums` holds each cell's own amount before."""
    for k in range(order.shape[0] - 1, -1, -1):
        cell = order[k]
        to = receiver[cell]
        if to >= 0:
            sums[to] += sums[cell]


@inner
def _facet(here: float, side: float, corner: float) -> tuple[float, float]:
    """Slope of a triangle of three cells, and the part of the flow that goes to the corner."""
    if np.isnan(side) or np.isnan(corner):
        return -1.0, 0.0
    s1, s2 = here - side, side - corner
    if s2 <= 0.0:
        return s1, 0.0
    if s2 >= s1:
        return (here - corner) / _DIAGONAL, 1.0
    return np.sqrt(s1 * s1 + s2 * s2), np.arctan2(s2, s1) / (np.pi / 4.0)


@kernel
def accumulate_split(
    filled: NDArray[np.float32], order: NDArray[np.int32], receiver: NDArray[np.int32], sums: NDArray[np.float64]
) -> None:
    """As `accumulate`, but flow is split between the two neighbours beside the steepest direction.

    The direction is that of the steepest of eight triangles (D∞: Tarboton 1997, *Water Resources Research* 33), the
    split by its angle to the two neighbours. Where no triangle falls, flow goes to the receiver.
    """
    rows, columns = filled.shape
    for k in range(order.shape[0] - 1, -1, -1):
        cell = order[k]
        row, col = cell // columns, cell % columns
        here = np.float64(filled[row, col])
        best, part, to_side, to_corner = 0.0, 0.0, -1, -1
        for f in range(8):
            # Triangles lie on both sides of the four neighbours that share an edge with the cell.
            d = f & 6
            e = (d + 1) & 7 if f & 1 else (d + 7) & 7
            j, i, q, p = row + ROW[d], col + COLUMN[d], row + ROW[e], col + COLUMN[e]
            if min(j, q) < 0 or min(i, p) < 0 or max(j, q) >= rows or max(i, p) >= columns:
                continue
            slope, share = _facet(here, np.float64(filled[j, i]), np.float64(filled[q, p]))
            if slope > best:
                best, part, to_side, to_corner = slope, share, j * columns + i, q * columns + p
        if best > 0.0:
            if part < 1.0:
                sums[to_side] += (1.0 - part) * sums[cell]
            if part > 0.0:
                sums[to_corner] += part * sums[cell]
        elif receiver[cell] >= 0:
            sums[receiver[cell]] += sums[cell]


@inner
def _step(cell: int, to: int, columns: int) -> float:
    """Distance between the middles of two neighbours, in cells."""
    return _DIAGONAL if cell // columns != to // columns and cell % columns != to % columns else 1.0


@kernel
def downstream(
    order: NDArray[np.int32], receiver: NDArray[np.int32], columns: int, stops: NDArray[np.bool_], length: NDArray[Any]
) -> None:
    """Length of the way down to where water leaves, or to the next of the cells in `stops`, in cells."""
    for k in range(order.shape[0]):
        cell = order[k]
        to = receiver[cell]
        length[cell] = 0.0 if to < 0 or stops[cell] else length[to] + _step(cell, to, columns)


@kernel
def upstream_length(order: NDArray[np.int32], receiver: NDArray[np.int32], columns: int, length: NDArray[Any]) -> None:
    """Length of the longest way that leads to each cell, in cells; `length` is zero before."""
    for k in range(order.shape[0] - 1, -1, -1):
        cell = order[k]
        to = receiver[cell]
        if to >= 0:
            length[to] = max(length[to], length[cell] + _step(cell, to, columns))


@kernel
def label(order: NDArray[np.int32], receiver: NDArray[np.int32], labels: NDArray[np.int32]) -> None:
    """Give every cell the label of the next labelled cell on its way down; labels of others are 0 before."""
    for k in range(order.shape[0]):
        cell = order[k]
        to = receiver[cell]
        if labels[cell] == 0 and to >= 0:
            labels[cell] = labels[to]

"""Boxes of anchors: what their interpolation misses, what of them is in the image, and where sources paint."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel


@inner
def _in_image(xy: NDArray[np.float64], bounds: tuple[float, float, float, float], around: float) -> bool:
    """Whether eight positions, widened, span a part of the image; not if one of them is NaN."""
    left, top, right, bottom = xy[0, 0], xy[0, 1], xy[0, 0], xy[0, 1]
    known = True
    for i in range(8):
        x, y = xy[i, 0], xy[i, 1]
        known = known and x == x and y == y
        left, top, right, bottom = min(left, x), min(top, y), max(right, x), max(bottom, y)
    return (
        known
        and right >= bounds[0] - around
        and bottom >= bounds[1] - around
        and left <= bounds[2] + around
        and top <= bounds[3] + around
    )


@inner
def _probe(lattice: NDArray[np.float64], h: int, v: int, u: int) -> float:
    """Distance of a place of a box's lattice to what its corners give there; infinite if that is undefined."""
    x, y, w = 0.0, 0.0, 0.0
    for i in range(2):
        for j in range(2):
            for k in range(2):
                corner = 9 * _end(h, i) + 3 * _end(v, j) + _end(u, k)
                x += lattice[corner, 0]
                y += lattice[corner, 1]
                w += lattice[corner, 2]
    strict = 9 * h + 3 * v + u
    dx = x / w - lattice[strict, 0] / lattice[strict, 2]
    dy = y / w - lattice[strict, 1] / lattice[strict, 2]
    miss = np.sqrt(dx * dx + dy * dy)
    return miss if miss == miss else np.inf


@inner
def _end(place: int, which: int) -> int:
    """Lower and upper corner (0, 1) that a place 0, 1, 2 along an edge is between."""
    return 2 * which if place == 1 else place


@kernel
def judge_boxes(
    lattice: NDArray[np.float64],
    rect: NDArray[np.int64],
    bounds: tuple[float, float, float, float],
    radius: float,
    errors: NDArray[np.float64],
    keep: NDArray[np.bool_],
    behind: NDArray[np.bool_],
) -> None:
    """What boxes miss between their corners, and whether they can show a part of the image.

    Parameters
    ----------
    lattice : ndarray, shape (n, 27, 3)
        Strict homogeneous positions of 3 × 3 × 3 places of each box: 9·ih + 3·iv + iu.
    rect : ndarray, shape (n,)
        The rectangle that a box belongs to.
    bounds : (x_min, y_min, x_max, y_max)
        Of the image, pixels.
    radius : float
        Pixels around the image that count as well.
    errors : ndarray, shape (m, 4)
        Residuals of each rectangle along h, v, u, and worst of all, pixels: raised to what is found at the middles.
    keep, behind : ndarrays of bool, shape (m,), False
        Filled: whether anything of it is in the image, or may be, since a part is behind the camera; and the latter.
    """
    for n in range(len(lattice)):
        box, worst = lattice[n], errors[rect[n]]
        front = 0
        for i in range(27):
            x, y, w = box[i, 0], box[i, 1], box[i, 2]
            front += int(w > 0.0 and np.isfinite(x) and np.isfinite(y) and np.isfinite(w))
        keep[rect[n]] |= front > 0
        behind[rect[n]] |= front < 27
        for h in range(3):
            for v in range(3):
                for u in range(3):
                    halves = int(h == 1) + int(v == 1) + int(u == 1)
                    if halves == 0:
                        continue
                    miss = _probe(box, h, v, u)
                    worst[3] = max(worst[3], miss)
                    if halves == 1:
                        axis = 0 if h == 1 else (1 if v == 1 else 2)
                        worst[axis] = max(worst[axis], miss)
    inside, xy = np.zeros(len(errors), np.bool_), np.empty((8, 2))
    for n in range(len(lattice)):
        for i in range(8):
            corner = lattice[n, 18 * (i >> 2) + 6 * ((i >> 1) & 1) + 2 * (i & 1)]
            xy[i, 0], xy[i, 1] = corner[0] / corner[2], corner[1] / corner[2]
        # With w > 0 the corners bound the interpolation; the strict positions lie beside it by the residual.
        inside[rect[n]] |= _in_image(xy, bounds, radius + 2 * errors[rect[n], 3])
    for m in range(len(errors)):
        behind[m] &= keep[m]
        keep[m] &= inside[m] or behind[m]


@kernel
def blocks_in_image(
    boxes: tuple[Any, ...],
    ranges: NDArray[np.float64],
    side: int,
    bounds: tuple[float, float, float, float],
    around: float,
    xy: NDArray[np.float64],
    found: NDArray[np.float64],
) -> int:
    """Cut boxes into blocks that have heights of their own, and find those that lie in the image.

    Parameters
    ----------
    boxes : tuple
        Rectangles (n, 4), heights (n, 2) and homogeneous corners (n, 8, 3).
    ranges : ndarray, shape (2, rows, cols)
        Lowest and highest h of squares of `side` pixels of the tile; inf, −inf: none.
    side : int
        Of the blocks, pixels.
    bounds, around
        Of the image, and what of its surroundings counts, pixels.
    xy : ndarray, shape (k, 8, 2)
        Filled: positions of the corners of the blocks that were found.
    found : ndarray, shape (3, 2), inf, −inf
        Lowest and highest x, y of these corners, and length of (∂x/∂u, ∂x/∂v) or (∂y/∂u, ∂y/∂v): widened to them.

    Returns
    -------
    int
        Number of blocks found.
    """
    rects, heights, corners = boxes
    own = np.empty((8, 3))
    count = 0
    for n in range(len(rects)):
        left, top, right, bottom = rects[n]
        for row in range(top, bottom, side):
            for col in range(left, right, side):
                end_row, end_col = min(row + side, bottom), min(col + side, right)
                low, high = np.inf, -np.inf
                for i in range(row // side, (end_row - 1) // side + 1):
                    for j in range(col // side, (end_col - 1) // side + 1):
                        low, high = min(low, ranges[0, i, j]), max(high, ranges[1, i, j])
                low, high = max(low, heights[n, 0]), min(high, heights[n, 1])
                if not low <= high:
                    continue
                rise = heights[n, 1] - heights[n, 0]
                _cut(corners[n], ((low - heights[n, 0]) / rise, (high - heights[n, 0]) / rise), 4, own)
                _cut(own, ((row - top) / (bottom - top), (end_row - top) / (bottom - top)), 2, own)
                _cut(own, ((col - left) / (right - left), (end_col - left) / (right - left)), 1, own)
                for i in range(8):
                    xy[count, i, 0], xy[count, i, 1] = own[i, 0] / own[i, 2], own[i, 1] / own[i, 2]
                if _in_image(xy[count], bounds, around):
                    _widen(own, xy[count], end_col - col, end_row - row, found)
                    count += 1
    return count


@inner
def _cut(corners: NDArray[np.float64], at: tuple[float, float], bit: int, out: NDArray[np.float64]) -> None:
    """Corners of a part of a box, between two places along h (bit 4), v (2) or u (1); `out` may be `corners`."""
    for i in range(8):
        if i & bit == 0:
            for c in range(3):
                a, step = corners[i, c], corners[i | bit, c] - corners[i, c]
                out[i, c], out[i | bit, c] = a + at[0] * step, a + at[1] * step


@inner
def _widen(
    corners: NDArray[np.float64], xy: NDArray[np.float64], width: int, height: int, found: NDArray[np.float64]
) -> None:
    """Widen ranges of positions and scales by those at the corners of a box."""
    for i in range(8):
        w = corners[i, 2]
        for c in range(2):
            # Signs do not matter: the derivatives are squared.
            along_u = ((corners[i ^ 1, c] - corners[i, c]) - xy[i, c] * (corners[i ^ 1, 2] - w)) / (width * w)
            along_v = ((corners[i ^ 2, c] - corners[i, c]) - xy[i, c] * (corners[i ^ 2, 2] - w)) / (height * w)
            scale = np.sqrt(along_u * along_u + along_v * along_v)
            found[2, 0], found[2, 1] = min(found[2, 0], scale), max(found[2, 1], scale)
            found[c, 0], found[c, 1] = min(found[c, 0], xy[i, c]), max(found[c, 1], xy[i, c])


@kernel
def find_owned(
    owner: NDArray[np.uint16], place: NDArray[np.int64], side: int, squares: NDArray[np.bool_], parts: NDArray[np.int64]
) -> None:
    """Where the pixels are that each source paints.

    Parameters
    ----------
    owner : ndarray, shape (height, width), uint16
    place : ndarray, shape (k,)
        Place in `squares` and `parts` of each owner; −1: it is not asked for.
    side : int
        Of the squares, pixels.
    squares : ndarray of bool, shape (n, rows, cols), False
        Filled: whether a square of the tile holds pixels of a source.
    parts : ndarray, shape (n, 4), width, height, 0, 0
        First column, first row, end column, end row of each source's pixels: narrowed to them.
    """
    for row in range(owner.shape[0]):
        for first in range(0, owner.shape[1], side):
            start, end = first, min(first + side, owner.shape[1])
            while start < end:
                number, stop, others = owner[row, start], end, 0
                for i in range(start, end):
                    others += int(owner[row, i] != number)
                if others > 0:
                    stop = start + 1
                    while owner[row, stop] == number:
                        stop += 1
                which = place[number]
                if which >= 0:
                    squares[which, row // side, first // side] = True
                    part = parts[which]
                    part[0], part[1] = min(part[0], start), min(part[1], row)
                    part[2], part[3] = max(part[2], stop), row + 1
                start = stop

"""Smoothing and thinning of contours inside bands that belong to them alone.

Every vertex of a contour lies on an edge of a triangle and may move along it between two ends of a range. Ranges of
different levels on one edge do not meet, and they keep away from the edge's ends. The pieces of a level inside a
triangle are chords between points on its boundary whose order therefore never changes, and chords between points of
one order on the boundary of a convex figure cannot cross, whatever the positions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# A step towards the mean of the neighbours, and a part of it back, so that small rings shrink less.
_INWARD, _OUTWARD = 0.5, -0.2
# Below this sine the edge runs so nearly along the line that their intersection says nothing.
_OBLIQUE = 0.2


@inner
def _cross(ax: float, ay: float, bx: float, by: float) -> float:
    return ax * by - ay * bx


@kernel
def smooth_line(places: NDArray[np.float64], closed: bool, passes: int) -> None:
    """Pull the vertices of a line towards the mean of their neighbours and back, inside their ranges.

    Parameters
    ----------
    places
        X, Y of each vertex and of both ends of its range, shape (n, 6); X, Y are changed. A range of no length fixes
        the vertex, and so are the ends of an open line.
    closed
        The first vertex follows the last one (it is not repeated).
    passes
        How often; even.
    """
    n = places.shape[0]
    moved = np.empty((n, 2))
    for turn in range(passes):
        step = _INWARD if turn % 2 == 0 else _OUTWARD
        for i in range(n):
            px, py = places[i, 0], places[i, 1]
            moved[i, 0], moved[i, 1] = px, py
            ex, ey = places[i, 4] - places[i, 2], places[i, 5] - places[i, 3]
            size = ex * ex + ey * ey
            if size == 0.0 or (not closed and (i == 0 or i == n - 1)):
                continue
            before, after = (i - 1) % n, (i + 1) % n
            mx = (1.0 - step) * px + 0.5 * step * (places[before, 0] + places[after, 0]) - places[i, 2]
            my = (1.0 - step) * py + 0.5 * step * (places[before, 1] + places[after, 1]) - places[i, 3]
            dx, dy = places[after, 0] - places[before, 0], places[after, 1] - places[before, 1]
            sine = _cross(ex, ey, dx, dy)
            if abs(sine) > _OBLIQUE * np.sqrt(size * (dx * dx + dy * dy)):
                s = _cross(mx, my, dx, dy) / sine
            else:
                s = (mx * ex + my * ey) / size
            s = min(max(s, 0.0), 1.0)
            moved[i, 0], moved[i, 1] = places[i, 2] + s * ex, places[i, 3] + s * ey
        places[:, :2] = moved


@inner
def _between(rx: float, ry: float, lx: float, ly: float, dx: float, dy: float) -> Any:
    """Whether a direction lies between a right and a left one, which are less than half a turn apart."""
    return _cross(rx, ry, dx, dy) >= 0.0 and _cross(dx, dy, lx, ly) >= 0.0


@inner
def _reach(places: NDArray[np.float64], start: int, closed: bool) -> int:
    """The furthest vertex that a straight line from `start` reaches through the ranges of all between."""
    n = places.shape[0]
    last = n if closed else n - 1
    px, py = places[start, 0], places[start, 1]
    best = start + 1
    rx, ry, lx, ly = 0.0, 0.0, 0.0, 0.0
    for i in range(start + 1, last + 1):
        k = i % n
        first = i == start + 1
        if not first and _between(rx, ry, lx, ly, places[k, 0] - px, places[k, 1] - py):
            best = i
        ax, ay, bx, by = places[k, 2] - px, places[k, 3] - py, places[k, 4] - px, places[k, 5] - py
        if _cross(ax, ay, bx, by) < 0.0:
            ax, ay, bx, by = bx, by, ax, ay
        # A range of no length, or seen from its end, fixes the direction: the line stops there.
        if _cross(ax, ay, bx, by) <= 0.0:
            break
        if first:
            rx, ry, lx, ly = ax, ay, bx, by
            continue
        right, left = _between(rx, ry, lx, ly, ax, ay), _between(rx, ry, lx, ly, bx, by)
        if not ((right or _between(ax, ay, bx, by, rx, ry)) and (left or _between(ax, ay, bx, by, lx, ly))):
            break
        if right:
            rx, ry = ax, ay
        if left:
            lx, ly = bx, by
        if _cross(rx, ry, lx, ly) <= 0.0:
            break
    return best


@kernel
def thin_line(places: NDArray[np.float64], closed: bool, keep: NDArray[np.bool_]) -> int:
    """Mark the vertices that a line needs so that it still passes every edge inside its range.

    Parameters
    ----------
    places
        As in `smooth_line`.
    closed
        The first vertex follows the last one (it is not repeated).
    keep
        Filled, shape (n,): True = needed.

    Returns
    -------
    int
        Number of vertices kept.
    """
    n = places.shape[0]
    keep[:] = False
    count, at = 0, 0
    last: Any = n if closed else n - 1
    while at < last:
        keep[at] = True
        count += 1
        at = _reach(places, at, closed)
    if not closed:
        keep[n - 1] = True
        count += 1
    return count

"""Contour lines of triangles: the edges that they cross, the crossing points, and their order.

Vertices carry an integer *rank*: the number of the highest level that they reach. Level k crosses an edge when it lies
above one end's rank and not above the other's; a vertex exactly at a level therefore counts as above it, in every
triangle alike, so that no line breaks, forks or is drawn twice. Each triangle holds at most one piece of each level.

Smoothing and thinning move vertices inside bands that belong to one contour alone. Every vertex lies on an edge of a
triangle and may move along it between two ends of a range. Ranges of different levels on one edge do not meet, and they
keep away from the edge's ends. The pieces of a level inside a triangle are chords between points on its boundary whose
order therefore never changes, and chords between points of one order on the boundary of a convex figure cannot cross.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

#: A crossing keeps away from the edge's ends by this difference of height, metres, at most by a quarter of all …
APART = 5e-7
#: … and where it may move, by this part of the edge.
MARGIN = 0.02


@inner
def _corners(mesh: int, columns: int) -> tuple[Any, Any, Any, Any]:
    """Posts NW, SW, SE, NE of a mesh: counter-clockwise on the map."""
    north = mesh + mesh // columns
    south = north + columns + 1
    return north, south, south + 1, north + 1


@kernel
def count_segments(
    ranks: NDArray[np.int64], columns: int, whole: NDArray[np.bool_], triangles: NDArray[np.int64]
) -> int:
    """Number of pieces that `fill_segments` will make of the same arguments."""
    count = 0
    posts = ranks.shape[0] - whole.shape[0]
    for mesh in range(whole.shape[0]):
        if not whole[mesh]:
            continue
        nw, sw, se, ne = _corners(mesh, columns)
        low = min(min(ranks[nw], ranks[sw]), min(ranks[se], ranks[ne]))
        high = max(max(ranks[nw], ranks[sw]), max(ranks[se], ranks[ne]))
        if low == high:
            continue
        centre = ranks[posts + mesh]
        for a, b in ((nw, sw), (sw, se), (se, ne), (ne, nw)):
            count += max(max(ranks[a], ranks[b]), centre) - min(min(ranks[a], ranks[b]), centre)
    for i in range(triangles.shape[0]):
        a, b, c = ranks[triangles[i, 0]], ranks[triangles[i, 1]], ranks[triangles[i, 2]]
        count += max(max(a, b), c) - min(min(a, b), c)
    return count


@inner
def _cut_triangle(ranks: NDArray[np.int64], a: int, b: int, c: int, at: int, pieces: NDArray[np.int64]) -> int:
    """Pieces of one counter-clockwise triangle, higher ground on their right; returns the next free row."""
    ra, rb, rc = ranks[a], ranks[b], ranks[c]
    for k in range(min(min(ra, rb), rc) + 1, max(max(ra, rb), rc) + 1):
        # Turned so that the first vertex is alone on its side of the level.
        u, v, w, alone = a, b, c, ra >= k
        if (rb >= k) != (ra >= k) and (rb >= k) != (rc >= k):
            u, v, w, alone = b, c, a, rb >= k
        elif (rc >= k) != (ra >= k) and (rc >= k) != (rb >= k):
            u, v, w, alone = c, a, b, rc >= k
        first, last = (w, v) if alone else (v, w)
        pieces[at, 0], pieces[at, 1] = min(u, first), max(u, first)
        pieces[at, 2], pieces[at, 3] = min(u, last), max(u, last)
        pieces[at, 4] = k
        at += 1
    return at


@kernel
def fill_segments(
    ranks: NDArray[np.int64],
    columns: int,
    whole: NDArray[np.bool_],
    triangles: NDArray[np.int64],
    pieces: NDArray[np.int64],
) -> int:
    """Pieces of lines in all triangles.

    Parameters
    ----------
    ranks
        Of all vertices: posts row by row, then further vertices of triangles, and last the centre of every mesh.
    columns
        Meshes in a row.
    whole
        Meshes that are cut into four triangles round their centre; the others are empty or have `triangles`.
    triangles
        Vertex numbers, counter-clockwise, shape (n, 3).
    pieces
        Filled: lower and higher vertex of the edge where a piece begins, of the one where it ends, and the level.

    Returns
    -------
    int
        Rows filled.
    """
    at = 0
    posts = ranks.shape[0] - whole.shape[0]
    for mesh in range(whole.shape[0]):
        if not whole[mesh]:
            continue
        nw, sw, se, ne = _corners(mesh, columns)
        low = min(min(ranks[nw], ranks[sw]), min(ranks[se], ranks[ne]))
        high = max(max(ranks[nw], ranks[sw]), max(ranks[se], ranks[ne]))
        if low == high:
            continue
        centre = posts + mesh
        for a, b in ((nw, sw), (sw, se), (se, ne), (ne, nw)):
            at = _cut_triangle(ranks, a, b, centre, at, pieces)
    for i in range(triangles.shape[0]):
        at = _cut_triangle(ranks, triangles[i, 0], triangles[i, 1], triangles[i, 2], at, pieces)
    return at


@inner
def _edge_root(z0: float, z1: float, bend: float, level: float) -> float:
    """Where z0 + (z1 − z0) s − bend s (1 − s) reaches a level between its ends: the only such s from 0 to 1."""
    b, c = z1 - z0 - bend, z0 - level
    q = -0.5 * (b + (1.0 if b >= 0.0 else -1.0) * np.sqrt(max(b * b - 4.0 * bend * c, 0.0)))
    first = c / q if q != 0.0 else 0.5
    second = q / bend if bend != 0.0 else first
    return first if abs(first - 0.5) <= abs(second - 0.5) else second


@inner
def _tolerance_range(slope: float, bend: float, band: float, at: float) -> tuple[Any, Any]:
    """The stretch of an edge round `at` in which the height is within the band of that there.

    It is connected, so that stretches of two levels, which have no height in common, lie in the order of the levels.
    """
    low, high = -at, 1.0 - at
    for c in (band, -band):
        inside = slope * slope + 4.0 * bend * c
        if inside < 0.0:
            continue
        q = -0.5 * (slope + (1.0 if slope >= 0.0 else -1.0) * np.sqrt(inside))
        for d in (q / bend if bend != 0.0 else 0.0, -c / q if q != 0.0 else 0.0):
            if d > 0.0:
                high = min(high, d)
            elif d < 0.0:
                low = max(low, d)
    return at + low, at + high


@kernel
def cross_edges(
    xyz: NDArray[np.float64],
    bends: NDArray[np.float64],
    edges: NDArray[np.int64],
    levels: NDArray[np.float64],
    band: float,
    fixed: NDArray[np.bool_],
    places: NDArray[np.float64],
) -> None:
    """Where levels cross edges, and how far the crossings may move.

    Parameters
    ----------
    xyz
        Vertices, shape (n, 3).
    bends
        Of each edge: how far its middle lies below the straight line, times four; 0 but from posts to centres.
    edges
        Vertex numbers, shape (m, 2).
    levels
        Height of the level, shape (m,).
    band
        Heights may change by this when a crossing moves, metres; less than half of the interval.
    fixed
        Crossings that must not move, shape (m,).
    places
        Filled, shape (m, 6): X, Y of the crossing; of the one end of its range; of the other end.
    """
    for i in range(edges.shape[0]):
        a, b, level, bend = edges[i, 0], edges[i, 1], levels[i], bends[i]
        za, zb = xyz[a, 2], xyz[b, 2]
        apart = min(APART, 0.25 * abs(zb - za))
        inside = min(max(level, min(za, zb) + apart), max(za, zb) - apart)
        at = min(max(_edge_root(za, zb, bend, inside), 0.0), 1.0)
        low, high = at, at
        if band > 0.0 and not fixed[i]:
            low, high = _tolerance_range(zb - za - bend + 2.0 * bend * at, bend, band, at)
            low = min(max(low, min(MARGIN, 0.5 * at)), at)
            high = max(min(high, 1.0 - min(MARGIN, 0.5 * (1.0 - at))), at)
        for k in range(2):
            step = xyz[b, k] - xyz[a, k]
            places[i, k] = xyz[a, k] + at * step
            places[i, 2 + k] = xyz[a, k] + low * step
            places[i, 4 + k] = xyz[a, k] + high * step


@kernel
def link_segments(follower: NDArray[np.int64], order: NDArray[np.int64], ends: NDArray[np.int64]) -> int:
    """Pieces put one behind the other.

    Parameters
    ----------
    follower
        The piece that begins where a piece ends; -1: none. Changed where two pieces have one follower.
    order
        Filled with the pieces, chain by chain.
    ends
        Filled, shape (pieces, 2): where a chain stops in `order`, and 1 if it is closed.

    Returns
    -------
    int
        Number of chains: those with two ends first, then the closed ones.
    """
    n = follower.shape[0]
    leader = np.full(n, -1, np.int64)
    for i in range(n):
        j = follower[i]
        if j >= 0:
            if leader[j] < 0:
                leader[j] = i
            else:
                follower[i] = -1
    used = np.zeros(n, np.bool_)
    at, chains = 0, 0
    for closed in range(2):
        for i in range(n):
            if used[i] or (closed == 0 and leader[i] >= 0):
                continue
            j = i
            while j >= 0 and not used[j]:
                used[j] = True
                order[at] = j
                at += 1
                j = follower[j]
            ends[chains, 0], ends[chains, 1] = at, closed
            chains += 1
    return chains


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
        for i in range(n):
            places[i, 0], places[i, 1] = moved[i, 0], moved[i, 1]


@inner
def _is_between(rx: float, ry: float, lx: float, ly: float, dx: float, dy: float) -> Any:
    """Whether a direction lies between a right and a left one, which are less than half a turn apart."""
    return _cross(rx, ry, dx, dy) >= 0.0 and _cross(dx, dy, lx, ly) >= 0.0


@inner
def _furthest_vertex(places: NDArray[np.float64], start: int, closed: bool) -> int:
    """The furthest vertex that a straight line from `start` reaches through the ranges of all between."""
    n = places.shape[0]
    last = n if closed else n - 1
    px, py = places[start, 0], places[start, 1]
    best = start + 1
    rx, ry, lx, ly = 0.0, 0.0, 0.0, 0.0
    for i in range(start + 1, last + 1):
        k = i % n
        first = i == start + 1
        if not first and _is_between(rx, ry, lx, ly, places[k, 0] - px, places[k, 1] - py):
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
        right, left = _is_between(rx, ry, lx, ly, ax, ay), _is_between(rx, ry, lx, ly, bx, by)
        if not ((right or _is_between(ax, ay, bx, by, rx, ry)) and (left or _is_between(ax, ay, bx, by, lx, ly))):
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
        at = _furthest_vertex(places, at, closed)
    if not closed:
        keep[n - 1] = True
        count += 1
    return count

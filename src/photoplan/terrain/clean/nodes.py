"""Lines as a network of common vertices: after `noded`, lines meet in vertices only.

Three lengths keep the work finite. Vertices are at least half the tolerance apart; a vertex closer than a quarter of
it to a line becomes one of the line's; so a line that is led through a vertex is cut into two shorter pieces, and there
are only finitely many pairs of vertices. Where a crossing is moved to a vertex nearby this is not proved; should the
work not end, the vertices involved are joined with a tolerance that doubles until it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.surfaces.measured import MeasuredLine
from photoplan.terrain.clean.join import clusters

ROUNDS = 30
"""Rounds until vertices are joined; five to ten are usual."""
CHUNK = 20_000
"""Segments that are compared with all others at once: bounds memory where everything overlaps."""


@dataclass(frozen=True, eq=False)
class Network:
    """Lines whose places refer to common vertices."""

    xy: NDArray[np.float64]
    """Vertices, shape (v, 2), metres; some may be unused."""
    vertex: NDArray[np.int64]
    """Vertex of every place, shape (n,): the places of a line follow each other."""
    line: NDArray[np.int64]
    """Number of the line of every place, ascending, shape (n,)."""
    z: NDArray[np.float64]
    """Height of every place, for walls that on the left; NaN: none."""
    right: NDArray[np.float64]
    """Height on the right of every place of a wall; NaN elsewhere."""

    @property
    def segments(self) -> NDArray[np.int64]:
        """Places at which a segment starts: the next place is on the same line."""
        return np.flatnonzero(self.line[1:] == self.line[:-1])


@dataclass(frozen=True, eq=False)
class Insertions:
    """Vertices that segments are to be led through."""

    place: NDArray[np.int64]
    """Place at which the segment starts."""
    vertex: NDArray[np.int64]
    at: NDArray[np.float64]
    """Where along the segment, 0 to 1."""


def make_network(lines: Sequence[MeasuredLine], tolerance: float) -> Network:
    """Network of lines, with vertices closer than the tolerance joined."""
    count = [len(line.xyz) for line in lines]
    xyz = np.concatenate([line.xyz for line in lines]) if lines else np.empty((0, 3))
    right = [np.full(len(line.xyz), np.nan) if line.right is None else line.right for line in lines]
    used, vertex = np.unique(clusters(xyz[:, :2], tolerance), return_inverse=True)
    return Network(
        xy=xyz[used, :2],
        vertex=vertex.astype(np.int64),
        line=np.repeat(np.arange(len(lines)), count),
        z=xyz[:, 2].copy(),
        right=np.concatenate(right) if right else np.empty(0),
    )


def without_repeats(net: Network) -> tuple[Network, NDArray[np.int64], NDArray[np.float64]]:
    """The network without places that repeat the vertex before them on their line.

    The height of repeated places is their mean. Returned besides: places (of the new network) whose repeated heights
    differ, and by how much.
    """
    new = np.ones(len(net.line), bool)
    new[1:] = (np.diff(net.line) != 0) | (np.diff(net.vertex) != 0)
    if new.all():
        return net, np.empty(0, np.int64), np.empty(0)
    run = np.cumsum(new) - 1
    starts = np.flatnonzero(new)
    size = np.bincount(run)
    z, right = (np.bincount(run, np.nan_to_num(v)) / size for v in (net.z, net.right))
    z[np.bincount(run, np.isnan(net.z)) > 0] = np.nan
    right[np.bincount(run, np.isnan(net.right)) > 0] = np.nan
    spread = np.maximum.reduceat(net.z, starts) - np.minimum.reduceat(net.z, starts)
    at = np.flatnonzero((size > 1) & (spread > 0))
    single = size == 1
    z[single], right[single] = net.z[starts[single]], net.right[starts[single]]  # bits as they were
    return Network(xy=net.xy, vertex=net.vertex[new], line=net.line[new], z=z, right=right), at, spread[at]


def insert(net: Network, new: Insertions) -> tuple[Network, NDArray[np.bool_], NDArray[np.int64]]:
    """The network with segments led through more vertices; heights are interpolated along them.

    Returned besides, for every place: whether it starts a segment that is new, and the place it comes from.
    """
    order = np.lexsort((new.at, new.place))
    place, vertex, at = new.place[order], new.vertex[order], new.at[order]
    z, right = (v[place] + at * (v[place + 1] - v[place]) for v in (net.z, net.right))
    fresh = np.zeros(len(net.line), bool)
    fresh[place] = True
    where = place + 1
    grown = Network(
        xy=net.xy,
        vertex=np.insert(net.vertex, where, vertex),
        line=np.insert(net.line, where, net.line[place]),
        z=np.insert(net.z, where, z),
        right=np.insert(net.right, where, right),
    )
    return grown, np.insert(fresh, where, True), np.insert(np.arange(len(net.line)), where, place)


def noded(net: Network, tolerance: float) -> tuple[Network, list[tuple[float, float]]]:
    """The network with a common vertex wherever lines meet, cross or run along each other."""
    joined: list[tuple[float, float]] = []
    reach = tolerance
    while True:
        net, _, _ = without_repeats(net)
        net, rest = _rounds(net, tolerance)
        if rest is None:
            return net, joined
        reach *= 2
        ends = np.unique(np.concatenate([net.vertex[rest.place], net.vertex[rest.place + 1], rest.vertex]))
        stands = np.arange(len(net.xy))
        stands[ends] = ends[clusters(net.xy[ends], reach)]
        net = replace(net, vertex=stands[net.vertex])
        joined.append((float(net.xy[ends[0], 0]), float(net.xy[ends[0], 1])))


def _rounds(net: Network, tolerance: float) -> tuple[Network, Insertions | None]:
    """Rounds of leading segments through vertices and crossings; what is left to do if they do not end."""
    origin = np.floor(net.xy.mean(axis=0)) if len(net.xy) else np.zeros(2)
    close = cross = np.ones(len(net.line), bool)  # segments that are new to either test
    vertices = np.ones(len(net.xy), bool)
    new: Insertions | None = None
    for _ in range(ROUNDS):
        new = _close(net, origin, close, vertices, tolerance / 4)
        if new is None:
            new, points = _crossings(net, origin, cross, tolerance / 2)
            if new is None:
                return net, None
            vertices = np.concatenate([np.zeros(len(net.xy), bool), np.ones(len(points), bool)])
            net = replace(net, xy=np.concatenate([net.xy, points + origin]))
            net, close, _ = insert(net, new)
            cross = close
        else:
            vertices = np.zeros(len(net.xy), bool)
            net, close, source = insert(net, new)
            cross = close | cross[source]
    new = _close(net, origin, np.ones(len(net.line), bool), vertices, tolerance / 4)
    if new is None:
        new, points = _crossings(net, origin, np.ones(len(net.line), bool), tolerance / 2)
        net = replace(net, xy=np.concatenate([net.xy, points + origin]))
    return net, new


def _close(
    net: Network, origin: NDArray[np.float64], fresh: NDArray[np.bool_], vertices: NDArray[np.bool_], near: float
) -> Insertions | None:
    """Vertices that lie on segments: new vertices on all segments, all vertices on new segments."""
    local = net.xy - origin
    start = net.segments
    used = np.unique(net.vertex)
    pairs = [
        _within(local, net.vertex, used[vertices[used]], start, near),
        _within(local, net.vertex, used, start[fresh[start]], near),
    ]
    vertex, place = (np.concatenate([p[k] for p in pairs]) for k in (0, 1))
    inner = (net.vertex[place] != vertex) & (net.vertex[place + 1] != vertex)
    return _insertions(net, local, place[inner], vertex[inner])


def _within(
    local: NDArray[np.float64],
    vertex: NDArray[np.int64],
    points: NDArray[np.int64],
    start: NDArray[np.int64],
    near: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a point and a segment that are closer than `near`."""
    if not len(points) or not len(start):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    lines = shapely.linestrings(local[np.stack([vertex[start], vertex[start + 1]], axis=1)])
    dots = shapely.points(local[points])
    if len(points) <= len(start):
        p, s = shapely.STRtree(lines).query(dots, predicate="dwithin", distance=near)
    else:
        s, p = shapely.STRtree(dots).query(lines, predicate="dwithin", distance=near)
    return points[p], start[s]


def _insertions(
    net: Network, local: NDArray[np.float64], place: NDArray[np.int64], vertex: NDArray[np.int64]
) -> Insertions | None:
    """Each segment led through each of its vertices once, in the order along it; None: nothing to do."""
    if not len(place):
        return None
    pairs = np.unique(np.stack([place, vertex], axis=1), axis=0)
    place, vertex = pairs[:, 0], pairs[:, 1]
    a, b = local[net.vertex[place]], local[net.vertex[place + 1]]
    d = b - a
    at = ((local[vertex] - a) * d).sum(axis=1) / (d * d).sum(axis=1)
    return Insertions(place, vertex, np.clip(at, 0.0, 1.0))


def _crossings(
    net: Network, origin: NDArray[np.float64], fresh: NDArray[np.bool_], snap: float
) -> tuple[Insertions | None, NDArray[np.float64]]:
    """Crossings of new segments with all segments; those far from every vertex are new vertices (local X, Y)."""
    local = net.xy - origin
    start = net.segments
    nothing = np.empty((0, 2))
    if not fresh[start].any():
        return None, nothing
    ends = np.stack([net.vertex[start], net.vertex[start + 1]], axis=1)
    lines = shapely.linestrings(local[ends])
    tree = shapely.STRtree(lines)
    ask = np.flatnonzero(fresh[start])
    found = []
    for at in range(0, len(ask), CHUNK):
        i, j = tree.query(lines[ask[at : at + CHUNK]])
        i = ask[at : at + CHUNK][i]
        once = (i < j) | ~fresh[start[j]]
        i, j = i[once], j[once]
        apart = (ends[i][:, :, None] != ends[j][:, None, :]).all(axis=(1, 2))
        i, j = i[apart], j[apart]
        hit, points = _cut(local[ends[i]], local[ends[j]])
        found.append((i[hit], j[hit], points))
    i, j, points = (np.concatenate([f[k] for f in found]) for k in (0, 1, 2))
    if not len(i):
        return None, nothing
    used = np.unique(net.vertex)
    distance, nearest = cKDTree(local[used]).query(points, distance_upper_bound=snap)
    free = ~np.isfinite(distance)
    vertex = used[np.where(free, 0, nearest)]
    own, whose = np.unique(clusters(points[free], snap), return_inverse=True)
    vertex[free] = len(local) + whose
    points = points[free][own]
    place, vertex = np.concatenate([start[i], start[j]]), np.concatenate([vertex, vertex])
    inner = (net.vertex[place] != vertex) & (net.vertex[place + 1] != vertex)
    return _insertions(net, np.concatenate([local, points]), place[inner], vertex[inner]), points


def _cut(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which pairs of segments (m, 2, 2) cross, and where."""
    d, e, f = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0], b[:, 0] - a[:, 0]
    det = d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (f[:, 0] * e[:, 1] - f[:, 1] * e[:, 0]) / det
        u = (f[:, 0] * d[:, 1] - f[:, 1] * d[:, 0]) / det
        hit = (t > 0) & (t < 1) & (u > 0) & (u < 1)
    return hit, a[hit, 0] + t[hit, None] * d[hit]

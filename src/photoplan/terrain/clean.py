"""Cleaning of measured points and lines before a model is built: repeats, crossings, gaps, points on lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.errors import GeometryError, InputError
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, PointGroup

CHUNK = 1_000_000
"""Points that are compared with the area at once."""


@dataclass(frozen=True)
class Finding:
    """Something that was noticed in measured terrain, and what was done about it."""

    kind: str
    """Kind in one or two words, the same for findings of one sort."""
    text: str
    """A sentence for people: names, heights, place and remedy."""
    X: float = float("nan")
    """Place, metres; NaN if it has no single place."""
    Y: float = float("nan")
    names: tuple[str, ...] = ()
    """Points and lines concerned."""


def closed(lines: Sequence[MeasuredLine]) -> tuple[list[MeasuredLine], list[Finding]]:
    """The lines, with border lines and holes closed: their first vertex is their last.

    A gap is closed if it is not longer than the longest side of the line (the file left the repeated vertex out).
    """
    out, found = [], []
    for line in lines:
        if line.kind not in ("border", "hole"):
            out.append(line)
            continue
        steps = np.hypot(*np.diff(line.xyz[:, :2], axis=0).T)
        gap = float(np.hypot(*(line.xyz[0, :2] - line.xyz[-1, :2])))
        X, Y = line.xyz[-1, :2].tolist()
        if gap > 0 and (len(line.xyz) < 3 or gap > steps.max()):
            raise GeometryError(
                f"{line.name}: the {_word(line)} is not closed: {gap:.3f} m from its last vertex X {X:.3f}, Y {Y:.3f} "
                f"to its first, its longest side has {steps.max():.3f} m; close it, or give it another class"
            )
        if gap > 0:
            found.append(
                Finding(
                    kind="unclosed border",
                    text=f"{line.name}: a gap of {gap:.3f} m closed",
                    X=X,
                    Y=Y,
                    names=(line.name,),
                )
            )
            line = replace(line, xyz=np.concatenate([line.xyz, line.xyz[:1]]))
        out.append(line)
    return out, found


def _word(line: MeasuredLine) -> str:
    return "border line" if line.kind == "border" else "hole"


def unfit_rings(lines: Sequence[MeasuredLine]) -> tuple[list[MeasuredLine], list[Finding]]:
    """The lines without rings that enclose nothing; self-crossing rings are reported, and kept."""
    out, found = [], []
    for line in lines:
        if line.kind in ("border", "hole"):
            X, Y = line.xyz[0, :2].tolist()
            ring = _polygon(line)
            if ring is None or shapely.make_valid(ring).area == 0:
                text = f"{line.name}: the {_word(line)} encloses no area; left out"
                found.append(Finding(kind="empty border", text=text, X=X, Y=Y, names=(line.name,)))
                continue
            if not shapely.is_valid(ring):
                reason = shapely.is_valid_reason(ring)
                place = reason[reason.find("[") + 1 : -1].split() if "[" in reason else []
                X, Y = (float(place[0]), float(place[1])) if len(place) == 2 else (X, Y)
                text = (
                    f"{line.name}: the {_word(line)} crosses or touches itself at X {X:.3f}, Y {Y:.3f}; "
                    "taken is what it encloses an odd number of times"
                )
                found.append(Finding(kind="self-crossing border", text=text, X=X, Y=Y, names=(line.name,)))
        out.append(line)
    return out, found


def domain_of(measured: MeasuredTerrain) -> Any | None:
    """The area that border lines enclose, without holes: a valid shapely polygon or multipolygon.

    Rings are taken from the largest to the smallest, a border line adds its area, a hole takes it away; so a border
    line inside a hole is an island. Self-crossing rings count where they enclose a point an odd number of times.
    With holes alone, everything around the data and outside of the holes is the area.
    """
    rings = [(line.kind, _polygon(line)) for line in measured.lines if line.kind in ("border", "hole")]
    valid = [(kind, _areas(shapely.make_valid(ring))) for kind, ring in rings if ring is not None]
    if not valid:
        return None
    valid.sort(key=lambda item: -item[1].area)
    area = shapely.Polygon()
    if all(kind == "hole" for kind, _ in valid):
        west, south, east, north = _bounds(measured)
        reach = max(east - west, north - south, 1.0)
        area = shapely.box(west - reach, south - reach, east + reach, north + reach)
    for kind, run in groupby(valid, key=lambda item: item[0]):
        together = shapely.union_all([ring for _, ring in run])
        area = shapely.union(area, together) if kind == "border" else shapely.difference(area, together)
    return _areas(shapely.make_valid(area))


def _polygon(line: MeasuredLine) -> Any | None:
    xy = line.xyz[:, :2]
    if len(np.unique(xy, axis=0)) < 3:
        return None
    return shapely.Polygon(xy if (xy[0] == xy[-1]).all() else np.concatenate([xy, xy[:1]]))


def _areas(shape: Any) -> Any:
    """The polygons of a geometry."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(shape)) if shapely.get_type_id(p) == 3 and p.area > 0]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def _bounds(measured: MeasuredTerrain) -> tuple[float, float, float, float]:
    every = [g.xyz[:, :2] for g in measured.points if len(g.xyz)] + [line.xyz[:, :2] for line in measured.lines]
    low = np.min([xy.min(axis=0) for xy in every], axis=0)
    high = np.max([xy.max(axis=0) for xy in every], axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def outside(measured: MeasuredTerrain, domain: Any, tolerance: float) -> list[Finding]:
    """Points, lines and holes that lie outside of the area; points and lines are counted, holes named."""
    found = []
    borders = replace(measured, lines=tuple(line for line in measured.lines if line.kind == "border"))
    covered = domain_of(borders) if borders.lines else domain
    shapely.prepare(domain)
    for group in measured.points:
        out = _outside(group.xyz[:, :2], domain, tolerance)
        if out.any():
            at = int(np.flatnonzero(out)[0])
            X, Y = group.xyz[at, :2].tolist()
            text = (
                f"{group.name}: {int(out.sum())} of {len(out)} points lie outside the border lines or in holes, the "
                f"first is {group.label(at)} at X {X:.3f}, Y {Y:.3f}; nothing is predicted there"
            )
            found.append(Finding(kind="points outside", text=text, X=X, Y=Y, names=(group.name,)))
    for line in measured.lines:
        if line.kind == "border":
            continue
        if line.kind == "hole":
            ring = _polygon(line)
            if ring is None or shapely.intersection(shapely.make_valid(ring), covered).area > 0:
                continue
            X, Y = line.xyz[0, :2].tolist()
            text = f"{line.name}: the hole at X {X:.3f}, Y {Y:.3f} lies outside the border lines; it has no effect"
            found.append(Finding(kind="hole outside", text=text, X=X, Y=Y, names=(line.name,)))
            continue
        out = _outside(line.xyz[:, :2], domain, tolerance)
        if out.any():
            X, Y = line.xyz[np.flatnonzero(out)[0], :2].tolist()
            text = (
                f"{line.name}: {int(out.sum())} of {len(out)} vertices lie outside the border lines or in holes, the "
                f"first at X {X:.3f}, Y {Y:.3f}; nothing is predicted there"
            )
            found.append(Finding(kind="line outside", text=text, X=X, Y=Y, names=(line.name,)))
    return found


def _outside(xy: NDArray[np.float64], domain: Any, tolerance: float) -> NDArray[np.bool_]:
    """Which points are farther from the area than the tolerance."""
    out = np.zeros(len(xy), bool)
    for at in range(0, len(xy), CHUNK):
        part = slice(at, at + CHUNK)
        out[part] = ~shapely.contains_xy(domain, xy[part, 0], xy[part, 1])
    far = np.flatnonzero(out)
    if len(far):
        near = shapely.dwithin(domain, shapely.points(xy[far]), tolerance)
        out[far[near]] = False
    return out


def clusters(xy: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """Number of the point that stands for each point; chosen points are more than `tolerance` apart.

    The first of several close points stands for them, and no point is farther than twice the tolerance from the one
    that stands for it. Time and memory grow linearly with the number of points, also where many lie at one place.
    """
    chosen = np.arange(len(xy))
    if len(xy) < 2:
        return chosen
    local = xy - np.floor(xy.min(axis=0))
    near = _candidates(local, tolerance)
    if not len(near):
        return chosen
    # All points of a cell of half the tolerance are close to each other: the first stands for them. What is left has
    # a bounded number of neighbours.
    first, whose = _first_of_cells(local[near], tolerance / 2)
    kept = near[first]
    pairs = cKDTree(local[kept]).query_pairs(tolerance, output_type="ndarray")
    chosen[near] = kept[_greedy(len(kept), pairs)][whose]
    return chosen


def _cells(local: NDArray[np.float64], side: float, shift: tuple[float, float]) -> NDArray[np.int64]:
    """One number for the cell of each point; different cells may share a number, which does no harm."""
    column, row = (np.floor(local[:, k] / side + shift[k]).astype(np.int64) for k in (0, 1))
    return np.asarray(column * (int(row.max()) + 2) + row, np.int64)


def _candidates(local: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """Points that may have another within the tolerance: those not alone in a cell of one of four shifted grids."""
    shared = np.zeros(len(local), bool)
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        key = _cells(local, 2 * tolerance, shift)
        order = np.argsort(key)
        same = np.diff(key[order]) == 0
        shared[order[1:][same]] = True
        shared[order[:-1][same]] = True
    return np.flatnonzero(shared)


def _first_of_cells(local: NDArray[np.float64], side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First point of every cell, in the order of points, and for each point which of them is its cell's."""
    column, row = (np.floor(local[:, k] / side).astype(np.int64) for k in (0, 1))
    order = np.lexsort((np.arange(len(local)), row, column))
    new = np.concatenate([[True], (np.diff(column[order]) != 0) | (np.diff(row[order]) != 0)])
    heads = order[new]
    rank = np.argsort(np.argsort(heads))
    whose = np.empty(len(local), np.int64)
    whose[order] = rank[np.cumsum(new) - 1]
    return np.sort(heads), whose


def _greedy(count: int, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """The first point of every neighbourhood stands for those of its neighbours that nobody stands for yet."""
    chosen = np.arange(count)
    neighbours: dict[int, list[int]] = {}
    for a, b in pairs.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    taken: set[int] = set()
    for a in sorted(neighbours):
        if a in taken:
            continue
        taken.add(a)
        for b in neighbours[a]:
            if b not in taken:
                taken.add(b)
                chosen[b] = a
    return chosen


ROUNDS = 30
"""Rounds until vertices are joined; five to ten are usual."""
CHUNK_NODES = 20_000
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
    """Position along the segment, 0 to 1."""


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
    for at in range(0, len(ask), CHUNK_NODES):
        i, j = tree.query(lines[ask[at : at + CHUNK_NODES]])
        i = ask[at : at + CHUNK_NODES][i]
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


LEAST_SIGMA = 1e-6
"""Standard deviation that stands for exact heights in weights, metres."""


@dataclass(frozen=True, eq=False)
class Joined:
    """Points that became part of a vertex of lines."""

    vertex: NDArray[np.int64]
    z: NDArray[np.float64]
    sigma: NDArray[np.float64]
    labels: list[str]

    @staticmethod
    def all(parts: Sequence[Joined]) -> Joined:
        """The points of all parts."""
        return Joined(
            np.concatenate([np.empty(0, np.int64), *(p.vertex for p in parts)]),
            np.concatenate([np.empty(0), *(p.z for p in parts)]),
            np.concatenate([np.empty(0), *(p.sigma for p in parts)]),
            [label for p in parts for label in p.labels],
        )


@dataclass(frozen=True)
class Meeting:
    """Lines or points that meet at one place with different heights."""

    X: float
    Y: float
    names: tuple[str, ...]
    heights: tuple[float, ...]
    taken: float
    """Height that all of them have now; NaN at walls, where each side has its own."""


def one_height(
    net: Network, lines: Sequence[MeasuredLine], sigmas: NDArray[np.float64], joined: Joined, tolerance: float
) -> tuple[Network, list[Meeting]]:
    """The network with one height wherever lines meet: the mean, weighted by the standard deviations.

    Border lines and holes take the height of other lines where they meet, and never change it. At walls heights stay
    as they are. Heights that differ by more than `tolerance` are returned one by one.
    """
    terrain = np.array([line.kind in ("breakline", "formline") for line in lines], bool)
    wall = np.array([line.right is not None for line in lines], bool)
    weight = 1.0 / np.maximum(sigmas, LEAST_SIGMA) ** 2
    z = net.z.copy()
    meetings: list[Meeting] = []
    mean = np.full(len(net.xy), np.nan)
    # At a wall, lines have the height of the side that they come from: `cut_at_walls` gives it to them.
    free = ~np.isin(net.vertex, list(_sides(net, lines).walls)) & ~wall[net.line] & ~np.isnan(z)
    for leading in (True, False):
        place = np.flatnonzero((terrain[net.line] == leading) & free)
        vertex, height, w = net.vertex[place], z[place], weight[net.line[place]]
        if leading:
            vertex, height = np.concatenate([vertex, joined.vertex]), np.concatenate([height, joined.z])
            w = np.concatenate([w, 1.0 / np.maximum(joined.sigma, LEAST_SIGMA) ** 2])
        own, low, high = _means(vertex, height, w, len(net.xy))
        mean = np.where(np.isnan(mean), own, mean)
        different = np.flatnonzero(high - low > tolerance)
        owner = net.line[place]

        def name(k: int, owner: NDArray[np.int64] = owner) -> str:
            return lines[owner[k]].name if k < len(owner) else joined.labels[k - len(owner)]

        meetings += _meetings(net, name, different, vertex, height, mean)
        z[place] = mean[net.vertex[place]]
    return replace(net, z=z), meetings


def _means(
    vertex: NDArray[np.int64], z: NDArray[np.float64], weight: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean, lowest and highest height of every vertex; NaN where there is none."""
    total = np.bincount(vertex, weight, minlength=count)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, vertex, z)
    np.maximum.at(high, vertex, z)
    none = total == 0
    low[none] = high[none] = np.nan
    base = np.where(none, 0.0, low)
    with np.errstate(invalid="ignore"):  # equal heights keep their bits: their mean is `base`, plus zero
        mean = base + np.bincount(vertex, weight * (z - base[vertex]), minlength=count) / total
    return mean, low, high


def _meetings(
    net: Network,
    name: Callable[[int], str],
    different: NDArray[np.int64],
    vertex: NDArray[np.int64],
    z: NDArray[np.float64],
    mean: NDArray[np.float64],
) -> list[Meeting]:
    """Meetings at the vertices `different`, from the vertex and height of every entry and the name of each."""
    if not len(different):
        return []
    at = np.flatnonzero(np.isin(vertex, different))
    at = at[np.argsort(vertex[at], kind="stable")]
    out = []
    for part in np.split(at, np.flatnonzero(np.diff(vertex[at])) + 1):
        names = [name(k) for k in part.tolist()]
        seen = dict(zip(names, z[part].tolist()))  # a line that passes twice is named once, unless it is alone
        pairs = list(seen.items()) if len(seen) > 1 else list(zip(names, z[part].tolist()))
        v = int(vertex[part[0]])
        X, Y = net.xy[v].tolist()
        out.append(
            Meeting(
                X=X, Y=Y, names=tuple(n for n, _ in pairs), heights=tuple(h for _, h in pairs), taken=float(mean[v])
            )
        )
    return out


def cut_at_walls(
    net: Network, lines: Sequence[MeasuredLine], tolerance: float
) -> tuple[list[MeasuredLine], list[Meeting]]:
    """Lines of the network; those with one height are cut where they meet a wall, and take the height of its sides.

    A segment that a line shares with a wall is left to the wall. At the ends of a wall lines are not cut. Returned
    besides: meetings whose heights lie outside those of the wall by more than `tolerance`.
    """
    sides = _sides(net, lines)
    meetings: list[Meeting] = []
    out: list[MeasuredLine] = []
    bounds = np.searchsorted(net.line, np.arange(len(lines) + 1))
    for number, line in enumerate(lines):
        places = np.arange(bounds[number], bounds[number + 1])
        if len(places) < 2:
            continue
        touching = line.right is None and line.kind in ("breakline", "formline")
        v = net.vertex[places].tolist()
        meets = any(a in sides.walls for a in v) or any((min(a, b), max(a, b)) in sides.edges for a, b in pairwise(v))
        if not touching or not meets:
            out.append(_line(line, net, places))
            continue
        out += _pieces(net, line, places, sides, tolerance, meetings)
    return out, meetings


@dataclass(frozen=True, eq=False)
class _Walls:
    """Sides of lines along which walls pass."""

    walls: dict[int, tuple[int, int, float, float, str]]
    """By inner vertex: the vertex before and after, heights left and right, name."""
    edges: set[tuple[int, int]]
    """Segments of walls, smaller vertex first."""


def _sides(net: Network, lines: Sequence[MeasuredLine]) -> _Walls:
    walls: dict[int, tuple[int, int, float, float, str]] = {}
    edges: set[tuple[int, int]] = set()
    bounds = np.searchsorted(net.line, np.arange(len(lines) + 1))
    for number in (k for k, line in enumerate(lines) if line.right is not None):
        places = range(bounds[number], bounds[number + 1])
        v = net.vertex[places.start : places.stop].tolist()
        edges |= {(min(a, b), max(a, b)) for a, b in pairwise(v)}
        closed = len(v) > 3 and v[0] == v[-1]
        for k, place in enumerate(places):
            inner = 0 < k < len(v) - 1
            if inner or closed:
                before, after = (v[k - 1], v[k + 1]) if inner else (v[-2], v[1])
                walls.setdefault(
                    v[k], (before, after, float(net.z[place]), float(net.right[place]), lines[number].name)
                )
    return _Walls(walls, edges)


def _pieces(
    net: Network,
    line: MeasuredLine,
    places: NDArray[np.int64],
    sides: _Walls,
    tolerance: float,
    meetings: list[Meeting],
) -> list[MeasuredLine]:
    v = net.vertex[places].tolist()
    pieces: list[list[tuple[int, float]]] = [[]]
    for k, vertex in enumerate(v):
        own = float(net.z[places[k]])
        shared = k > 0 and (min(v[k - 1], vertex), max(v[k - 1], vertex)) in sides.edges
        arriving = leaving = own
        if vertex in sides.walls:
            arriving = _side(net, sides, vertex, v[k - 1]) if k and not shared else own
            leaving = _side(net, sides, vertex, v[k + 1]) if k + 1 < len(v) else own
            low, high = sorted(sides.walls[vertex][2:4])
            if not low - tolerance <= own <= high + tolerance:
                X, Y = net.xy[vertex].tolist()
                names = (line.name, sides.walls[vertex][4])
                meetings.append(Meeting(X=X, Y=Y, names=names, heights=(own, low, high), taken=float("nan")))
        if shared:
            pieces.append([])
        else:
            pieces[-1].append((vertex, arriving))
        if shared or leaving != arriving:
            pieces.append([(vertex, leaving)])
    kept = [p for p in pieces if len(p) > 1]
    return [
        replace(
            line,
            name=line.name if len(kept) == 1 else f"{line.name} part {k}",
            xyz=np.column_stack([net.xy[[a for a, _ in piece]], [h for _, h in piece]]),
        )
        for k, piece in enumerate(kept, 1)
    ]


def _side(net: Network, sides: _Walls, vertex: int, other: int) -> float:
    """Height of the side of the wall from which `other` is seen at its vertex."""
    before, after, left, right, _ = sides.walls[vertex]
    angle = [np.arctan2(*(net.xy[p] - net.xy[vertex])[::-1]) for p in (after, before, other)]
    # Left of the direction of travel lies what is met turning from the way ahead to the way back, anticlockwise.
    return left if (angle[2] - angle[0]) % (2 * np.pi) < (angle[1] - angle[0]) % (2 * np.pi) else right


def _line(line: MeasuredLine, net: Network, places: NDArray[np.int64]) -> MeasuredLine:
    xyz = np.column_stack([net.xy[net.vertex[places]], net.z[places]])
    return replace(line, xyz=xyz, right=None if line.right is None else net.right[places])


CHUNK_POINTS = 500_000
"""Points that are compared with lines at once."""


@dataclass(frozen=True, eq=False)
class Points:
    """The points of all groups as one table."""

    groups: tuple[PointGroup, ...]
    xyz: NDArray[np.float64]
    sigma: NDArray[np.float64]
    keep: NDArray[np.bool_]
    """False: joined with another point or with a line."""

    @staticmethod
    def of(groups: Sequence[PointGroup], sigmas: Mapping[str, float]) -> Points:
        """The table of groups; `sigmas` by class where a group has none."""
        sigma = [np.full(len(g.xyz), sigmas[g.kind] if g.sigma is None else g.sigma) for g in groups]
        xyz = np.concatenate([np.empty((0, 3)), *(g.xyz for g in groups)])
        return Points(tuple(groups), xyz, np.concatenate([np.empty(0), *sigma]), np.ones(len(xyz), bool))

    def label(self, index: int) -> str:
        """Return how a point is named in messages."""
        for group in self.groups:
            if index < len(group.xyz):
                return group.label(index)
            index -= len(group.xyz)
        raise IndexError(index)

    def regrouped(self) -> tuple[PointGroup, ...]:
        """The groups with the points that are kept."""
        out, start = [], 0
        for group in self.groups:
            part = slice(start, start + len(group.xyz))
            start = part.stop
            keep = self.keep[part]
            if keep.all():
                out.append(replace(group, xyz=self.xyz[part]))
            elif keep.any():
                names = None if group.names is None else group.names[keep]
                out.append(replace(group, xyz=self.xyz[part][keep], records=group.records[keep], names=names))
        return tuple(out)


def without_coincident(points: Points, tolerance: float, height_tolerance: float) -> tuple[Points, list[Finding]]:
    """The points with coincident ones joined: the one of smallest standard deviation stays, with the weighted mean.

    Pairs whose heights differ by more than `height_tolerance` are reported one by one.
    """
    chosen = clusters(points.xyz[:, :2], tolerance)
    double = np.zeros(len(chosen), bool)
    double[chosen[chosen != np.arange(len(chosen))]] = True
    at = np.flatnonzero(double[chosen])
    if not len(at):
        return points, []
    at = at[np.lexsort((points.sigma[at], chosen[at]))]  # the best of each place comes first
    place = np.unique(chosen[at], return_inverse=True)[1]
    starts = np.flatnonzero(np.diff(place, prepend=-1))
    z = points.xyz[at, 2]
    low, high = np.minimum.reduceat(z, starts), np.maximum.reduceat(z, starts)
    weight = 1.0 / np.maximum(points.sigma[at], LEAST_SIGMA) ** 2
    mean = low + np.bincount(place, weight * (z - low[place])) / np.bincount(place, weight)
    xyz, keep = points.xyz.copy(), points.keep.copy()
    keep[at] = False
    best = at[starts]
    keep[best] = True
    xyz[best, :2] = points.xyz[chosen[best], :2]
    xyz[best, 2] = mean
    equal = int((~keep[at]).sum())
    found = [Finding("coincident points", f"{equal} points coincide with others and were joined with them")]
    for k in np.flatnonzero(high - low > height_tolerance).tolist():
        members = at[starts[k] : starts[k + 1] if k + 1 < len(starts) else None]
        X, Y = xyz[best[k], :2].tolist()
        names = tuple(points.label(m) for m in members.tolist())
        heights = ", ".join(f"{n} {h:.3f} m" for n, h in zip(names, points.xyz[members, 2]))
        text = f"{heights}: points at X {X:.3f}, Y {Y:.3f} with different heights; {mean[k]:.3f} m taken"
        found.append(Finding(kind="coincident points", text=text, X=X, Y=Y, names=names))
    return replace(points, xyz=xyz, keep=keep), found


def join_to_lines(
    net: Network, lines: Sequence[MeasuredLine], points: Points, near: NDArray[np.int64], tolerance: float
) -> tuple[Network, Points, Joined | None, list[Finding]]:
    """Points on breaklines and form lines become vertices of these.

    Points on walls are left out and reported, since nobody knows to which side they belong. Points on a border line or
    hole stay points, at the place of one of its vertices.
    """
    start = net.segments
    near = near[points.keep[near]]
    index, place = _hits(net, points.xyz, near, start, tolerance)
    which, whose = np.unique(index, return_inverse=True)
    # A point at a vertex is done if it has its place and stays a point, as at border lines.
    used = np.unique(net.vertex[np.concatenate([start, start + 1])])
    distance, nearest = np.full(len(which), np.inf), np.zeros(len(which), np.int64)
    if len(which):
        distance, nearest = cKDTree(net.xy[used]).query(points.xyz[which, :2], distance_upper_bound=tolerance)
    free = ~np.isfinite(distance)
    vertex = used[np.where(free, 0, nearest)] if len(which) else nearest
    terrain, wall = _marks(net, lines, vertex, free, place, whose)
    done = ~terrain & ~wall & (distance == 0)
    if done.all():
        return net, points, None, []
    found = [_on_wall(points, int(k)) for k in which[wall]]
    free &= ~wall
    vertex[free] = len(net.xy) + np.arange(int(free.sum()))
    net = replace(net, xy=np.concatenate([net.xy, points.xyz[which[free], :2]]))
    through = free[whose]
    if through.any():
        at, own = place[through], vertex[whose[through]]
        a, b = net.xy[net.vertex[at]], net.xy[net.vertex[at + 1]]
        along = ((net.xy[own] - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1)
        net, _, _ = insert(net, Insertions(at, own, np.clip(along, 0, 1)))
    xyz, keep = points.xyz.copy(), points.keep.copy()
    on_border = ~terrain & ~wall
    xyz[which[on_border], :2] = net.xy[vertex[on_border]]
    keep[which[~on_border]] = False
    taken = terrain & ~wall
    joined = Joined(
        vertex[taken],
        points.xyz[which[taken], 2],
        points.sigma[which[taken]],
        [points.label(int(k)) for k in which[taken]],
    )
    return net, replace(points, xyz=xyz, keep=keep), joined, found


def _marks(
    net: Network,
    lines: Sequence[MeasuredLine],
    vertex: NDArray[np.int64],
    free: NDArray[np.bool_],
    place: NDArray[np.int64],
    whose: NDArray[np.int64],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """For each point: whether it is on a breakline or form line, and whether it is on a wall."""
    out = []
    for mark in (
        np.array([line.kind in ("breakline", "formline") for line in lines], bool),
        np.array([line.right is not None for line in lines], bool),
    ):
        at_vertex = np.zeros(len(net.xy), bool)
        at_vertex[net.vertex[mark[net.line]]] = True
        on_segment = np.zeros(len(vertex), bool)
        on_segment[whose[mark[net.line[place]]]] = True
        out.append(np.where(free, on_segment, at_vertex[vertex]))
    return out[0], out[1]


def points_near(net: Network, points: Points, distance: float) -> NDArray[np.int64]:
    """Points that are kept and closer than `distance` to a line."""
    candidates = np.flatnonzero(points.keep)
    return np.unique(_hits(net, points.xyz, candidates, net.segments, distance)[0])


def _on_wall(points: Points, k: int) -> Finding:
    X, Y, Z = points.xyz[k].tolist()
    name = points.label(k)
    text = f"{name}: lies on a wall at X {X:.3f}, Y {Y:.3f} with height {Z:.3f} m; left out, its side is not known"
    return Finding(kind="point on wall", text=text, X=X, Y=Y, names=(name,))


def _hits(
    net: Network, xyz: NDArray[np.float64], candidates: NDArray[np.int64], start: NDArray[np.int64], distance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points that lie on segments, and the place at which the segment starts."""
    none = np.empty(0, np.int64)
    if not len(start) or not len(candidates):
        return none, none
    ends = net.xy[np.stack([net.vertex[start], net.vertex[start + 1]], axis=1)]
    origin = np.floor(ends[0, 0])
    low, high = ends.min(axis=(0, 1)) - distance, ends.max(axis=(0, 1)) + distance
    tree = shapely.STRtree(shapely.linestrings(ends - origin))
    found = [(none, none)]
    for at in range(0, len(candidates), CHUNK_POINTS):
        part = candidates[at : at + CHUNK_POINTS]
        xy = xyz[part, :2]
        part = part[((xy >= low) & (xy <= high)).all(axis=1)]
        p, s = tree.query(shapely.points(xyz[part, :2] - origin), predicate="dwithin", distance=distance)
        found.append((part[p], start[s]))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


#: Single segments of a class that are told, where they are half of its lines at least: others are short lines.
_MANY = 5
_End = tuple[int, int]
"""Number of a line, and which of its ends: 0 or -1."""


def joined_segments(
    lines: Sequence[MeasuredLine], tolerance: float, height_tolerance: float
) -> tuple[list[MeasuredLine], list[Finding]]:
    """The lines, with single segments (two vertices) joined to what goes on where they end.

    Two ends are joined where they are the only ones of their class, code and accuracy at a place, one of the two lines
    is a single segment, and their heights agree. Two-sided breaklines keep their direction, others may be turned round.
    """
    single = np.array([len(line.xyz) == 2 for line in lines], bool)
    if not single.any():
        return list(lines), []
    partner = _partners(lines, single, tolerance, height_tolerance)
    out: list[MeasuredLine] = []
    used: set[int] = set()
    for first in range(len(lines)):
        if first in used:
            continue
        chain = _chain(first, partner)
        used.update(number for number, _ in chain)
        out.append(_joined([lines[number] for number, _ in chain], [turned for _, turned in chain], lines[first].name))
    return out, _told(len(lines) - len(out), out)


def _partners(
    lines: Sequence[MeasuredLine], single: NDArray[np.bool_], tolerance: float, height_tolerance: float
) -> dict[_End, _End]:
    """The end that each end goes on at."""
    ends: list[_End] = [(k, end) for k in range(len(lines)) for end in (0, -1)]
    place = clusters(np.array([lines[k].xyz[end, :2] for k, end in ends]), tolerance)
    groups: dict[object, list[_End]] = {}
    for (k, end), at in zip(ends, place.tolist()):
        line = lines[k]
        groups.setdefault((at, line.kind, line.code, line.sigma, line.right is None), []).append((k, end))
    found: dict[_End, _End] = {}
    for group in groups.values():
        if len(group) != 2 or group[0][0] == group[1][0]:
            continue
        (a, end_a), (b, end_b) = group
        one, other = lines[a], lines[b]
        sides = [(one.xyz[end_a, 2], other.xyz[end_b, 2])]
        if one.right is not None and other.right is not None:
            sides.append((one.right[end_a], other.right[end_b]))
        agree = all(not abs(u - v) > height_tolerance for u, v in sides)
        if (single[a] or single[b]) and agree and (one.right is None or end_a != end_b):
            found[a, end_a], found[b, end_b] = (b, end_b), (a, end_a)
    return found


def _chain(first: int, partner: dict[_End, _End]) -> list[tuple[int, bool]]:
    """Numbers of the lines that hang together, in order, and whether each is turned round."""
    number, end = first, 0
    while (number, end) in partner:
        number, end = partner[number, end]
        end = -1 - end
        if number == first:
            break  # a ring
    chain = [(number, end == -1)]
    end = -1 - end
    while (number, end) in partner:
        number, end = partner[number, end]
        if number == chain[0][0]:
            break
        chain.append((number, end == -1))
        end = -1 - end
    return chain


def _joined(parts: Sequence[MeasuredLine], turned: Sequence[bool], name: str) -> MeasuredLine:
    if len(parts) == 1:
        return parts[0]
    runs = [line.xyz[::-1] if back else line.xyz for line, back in zip(parts, turned)]
    xyz = np.concatenate([runs[0], *(run[1:] for run in runs[1:])])
    rights = [line.right for line in parts]
    right = None
    if rights[0] is not None:
        right = np.concatenate([rights[0], *(r[1:] for r in rights[1:] if r is not None)])
    return replace(parts[0], name=name, xyz=xyz, right=right)


def _told(joined: int, lines: Sequence[MeasuredLine]) -> list[Finding]:
    found = []
    if joined:
        text = f"{joined} pieces that came as single segments joined to the lines that they go on"
        found.append(Finding("joined segments", text))
    classes: dict[tuple[str, str], list[MeasuredLine]] = {}
    for line in lines:
        classes.setdefault((line.kind, line.code), []).append(line)
    for (kind, code), some in classes.items():
        left = [line for line in some if len(line.xyz) == 2]
        if len(left) < _MANY or 2 * len(left) < len(some):
            continue
        X, Y = left[0].xyz[0, :2].tolist()
        text = (
            f"{len(left)} of {len(some)} {kind}s{f' of code {code}' if code else ''} are single segments, for one "
            f"{left[0].name}: where they end, no other of their class goes on alone at the same height"
        )
        found.append(Finding(kind="single segments", text=text, X=X, Y=Y, names=tuple(line.name for line in left[:10])))
    return found


CLASS_SIGMAS: Mapping[str, float] = {
    "mass": 0.10,
    "spot": 0.05,
    "breakline": 0.10,
    "formline": 0.10,
    "border": 0.10,
    "hole": 0.10,
}
"""Standard deviations that weigh heights against each other where nothing is stated, metres."""
MAX_FINDINGS = 10_000
"""Findings of one kind that are listed; the others are counted."""
ROUNDS_RUN = 10
"""Rounds of joining points with lines; two are usual."""
TOLERANCE = 0.001
"""Distance in plan below which places are one, metres."""
HEIGHT_TOLERANCE = 0.05
"""Difference of heights at one place above which it is reported, metres."""
_FARTHEST = 1e8
"""Coordinates beyond this are in no projected CRS, metres."""


def clean(
    measured: MeasuredTerrain, sigmas: Mapping[str, float] | None = None
) -> tuple[MeasuredTerrain, tuple[Finding, ...]]:
    """The terrain without contradictions, and what was found.

    - Lines that came as single segments are joined (`joined_segments`); what stays single is reported.
    - Points and vertices closer than `TOLERANCE` become one; a point keeps the weighted mean of the heights, and the
      class of the one measured best.
    - Lines that meet, cross, touch or run along each other get common vertices there. All heights that meet at one
      place become their mean, weighted by 1/σ²; those that differ by more than `HEIGHT_TOLERANCE` are reported one by
      one. Border lines and holes follow the heights of other lines and never change them.
    - Points on a breakline or form line become vertices of it.
    - At a two-sided breakline (wall), lines with one height are cut; each part takes the height of its side.
      Where they run along a wall, the wall stays. Two walls that cross keep their heights.
    - Border lines and holes are closed if the gap is not longer than their longest side; self-crossing ones are
      reported and count where they enclose a place an odd number of times (`domain_of`). Points and lines outside are
      counted and kept.
    """
    _check_range(measured)
    sigmas = {**CLASS_SIGMAS, **(sigmas or {})}
    lines, found = joined_segments(measured.lines, TOLERANCE, HEIGHT_TOLERANCE)
    lines, more = closed(lines)
    found += more
    points, more = without_coincident(Points.of(measured.points, sigmas), TOLERANCE, HEIGHT_TOLERANCE)
    found += more
    net, more = _network(lines)
    found += more
    net, points, joined, more = _meet(net, lines, points)
    found += more
    found += _without_length(net, lines)
    sigma = np.array([sigmas[line.kind] if line.sigma is None else line.sigma for line in lines])
    net, meetings = one_height(net, lines, sigma, joined, HEIGHT_TOLERANCE)
    found += [_meeting(m) for m in meetings]
    lines, meetings = cut_at_walls(net, lines, HEIGHT_TOLERANCE)
    found += [_meeting(m) for m in meetings]
    lines, more = unfit_rings(lines)
    found += more
    cleaned = replace(measured, points=points.regrouped(), lines=tuple(lines))
    domain = domain_of(cleaned)
    if domain is not None:
        if domain.is_empty:
            raise GeometryError(f"{_files(measured)}: border lines and holes leave no area; check which are holes")
        found += outside(cleaned, domain, TOLERANCE)
    _check_rank(cleaned)
    return cleaned, _capped(found)


def _files(measured: MeasuredTerrain) -> str:
    return ", ".join(str(f) for f in measured.files) or "measured terrain"


def _check_range(measured: MeasuredTerrain) -> None:
    every = [(g.name, g.xyz) for g in measured.points] + [(line.name, line.xyz) for line in measured.lines]
    for name, xyz in every:
        if len(xyz) and np.abs(xyz[:, :2]).max() > _FARTHEST:
            at = int(np.abs(xyz[:, :2]).max(axis=1).argmax())
            raise InputError(
                f"{name}: X {xyz[at, 0]:g}, Y {xyz[at, 1]:g} (point {at + 1}) lies in no projected CRS; "
                "check the order of columns and the unit"
            )


def _network(lines: Sequence[MeasuredLine]) -> tuple[Network, list[Finding]]:
    """Network of lines without repeated vertices, and what these were."""
    net, places, spread = without_repeats(make_network(lines, TOLERANCE))
    found = []
    for place, difference in zip(places.tolist(), spread.tolist()):
        if difference > HEIGHT_TOLERANCE:
            X, Y = net.xy[net.vertex[place]].tolist()
            line = lines[net.line[place]]
            text = (
                f"{line.name}: consecutive vertices at X {X:.3f}, Y {Y:.3f} differ by {difference:.3f} m in height; "
                f"{net.z[place]:.3f} m taken (a wall is given as a two-sided breakline)"
            )
            found.append(Finding(kind="repeated vertices", text=text, X=X, Y=Y, names=(line.name,)))
    return net, found


def _meet(net: Network, lines: Sequence[MeasuredLine], points: Points) -> tuple[Network, Points, Joined, list[Finding]]:
    """Lines noded, and points on them made vertices."""
    found: list[Finding] = []
    parts: list[Joined] = []
    near = points_near(net, points, 4 * TOLERANCE)
    reach = TOLERANCE
    for _ in range(ROUNDS_RUN):
        net, points, joined, more = join_to_lines(net, lines, points, near, reach)
        found += more
        net, places = noded(net, TOLERANCE)
        for X, Y in places:
            text = f"lines too dense near X {X:.3f}, Y {Y:.3f}; vertices there were joined beyond {TOLERANCE} m"
            found.append(Finding("joined vertices", text, X, Y))
        if joined is None:
            break
        parts.append(joined)
        # Lines that were led through points and crossings moved a little: points may have come to lie on them.
        reach = TOLERANCE / 4
    joined = Joined.all(parts)
    if joined.labels:
        text = f"{len(joined.labels)} points lie on breaklines or form lines and became vertices of them"
        found.append(Finding("points on lines", text))
    return net, points, joined, found


def _without_length(net: Network, lines: Sequence[MeasuredLine]) -> list[Finding]:
    found = []
    count = np.bincount(net.line, minlength=len(lines))
    for number in np.flatnonzero(count < 2).tolist():
        line = lines[number]
        X, Y = line.xyz[0, :2].tolist()
        text = f"{line.name}: all its vertices are at X {X:.3f}, Y {Y:.3f}; a line without length, left out"
        found.append(Finding(kind="line without length", text=text, X=X, Y=Y, names=(line.name,)))
    return found


def _meeting(meeting: Meeting) -> Finding:
    who = ", ".join(f"{n} {h:.3f} m" for n, h in zip(meeting.names, meeting.heights))
    apart = max(meeting.heights) - min(meeting.heights)
    where = f"X {meeting.X:.3f}, Y {meeting.Y:.3f}"
    if np.isnan(meeting.taken):
        line, wall = meeting.names
        own, low, high = meeting.heights
        text = (
            f"{line} meets the wall {wall} at {where} with height {own:.3f} m, the wall stands from {low:.3f} to "
            f"{high:.3f} m; the heights of its sides taken"
        )
        return Finding(kind="line at wall", text=text, X=meeting.X, Y=meeting.Y, names=meeting.names)
    text = f"{who}: meet at {where} with heights {apart:.3f} m apart; {meeting.taken:.3f} m taken"
    return Finding(kind="crossing heights", text=text, X=meeting.X, Y=meeting.Y, names=meeting.names)


def _check_rank(measured: MeasuredTerrain) -> None:
    """Refuse data that determine no surface: fewer than three places, or all on one straight line."""
    lines = [line.xyz[np.isfinite(line.xyz[:, 2]), :2] for line in measured.lines]
    xy = np.concatenate([np.empty((0, 2)), *(g.xyz[:, :2] for g in measured.points), *lines])
    if len(xy) < 1000:
        xy = np.unique(xy, axis=0)
    if len(xy) < 3:
        raise GeometryError(
            f"{_files(measured)}: {len(xy)} different places with heights are left; a surface needs three at least"
        )
    local = xy - xy.mean(axis=0)
    _, axes = np.linalg.eigh(local.T @ local)
    across = local @ axes[:, 0]
    if np.ptp(across) <= TOLERANCE:
        raise GeometryError(
            f"{_files(measured)}: all {len(xy)} places lie on one straight line (within {np.ptp(across):.4f} m); the "
            "slope across it is not determined: add points beside it"
        )


def _capped(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """The findings, at most `MAX_FINDINGS` of one kind; the rest of a kind is counted."""
    count: Counter[str] = Counter()
    out = []
    for finding in found:
        count[finding.kind] += 1
        if count[finding.kind] <= MAX_FINDINGS:
            out.append(finding)
    for kind, number in count.items():
        if number > MAX_FINDINGS:
            out.append(Finding(kind, f"and {number - MAX_FINDINGS} more of this kind, not listed"))
    return tuple(out)

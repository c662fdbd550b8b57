"""Points at one place, and points on lines, joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.surfaces.measured import MeasuredLine, PointGroup
from photoplan.terrain.clean.borders import Finding
from photoplan.terrain.clean.heights import LEAST_SIGMA, Joined
from photoplan.terrain.clean.join import clusters
from photoplan.terrain.clean.nodes import Insertions, Network, insert

CHUNK = 500_000
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
        """How a point is named in messages."""
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
    for at in range(0, len(candidates), CHUNK):
        part = candidates[at : at + CHUNK]
        xy = xyz[part, :2]
        part = part[((xy >= low) & (xy <= high)).all(axis=1)]
        p, s = tree.query(shapely.points(xyz[part, :2] - origin), predicate="dwithin", distance=distance)
        found.append((part[p], start[s]))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

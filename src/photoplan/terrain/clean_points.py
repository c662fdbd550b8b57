"""Points at one place, and points on lines, joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.surfaces.measured import MeasuredLine, PointGroup
from photoplan.terrain.clean_borders import Finding
from photoplan.terrain.clean_heights import LEAST_SIGMA, Joined
from photoplan.terrain.clean_join import clusters
from photoplan.terrain.clean_nodes import Insertions, Network, insert

__all__ = ["Points", "join_to_lines", "without_coincident"]

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
        found.append(Finding("coincident points", text, X, Y, names))
    return replace(points, xyz=xyz, keep=keep), found


def join_to_lines(
    net: Network, lines: Sequence[MeasuredLine], points: Points, tolerance: float
) -> tuple[Network, Points, Joined, list[Finding]]:
    """Points on breaklines and form lines become vertices of these.

    Points on walls are left out and reported, since nobody knows to which side they belong. Points at a vertex of a
    border line move to it by the millimetre that they are apart, and stay points.
    """
    points = _at_border_vertices(net, lines, points, tolerance)
    terrain = np.array([line.kind in ("breakline", "formline") for line in lines], bool)
    start = net.segments
    start = start[terrain[net.line[start]]]
    index, place = _hits(net, points, start, tolerance)
    nothing = Joined(np.empty(0, np.int64), np.empty(0), np.empty(0), [])
    if not len(index):
        return net, points, nothing, []
    which, whose = np.unique(index, return_inverse=True)
    used = np.unique(net.vertex[np.concatenate([start, start + 1])])
    distance, nearest = cKDTree(net.xy[used]).query(points.xyz[which, :2], distance_upper_bound=tolerance)
    free = ~np.isfinite(distance)
    vertex = used[np.where(free, 0, nearest)]
    wall_line = np.array([line.right is not None for line in lines], bool)
    wall_vertex = np.zeros(len(net.xy), bool)
    wall_vertex[net.vertex[wall_line[net.line]]] = True
    on_wall = wall_vertex[vertex] & ~free
    on_wall[whose[wall_line[net.line[place]]]] |= free[whose[wall_line[net.line[place]]]]
    found = [_on_wall(points, int(k)) for k in which[on_wall]]
    free &= ~on_wall
    vertex[free] = len(net.xy) + np.arange(int(free.sum()))
    grown = replace(net, xy=np.concatenate([net.xy, points.xyz[which[free], :2]]))
    through = free[whose]
    if through.any():
        a, b = grown.xy[net.vertex[place[through]]], grown.xy[net.vertex[place[through] + 1]]
        along = ((grown.xy[vertex[whose[through]]] - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1)
        grown, _, _ = insert(grown, Insertions(place[through], vertex[whose[through]], np.clip(along, 0, 1)))
    kept = points.keep.copy()
    kept[which] = False
    taken = which[~on_wall]
    labels = [points.label(int(k)) for k in taken]
    if len(taken):
        text = f"{len(taken)} points lie on breaklines or form lines and became vertices of them"
        found.append(Finding("points on lines", text))
    return (
        grown,
        replace(points, keep=kept),
        Joined(vertex[~on_wall], points.xyz[taken, 2], points.sigma[taken], labels),
        found,
    )


def _on_wall(points: Points, k: int) -> Finding:
    X, Y, Z = points.xyz[k].tolist()
    name = points.label(k)
    text = f"{name}: lies on a wall at X {X:.3f}, Y {Y:.3f} with height {Z:.3f} m; left out, its side is not known"
    return Finding("point on wall", text, X, Y, (name,))


def _hits(
    net: Network, points: Points, start: NDArray[np.int64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points that lie on segments, and the place at which the segment starts."""
    none = np.empty(0, np.int64)
    if not len(start) or not points.keep.any():
        return none, none
    ends = net.xy[np.stack([net.vertex[start], net.vertex[start + 1]], axis=1)]
    origin = np.floor(ends[0, 0])
    low, high = ends.min(axis=(0, 1)) - tolerance, ends.max(axis=(0, 1)) + tolerance
    tree = shapely.STRtree(shapely.linestrings(ends - origin))
    candidates = np.flatnonzero(points.keep)
    found = [(none, none)]
    for at in range(0, len(candidates), CHUNK):
        part = candidates[at : at + CHUNK]
        xy = points.xyz[part, :2]
        part = part[((xy >= low) & (xy <= high)).all(axis=1)]
        dots = shapely.points(points.xyz[part, :2] - origin)
        p, s = tree.query(dots, predicate="dwithin", distance=tolerance)
        found.append((part[p], start[s]))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def _at_border_vertices(net: Network, lines: Sequence[MeasuredLine], points: Points, tolerance: float) -> Points:
    border = np.array([line.kind in ("border", "hole") for line in lines], bool)
    used = np.unique(net.vertex[border[net.line]]) if len(lines) else np.empty(0, np.int64)
    candidates = np.flatnonzero(points.keep)
    if not len(used) or not len(candidates):
        return points
    hits = cKDTree(net.xy[used]).query(points.xyz[candidates, :2], distance_upper_bound=tolerance)
    near = np.isfinite(hits[0])
    xyz = points.xyz.copy()
    xyz[candidates[near], :2] = net.xy[used[hits[1][near]]]
    return replace(points, xyz=xyz)

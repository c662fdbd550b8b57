"""Points and edges of the meshes of a unit that need triangles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.surfaces.mesh.lines import SNAP
from photoplan.surfaces.units import LineElement, Unit

Side = str
"""Which neighbour: north, east, south or west."""

#: Vertices on one edge nearer than this, in sides of a unit, are one.
SAME = 1e-8


@dataclass(frozen=True, eq=False)
class Nodes:
    """Points of the triangulation of a unit, its constrained edges, and the lines' vertices among them."""

    xy: NDArray[np.float64]
    """Positions in meshes, y downwards, shape (k, 2)."""
    values: NDArray[np.float64]
    """X, Y, Z and standard deviation, shape (k, 4), metres; NaN: no height."""
    edges: NDArray[np.int64]
    """Node numbers of edges that the triangles must keep, shape (m, 2)."""
    needed: NDArray[np.bool_]
    """Meshes that need triangles, shape (n, n)."""
    line_nodes: NDArray[np.int64]
    """Node of each vertex of the lines, one line after the other, −1 for vertices elsewhere, shape (v,)."""
    line_xy: NDArray[np.float64]
    """Positions of all vertices of the lines in meshes, shape (v, 2)."""


@dataclass(frozen=True, eq=False)
class _Loose:
    """Points beside the posts: vertices of lines first, then posts of finer neighbours."""

    xy: NDArray[np.float64]
    values: NDArray[np.float64]
    lines: int
    """How many are vertices of lines."""


def mesh_nodes(unit: Unit, lines: Sequence[LineElement], neighbours: Mapping[Side, Unit]) -> Nodes | None:
    """What is to be triangulated in a unit; None if no mesh needs triangles."""
    n = unit.meshes
    line_xy, line_values, breaks = _line_vertices(unit, lines)
    inside = ((line_xy >= 0) & (line_xy <= n)).all(axis=1)
    hanging_xy, hanging_values = _hanging(unit, neighbours)
    if not inside.any() and not len(hanging_xy):
        return None
    loose = _Loose(
        np.concatenate([line_xy[inside], hanging_xy]),
        np.concatenate([line_values[inside], hanging_values]),
        int(inside.sum()),
    )
    loose_xy = _joined(loose.xy, SAME * n)
    line_xy[inside] = loose_xy[: loose.lines]
    posts = _posts(unit)
    valid = np.isfinite(posts[..., 2])
    col, row = _on_posts(loose_xy[: loose.lines][np.isfinite(loose.values[: loose.lines, 2])])
    valid[row, col] = True
    needed = _needed(loose_xy, loose.lines, valid)
    if not needed.any():
        return None
    row, col = np.nonzero(_touching_posts(needed))
    of_needed = _touches(loose_xy, needed)
    # First the lines: where they meet a post of this or another unit, they count.
    all_xy = np.concatenate([loose_xy[of_needed], np.stack([col, row], axis=1).astype(float)])
    all_values = np.concatenate([loose.values[of_needed], posts[row, col]])
    first, number = _unique(all_xy)
    xy, values = all_xy[first], all_values[first]
    _first_heights(all_values, number, values)
    line_nodes = np.full(len(line_xy), -1)
    of_lines = np.flatnonzero(inside)[of_needed[: loose.lines]]
    line_nodes[of_lines] = number[: len(of_lines)]
    segments = _segments(line_nodes, line_xy, breaks, needed, unit, lines)
    edges = np.concatenate([_mesh_edges(xy, needed), segments])
    return Nodes(
        xy=xy,
        values=values,
        edges=np.unique(np.sort(edges, axis=1), axis=0),
        needed=needed,
        line_nodes=line_nodes,
        line_xy=line_xy,
    )


def _local(unit: Unit, XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions in meshes; whole numbers on grid lines."""
    xy = np.stack([XY[:, 0] - unit.left, unit.top - XY[:, 1]], axis=1) / unit.width
    nearest = np.rint(xy)
    return np.where(np.abs(xy - nearest) <= SNAP / 2, nearest, xy)


def _line_vertices(
    unit: Unit, lines: Sequence[LineElement]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Positions and values of all vertices, and the number of the first vertex of each line."""
    if not lines:
        return np.empty((0, 2)), np.empty((0, 4)), np.empty(0, np.int64)
    values = np.concatenate([np.column_stack([line.xyz, line.sigmas]) for line in lines])
    counts = np.array([len(line.xyz) for line in lines])
    return _local(unit, values[:, :2]), values, np.cumsum(counts) - counts


def _hanging(unit: Unit, neighbours: Mapping[Side, Unit]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Posts of neighbours that lie on the common edge between two posts of this unit."""
    edges: dict[Side, Any] = {
        "north": (0, slice(None)),
        "south": (-1, slice(None)),
        "west": (slice(None), 0),
        "east": (slice(None), -1),
    }
    opposite = {"north": "south", "south": "north", "west": "east", "east": "west"}
    xy, values = [np.empty((0, 2))], [np.empty((0, 4))]
    n = unit.meshes
    for side, other in neighbours.items():
        if side not in edges:
            raise InputError(f"neighbour on side {side!r}; sides are north, east, south and west")
        at = np.arange(1, other.meshes) * (n / other.meshes)
        take = edges[opposite[side]]
        Z, sigma = other.heights[take][1:-1] + np.float64(other.datum), other.sigmas[take][1:-1]
        between = (np.abs(at - np.rint(at)) > SNAP) & np.isfinite(Z)
        at, Z, sigma = at[between], Z[between], sigma[between]
        fixed = np.full(len(at), {"north": 0.0, "west": 0.0, "south": n, "east": n}[side])
        x, y = (at, fixed) if side in ("north", "south") else (fixed, at)
        xy.append(np.stack([x, y], axis=1))
        values.append(np.stack([unit.left + x * unit.width, unit.top - y * unit.width, Z, sigma], axis=1))
    return np.concatenate(xy), np.concatenate(values)


def _joined(xy: NDArray[np.float64], near: float) -> NDArray[np.float64]:
    """Positions in which points on one grid line that all but coincide do coincide with the first of them."""
    xy = xy.copy()
    for axis in (0, 1):
        on = np.flatnonzero((xy[:, axis] == np.rint(xy[:, axis])) & (xy[:, 1 - axis] != np.rint(xy[:, 1 - axis])))
        order = on[np.lexsort((xy[on, 1 - axis], xy[on, axis]))]
        if len(order) < 2:
            continue
        new = (np.diff(xy[order, axis]) != 0) | (np.diff(xy[order, 1 - axis]) > near)
        group = np.concatenate([[0], np.cumsum(new)])
        first = np.full(group[-1] + 1, len(xy))
        np.minimum.at(first, group, order)
        xy[order, 1 - axis] = xy[first[group], 1 - axis]
    return xy


def _posts(unit: Unit) -> NDArray[np.float64]:
    """X, Y, Z and standard deviation of all posts, shape (n + 1, n + 1, 4)."""
    along = np.arange(unit.meshes + 1) * unit.width
    X, Y = np.meshgrid(unit.left + along, unit.top - along)
    return np.stack([X, Y, unit.heights + np.float64(unit.datum), unit.sigmas.astype(float)], axis=-1)


def _on_posts(xy: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Column and row of the posts that points lie on."""
    col, row = xy[(xy == np.rint(xy)).all(axis=1)].astype(np.int64).T
    return col, row


def _needed(xy: NDArray[np.float64], lines: int, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Meshes that need triangles: those that a point touches, if they have all posts or a line passes."""
    n = valid.shape[0] - 1
    touched, passed = np.zeros((n, n), bool), np.zeros((n, n), np.int64)
    number, first = np.full(len(xy), -1), _unique(xy)
    number[:] = first[1]
    col, row, which = _meshes_of(xy, n)
    touched[row, col] = True
    of_line = which < lines
    pairs = np.unique(np.stack([row[of_line] * n + col[of_line], number[which[of_line]]], axis=1), axis=0)
    np.add.at(passed.reshape(-1), pairs[:, 0], 1)
    complete = valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:] & valid[:-1, :-1]
    return touched & (complete | (passed > 1))


def _meshes_of(xy: NDArray[np.float64], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Column, row and point number of all pairs of a mesh and a point that touches it."""
    high = np.floor(xy)
    low = np.ceil(xy) - 1
    columns, rows, which = [], [], []
    for x in (low[:, 0], high[:, 0]):
        for y in (low[:, 1], high[:, 1]):
            there = (x >= 0) & (x < n) & (y >= 0) & (y < n)
            columns.append(x[there].astype(np.int64))
            rows.append(y[there].astype(np.int64))
            which.append(np.flatnonzero(there))
    return np.concatenate(columns), np.concatenate(rows), np.concatenate(which)


def _touches(xy: NDArray[np.float64], needed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    col, row, which = _meshes_of(xy, len(needed))
    result = np.zeros(len(xy), bool)
    result[which[needed[row, col]]] = True
    return result


def _touching_posts(needed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    n = len(needed)
    posts = np.zeros((n + 1, n + 1), bool)
    for down in (0, 1):
        for right in (0, 1):
            posts[down : n + down, right : n + right] |= needed
    return posts


def _unique(xy: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the first point at every place, and the place's number for each point."""
    order = np.lexsort((xy[:, 1], xy[:, 0]))
    place = np.zeros(len(xy), np.int64)
    if len(xy):
        place[order[1:]] = np.cumsum((np.diff(xy[order], axis=0) != 0).any(axis=1))
    first = np.full(int(place.max(initial=-1)) + 1, len(xy))
    np.minimum.at(first, place, np.arange(len(xy)))
    return first, place


def _first_heights(all_values: NDArray[np.float64], number: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    """Where the first point at a place has no height (a border without), the first that has one counts."""
    lost = np.isnan(values[:, 2])
    known = np.flatnonzero(np.isfinite(all_values[:, 2]) & lost[number])[::-1]
    values[number[known], 2:] = all_values[known, 2:]


def _segments(
    nodes: NDArray[np.int64],
    xy: NDArray[np.float64],
    breaks: NDArray[np.int64],
    needed: NDArray[np.bool_],
    unit: Unit,
    lines: Sequence[LineElement],
) -> NDArray[np.int64]:
    """Pieces of lines inside meshes that need triangles; those along grid lines are mesh edges anyway."""
    n = len(needed)
    start = np.arange(max(0, len(nodes) - 1))
    start = start[~np.isin(start + 1, breaks)]
    a, b = nodes[start], nodes[start + 1]
    start = start[(a >= 0) & (b >= 0) & (a != b)]
    a, b = xy[start], xy[start + 1]
    low, high = np.minimum(a, b), np.maximum(a, b)
    crossing = (np.floor(low) + 1 < high).any(axis=1)
    if crossing.any():
        vertex = int(start[np.argmax(crossing)])
        line = lines[int(np.searchsorted(breaks, vertex, side="right")) - 1]
        raise InputError(
            f"{line.name}: the line crosses the grid of the unit at {unit.left}, {unit.top} without a vertex there "
            f"(grid width {unit.width} m); insert the intersections with on_grid first"
        )
    along = ((a == b) & (a == np.rint(a))).any(axis=1)
    col, row = np.minimum(np.floor(low), n - 1).astype(np.int64).T
    keep = ~along & needed[row, col]
    return np.stack([nodes[start[keep]], nodes[start[keep] + 1]], axis=1)


def _mesh_edges(xy: NDArray[np.float64], needed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Edges of meshes that need triangles, from node to node."""
    n = len(needed)
    across = np.zeros((n + 1, n), bool)
    across[:-1] |= needed
    across[1:] |= needed
    down = np.zeros((n, n + 1), bool)
    down[:, :-1] |= needed
    down[:, 1:] |= needed
    parts = []
    for axis, wanted in ((0, across), (1, down.T)):
        # Along x on grid lines of y, then the reverse: successive nodes of one line, if in one wanted edge.
        on = np.flatnonzero(xy[:, 1 - axis] == np.rint(xy[:, 1 - axis]))
        order = on[np.lexsort((xy[on, axis], xy[on, 1 - axis]))]
        a, b = order[:-1], order[1:]
        line = xy[a, 1 - axis].astype(np.int64)
        edge = np.minimum(np.floor(xy[a, axis]), n - 1).astype(np.int64)
        good = (xy[a, 1 - axis] == xy[b, 1 - axis]) & (xy[b, axis] <= edge + 1) & wanted[line, edge]
        parts.append(np.stack([a[good], b[good]], axis=1))
    return np.concatenate(parts)

"""Meshes: nodes, faces, lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pythoncdt
import shapely
from numpy.typing import NDArray

from photoplan.errors import GeometryError, InputError
from photoplan.kernels.terrain import sample_lattice
from photoplan.surfaces.units import LineElement, MeshFaces, Unit, UnitLayout

#: A vertex nearer than this to a grid line or post, in meshes, is moved onto it.
SNAP = 1e-6


def on_grid(line: LineElement, layout: UnitLayout, meshes: NDArray[np.int64]) -> LineElement:
    """A line with a vertex wherever it crosses a grid line of the unit that it is in.

    The new vertices are computed once, so that the meshes on both sides of a grid line hold the very same numbers;
    where a line runs along the border of two units it gets the posts of both. Vertices within 1e-6 of a mesh of a grid
    line are moved onto it. Lines that share vertices share them still.
    """
    if meshes.shape != (layout.rows, layout.columns):
        raise InputError(
            f"meshes of units given as {meshes.shape}; the layout has {layout.rows} rows, {layout.columns} columns"
        )
    chain = _Chain.of(line, layout).snapped(meshes)
    # First the borders of units; then every piece lies in one unit, or between two whose grids both count.
    segments = len(chain.xy) - 1
    chain = chain.cut(np.zeros((segments, 2)), np.ones(segments)).snapped(meshes)
    for shift in (SNAP / 10, -SNAP / 10):
        middle = (chain.xy[:-1] + chain.xy[1:]) / 2
        unit = np.floor(middle + shift)
        chain = chain.cut(unit, _count(unit, meshes))
    return chain.element(line)


@dataclass(frozen=True, eq=False)
class _Chain:
    """Vertices in sides of units from the layout's corner, y downwards, and what else is linear between them."""

    xy: NDArray[np.float64]
    ground: NDArray[np.float64]
    """X, Y, height, right height, standard deviation."""
    new: NDArray[np.bool_]
    layout: UnitLayout

    @classmethod
    def of(cls, line: LineElement, layout: UnitLayout) -> _Chain:
        X, Y, Z = line.xyz.T
        right = np.full(len(Z), np.nan) if line.right is None else line.right
        xy = np.stack([X - layout.left, layout.top - Y], axis=1) / layout.side
        return cls(xy, np.stack([X, Y, Z, right, line.sigmas], axis=1), line.on_grid, layout)

    def snapped(self, meshes: NDArray[np.int64]) -> _Chain:
        """Vertices near a grid line of any unit that they touch, moved onto it; repeated vertices left out."""
        xy, ground = self.xy.copy(), self.ground.copy()
        near = SNAP / max(1, int(meshes.max(initial=1)))
        todo = np.ones(xy.shape, bool)
        for dx in (near, -near):
            for dy in (near, -near):
                unit = np.floor(self.xy + np.array([dx, dy]))
                count = _count(unit, meshes)[:, None]
                fine = (self.xy - unit) * count
                line = np.rint(fine)
                hit = todo & (np.abs(fine - line) <= SNAP)
                xy[hit] = (unit + line / count)[hit]
                todo &= ~hit
        moved = ~todo
        ground[:, :2] = np.where(moved, self._to_ground(xy), ground[:, :2])
        keep = np.append(True, (np.diff(ground[:, :2], axis=0) != 0).any(axis=1))
        return _Chain(xy[keep], ground[keep], self.new[keep], self.layout)

    def cut(self, unit: NDArray[np.float64], count: NDArray[np.float64]) -> _Chain:
        """Vertices inserted at the grid lines of `count` meshes in a unit, for every segment."""
        if len(self.xy) < 2:
            return self
        segments = np.arange(len(self.xy) - 1)
        start, stop = self.xy[:-1], self.xy[1:]
        numbers, positions, places = [], [], []
        for axis in (0, 1):
            a = _exact((start[:, axis] - unit[:, axis]) * count)
            b = _exact((stop[:, axis] - unit[:, axis]) * count)
            first, last = np.floor(np.minimum(a, b)) + 1, np.ceil(np.maximum(a, b)) - 1
            crossings = np.maximum(last - first + 1, 0).astype(np.int64)
            which = np.repeat(segments, crossings)
            k = np.arange(len(which)) - np.repeat(np.cumsum(crossings) - crossings, crossings) + first[which]
            t = (k - a[which]) / (b[which] - a[which])
            place = start[which] + t[:, None] * (stop[which] - start[which])
            place[:, axis] = unit[which, axis] + k / count[which]
            other = 1 - axis
            fine = (place[:, other] - unit[which, other]) * count[which]
            near = np.abs(fine - np.rint(fine)) <= SNAP
            place[near, other] = (unit[which, other] + np.rint(fine) / count[which])[near]
            numbers.append(which)
            positions.append(t)
            places.append(place)
        return self._with(np.concatenate(numbers), np.concatenate(positions), np.concatenate(places))

    def _with(self, which: NDArray[np.int64], t: NDArray[np.float64], place: NDArray[np.float64]) -> _Chain:
        """New vertices at part t of segments `which`; two at one place are one."""
        if not len(which):
            return self
        ground = self.ground[which] + t[:, None] * (self.ground[which + 1] - self.ground[which])
        ground[:, :2] = self._to_ground(place)
        order = np.lexsort((t, which))
        count = len(self.xy)
        index = np.concatenate([np.arange(count), which[order]])
        again = np.argsort(index, kind="stable")
        xy = np.concatenate([self.xy, place[order]])[again]
        full = np.concatenate([self.ground, ground[order]])[again]
        new = np.concatenate([self.new, np.ones(len(which), bool)])[again]
        original = np.concatenate([np.ones(count, bool), np.zeros(len(which), bool)])[again]
        same = (xy[1:] == xy[:-1]).all(axis=1)
        keep = np.ones(len(xy), bool)
        keep[1:] &= ~same | original[1:]
        keep[:-1] &= ~(same & original[1:] & ~original[:-1])
        return _Chain(xy[keep], full[keep], new[keep], self.layout)

    def _to_ground(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack(
            [self.layout.left + xy[:, 0] * self.layout.side, self.layout.top - xy[:, 1] * self.layout.side], axis=1
        )

    def element(self, line: LineElement) -> LineElement:
        X, Y, Z, right, sigmas = self.ground.T
        return LineElement(
            name=line.name,
            kind=line.kind,
            code=line.code,
            xyz=np.stack([X, Y, Z], axis=1),
            right=None if line.right is None else right.copy(),
            sigmas=sigmas.copy(),
            on_grid=self.new,
        )


def _count(unit: NDArray[np.float64], meshes: NDArray[np.int64]) -> NDArray[np.float64]:
    """Meshes along the side of units (column, row), at least 1; 1 outside the layout."""
    rows, columns = meshes.shape
    inside = ((unit >= 0) & (unit < [columns, rows])).all(axis=1)
    count = np.ones(len(unit))
    col, row = unit[inside].astype(np.int64).T
    count[inside] = np.maximum(meshes[row, col], 1)
    return count


def _exact(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Whole numbers where only rounding keeps a position from being one."""
    nearest = np.rint(x)
    return np.where(np.abs(x - nearest) <= SNAP / 2, nearest, x)


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
    """Number of points that are vertices of lines."""


def mesh_nodes(unit: Unit, lines: Sequence[LineElement], neighbours: Mapping[Side, Unit]) -> Nodes | None:
    """Return what is to be triangulated in a unit; None if no mesh needs triangles."""
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
    """Return where the first point at a place has no height (a border without), the first that has one counts."""
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


def constrained_faces(xy: NDArray[np.float64], edges: NDArray[np.int64]) -> NDArray[np.int32]:
    """Triangles over all points (their convex hull is filled) that hold every edge."""
    xy = np.ascontiguousarray(xy, np.float64)
    edges = np.ascontiguousarray(edges, np.int64).reshape(-1, 2)
    if not np.isfinite(xy).all():
        raise GeometryError("triangulation: a point is not finite")
    if len(np.unique(xy, axis=0)) != len(xy):
        raise GeometryError("triangulation: two points at one place; join them first")
    if len(edges) and (edges[:, 0] == edges[:, 1]).any():
        raise GeometryError("triangulation: an edge begins and ends in one point")
    if len(xy) < 3 or np.linalg.matrix_rank(xy[1:] - xy[0]) < 2:
        return np.empty((0, 3), np.int32)
    # Near the origin the numbers keep their digits: map coordinates would cost seven of sixteen.
    local = xy - xy.mean(axis=0)
    mesh = pythoncdt.Triangulation(
        pythoncdt.VertexInsertionOrder.AUTO, pythoncdt.IntersectingConstraintEdges.NOT_ALLOWED, 0.0
    )
    try:
        mesh.insert_vertices(local)
        if len(edges):
            mesh.insert_edges(edges.astype(np.uint32))  # type: ignore[call-overload]  # arrays are buffers
        mesh.erase_super_triangle()
    except (RuntimeError, ValueError) as error:
        raise GeometryError(f"triangulation: {error}; lines may meet in common points, but not cross") from error
    faces = mesh.triangles_array()
    return np.ascontiguousarray(faces["vertices"], np.int32)


def build_faces(
    unit: Unit, lines: Sequence[LineElement], neighbours: Mapping[Side, Unit] | None = None, domain: Any = None
) -> MeshFaces | None:
    """Constrained triangulation of the meshes that a bilinear patch cannot describe.

    A post on a line takes the line's height. A mesh with posts without height gets triangles over its other vertices,
    if a line passes. Along a two-sided breakline the triangles on its left have the left heights, those on its right
    the right ones; at a free end both sides have the mean, and where walls meet each sector between two of them has
    the mean of what they give it. In both cases all units must see the same lines: see `lines`.
    """
    nodes = mesh_nodes(unit, lines, neighbours or {})
    if nodes is None:
        return None
    corners, mesh = _triangles(unit, nodes, lines, domain)
    corners, mesh = _with_markers(unit, nodes, corners, mesh)
    if not len(corners):
        return None
    order = np.argsort(mesh, kind="stable")
    values, numbers = split_at_walls(nodes, lines, corners[order])
    count = np.bincount(mesh, minlength=unit.meshes**2)
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return MeshFaces(np.ascontiguousarray(values[:, :3]), values[:, 3].astype(np.float32), numbers, start)


def _triangles(
    unit: Unit, nodes: Nodes, lines: Sequence[LineElement], domain: Any
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Node numbers of the triangles that count, and the mesh of each."""
    n = unit.meshes
    try:
        corners = constrained_faces(nodes.xy * [1.0, -1.0], nodes.edges)
    except GeometryError as error:
        raise GeometryError(_crossing(unit, lines)) from error
    middle = nodes.xy[corners].mean(axis=1)
    col, row = np.clip(np.floor(middle), 0, n - 1).astype(np.int64).T
    good = nodes.needed[row, col] & np.isfinite(nodes.values[corners, 2]).all(axis=1)
    corners, middle, mesh = corners[good], middle[good], (row * n + col)[good]
    if domain is None:
        return corners, mesh
    inside = _inside(unit, middle, domain)
    return corners[inside], mesh[inside]


def _crossing(unit: Unit, lines: Sequence[LineElement]) -> str:
    """Return what to tell of lines that cross: the first pair that is found."""
    place = f"computing unit X {unit.left} … {unit.left + unit.side}, Y {unit.top - unit.side} … {unit.top}"
    advice = "lines may meet in common vertices only; insert one, or leave one of the lines out"
    paths = [shapely.LineString(line.xyz[:, :2]) for line in lines]
    for one, two in zip(*shapely.STRtree(paths).query(paths, predicate="intersects")):
        if one > two:
            continue
        if one == two and not paths[one].is_simple:
            return f"{place}: {lines[one].name} crosses or touches itself; {advice}"
        common = shapely.get_coordinates(paths[one].intersection(paths[two])) if one < two else ()
        vertices = {tuple(v) for v in lines[one].xyz[:, :2]} & {tuple(v) for v in lines[two].xyz[:, :2]}
        bad = [point for point in common if tuple(point) not in vertices]
        if bad:
            return f"{place}: {lines[one].name} and {lines[two].name} meet at {bad[0][0]}, {bad[0][1]}; {advice}"
    return f"{place}: pieces of lines lie upon each other; {advice}"


def _inside(unit: Unit, middle: NDArray[np.float64], domain: Any) -> NDArray[np.bool_]:
    box = (unit.left, unit.top - unit.side, unit.left + unit.side, unit.top)
    part = shapely.clip_by_rect(domain, *box)
    shapely.prepare(part)
    return np.asarray(
        shapely.contains_xy(part, unit.left + middle[:, 0] * unit.width, unit.top - middle[:, 1] * unit.width)
    )


def _with_markers(
    unit: Unit, nodes: Nodes, corners: NDArray[np.int32], mesh: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """A triangle without area in meshes that have no surface, though all of their posts have heights."""
    n = unit.meshes
    valid = np.isfinite(unit.heights)
    complete = valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:] & valid[:-1, :-1]
    bare = complete & nodes.needed
    bare.reshape(-1)[mesh] = False
    row, col = np.nonzero(bare)
    if not len(row):
        return corners, mesh
    posts = np.flatnonzero((nodes.xy == np.rint(nodes.xy)).all(axis=1))
    number = np.full((n + 1, n + 1), -1)
    number[nodes.xy[posts, 1].astype(np.int64), nodes.xy[posts, 0].astype(np.int64)] = posts
    marks = np.repeat(number[row, col][:, None], 3, axis=1).astype(np.int32)
    return np.concatenate([corners, marks]), np.concatenate([mesh, row * n + col])


@dataclass(frozen=True, eq=False)
class _WallRays:
    """Pieces of walls that leave a node, sorted by node and direction; sector k lies left of ray k."""

    node: NDArray[np.int64]
    angle: NDArray[np.float64]
    height: NDArray[np.float64]
    """Height of the sector that begins at the ray."""
    rank: NDArray[np.int64]
    """Number of the sector at its node: sectors on the left of walls first."""
    first: NDArray[np.int64]
    """First and one past the last ray of the node that each ray belongs to."""
    last: NDArray[np.int64]


def split_at_walls(
    nodes: Nodes, lines: Sequence[LineElement], corners: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices of triangles, doubled along two-sided breaklines.

    The pieces of walls that meet in a point part its surroundings into sectors; each has the mean of the heights that
    the walls on both of its sides give it. In the middle of a wall these are the heights left and right; where a wall
    ends there is one sector, and with it one height, the mean of both.
    """
    rank = np.zeros(corners.shape, np.int64)
    height = nodes.values[corners, 2]
    rays = _rays(nodes, lines)
    if len(rays.node):
        _find_sectors(nodes, rays, corners, rank, height)
    most = int(rank.max(initial=0)) + 1
    key = corners.astype(np.int64) * most + rank
    used, first, number = np.unique(key, return_index=True, return_inverse=True)
    values = nodes.values[used // most].copy()
    values[:, 2] = height.reshape(-1)[first]
    return values, number.reshape(corners.shape).astype(np.int32)


def _rays(nodes: Nodes, lines: Sequence[LineElement]) -> _WallRays:
    node, angle, on_left, on_right, outward = [], [], [], [], []
    begin = 0
    for line in lines:
        count = len(line.xyz)
        at = nodes.line_nodes[begin : begin + count]
        xy = nodes.line_xy[begin : begin + count]
        begin += count
        if line.right is None:
            continue
        step = np.diff(xy, axis=0)
        for here, direction, out in ((np.arange(count - 1), step, True), (np.arange(1, count), -step, False)):
            there = (at[here] >= 0) & (direction != 0).any(axis=1)
            here, direction = here[there], direction[there]
            node.append(at[here])
            angle.append(np.arctan2(-direction[:, 1], direction[:, 0]))
            on_left.append(line.xyz[here, 2] if out else line.right[here])
            on_right.append(line.right[here] if out else line.xyz[here, 2])
            outward.append(np.full(len(here), out))
    if not node:
        empty = np.empty(0, np.int64)
        return _WallRays(node=empty, angle=np.empty(0), height=np.empty(0), rank=empty, first=empty, last=empty)
    at, turn = np.concatenate(node), np.concatenate(angle)
    order = np.lexsort((turn, at))
    left, right = np.concatenate(on_left)[order], np.concatenate(on_right)[order]
    return _sectors(at[order], turn[order], left, right, np.concatenate(outward)[order])


def _sectors(
    at: NDArray[np.int64],
    turn: NDArray[np.float64],
    left: NDArray[np.float64],
    right: NDArray[np.float64],
    out: NDArray[np.bool_],
) -> _WallRays:
    count = len(at)
    first = np.searchsorted(at, at, side="left")
    last = np.searchsorted(at, at, side="right")
    following = np.arange(1, count + 1)
    following = np.where(following == last, first, following)
    height = (left + right[following]) / 2
    # A sector is on the left of a wall that leaves on its right-hand side, and of one that arrives on its left.
    lefts = out.astype(np.int64) + ~out[following]
    order = np.lexsort((np.arange(count), -lefts, at))
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count) - first
    # No wall is left where all sectors have one height.
    low, high = height.copy(), height.copy()
    np.minimum.at(low, first, height)
    np.maximum.at(high, first, height)
    rank[low[first] == high[first]] = 0
    return _WallRays(node=at, angle=turn, height=height, rank=rank, first=first, last=last)


def _find_sectors(
    nodes: Nodes, rays: _WallRays, corners: NDArray[np.int32], rank: NDArray[np.int64], height: NDArray[np.float64]
) -> None:
    """Sector of every corner that is at a wall, from the direction of the triangle's middle."""
    at_wall = np.zeros(len(nodes.xy), bool)
    at_wall[rays.node] = True
    face, corner = np.nonzero(at_wall[corners])
    node = corners[face, corner].astype(np.int64)
    # Directions along both edges, made equally long: their sum points into the triangle however flat it is.
    direction = np.zeros((len(face), 2))
    for step in (1, 2):
        edge = nodes.xy[corners[face, (corner + step) % 3]] - nodes.xy[node]
        direction += edge / np.maximum(np.hypot(edge[:, 0], edge[:, 1]), np.finfo(float).tiny)[:, None]
    turn = np.arctan2(-direction[:, 1], direction[:, 0])
    ray = _last_before(rays, node, turn)
    rank[face, corner] = rays.rank[ray]
    height[face, corner] = rays.height[ray]


def _last_before(rays: _WallRays, node: NDArray[np.int64], turn: NDArray[np.float64]) -> NDArray[np.int64]:
    """The ray of a node from which a direction is reached counter-clockwise, without another between."""
    all_nodes = np.concatenate([rays.node, node])
    all_turns = np.concatenate([rays.angle, turn])
    is_ray = np.concatenate([np.ones(len(rays.node), bool), np.zeros(len(node), bool)])
    order = np.lexsort((~is_ray, all_turns, all_nodes))
    passed = np.cumsum(is_ray[order]) - 1
    before = np.empty(len(order), np.int64)
    before[order] = passed
    found = before[len(rays.node) :]
    first = np.searchsorted(rays.node, node, side="left")
    return np.where(found < first, np.searchsorted(rays.node, node, side="right") - 1, found)


def thin(unit: Unit, tolerance: float) -> Unit:
    """A unit with the coarsest grid, by factors of two, whose bilinear surface keeps to all posts."""
    if unit.faces is not None:
        raise InputError(f"unit at {unit.left}, {unit.top} has triangles; thin the grid first, then build them")
    if not tolerance >= 0:
        raise InputError(f"tolerance {tolerance}; a height in metres, zero or more, is needed")
    step = 1
    while unit.meshes % (2 * step) == 0 and _keeps(unit.heights, 2 * step, tolerance):
        step *= 2
    if step == 1:
        return unit
    return dataclasses.replace(
        unit,
        heights=np.ascontiguousarray(unit.heights[::step, ::step]),
        sigmas=np.ascontiguousarray(unit.sigmas[::step, ::step]),
    )


def _keeps(heights: NDArray[np.float32], step: int, tolerance: float) -> bool:
    """Return whether posts at every `step` describe the same area, and all posts well enough."""
    count = heights.shape[0]
    coarse = np.ascontiguousarray(heights[::step, ::step])
    n = coarse.shape[0] - 1
    valid = _complete(np.isfinite(heights)).reshape(n, step, n, step)
    whole, none = valid.all(axis=(1, 3)), ~valid.any(axis=(1, 3))
    if not (np.where(_complete(np.isfinite(coarse)), whole, none)).all():
        return False
    between = sample_lattice(coarse, 0.0, 1 / step, count, 0.0, 1 / step, count)
    both = np.isfinite(heights) & np.isfinite(between)
    return bool((np.abs(heights[both].astype(float) - between[both]) <= tolerance).all())


def _complete(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Meshes with all four posts."""
    return np.asarray(valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:] & valid[:-1, :-1])

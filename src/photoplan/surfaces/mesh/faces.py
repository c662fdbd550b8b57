"""Triangles of the meshes where lines pass or finer posts adjoin (Ecker 1991, §2.1.1, §5.4.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pythoncdt
import shapely
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.surfaces.mesh.nodes import Nodes, Side, mesh_nodes
from photoplan.surfaces.units import LineElement, MeshFaces, Unit


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
    """What to tell of lines that cross: the first pair that is found."""
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

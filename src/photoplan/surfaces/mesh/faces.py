"""Triangles of the meshes where lines pass or finer posts adjoin (Ecker 1991, §2.1.1, §5.4.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.geometry.triangulation import constrained_faces
from photoplan.surfaces.mesh.nodes import Nodes, Side, mesh_nodes
from photoplan.surfaces.mesh.walls import split_at_walls
from photoplan.surfaces.units import LineElement, MeshFaces, Unit


def build_faces(
    unit: Unit,
    lines: Sequence[LineElement],
    neighbours: Mapping[Side, Unit] | None = None,
    domain: Any = None,
) -> MeshFaces | None:
    """Constrained triangulation of the meshes that a bilinear patch cannot describe.

    A post on a line takes the line's height. A mesh with posts without height gets triangles over its other vertices,
    if a line passes. Along a two-sided breakline the triangles on its left have the left heights, those on its right
    the right ones; at a free end both sides have the mean, and where walls meet each sector between two of them has
    the mean of what they give it. In both cases all units must see the same lines: see `lines`.

    Parameters
    ----------
    unit : Unit
        Its own faces are not used.
    lines : sequence of LineElement
        All lines that touch the unit, edges and corners included, not clipped and with grid intersections
        (`on_grid`); in the same order for all units. Lines meet in common vertices only. Border vertices without
        height take that of another line or a post at their place, else no triangle reaches them.
    neighbours : mapping of "north", "east", "south", "west" to Unit, optional
        Units beside this one: where their posts lie between two of this unit, they become vertices of its triangles,
        so that the surface is continuous.
    domain : shapely polygon or multipolygon, optional
        Where there is a surface; triangles outside are left out. Its border must be among the lines.

    Returns
    -------
    MeshFaces or None
        None if no mesh needs triangles. A mesh wholly outside the domain whose four posts have heights is marked by
        one triangle of three equal corners: else it would count as bilinear.

    Raises
    ------
    InputError
        A line lacks its grid intersections, or a neighbour's side is none of the four.
    GeometryError
        Lines cross without a common vertex.
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

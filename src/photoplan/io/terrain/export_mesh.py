"""The surface of a hybrid model as one triangulation, unit by unit: shared vertices are one, walls are vertical.

A mesh without triangles becomes two; on them the surface differs from the bilinear one by at most a quarter of
|h00 − h01 − h10 + h11|, in the middle. Each vertex has one number however many units it belongs to, so that the
triangulation is closed; memory is bounded, since only vertices on the edges of the last two rows of units are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan.surfaces.units import Unit, UnitSource

_SAME = 2e-5
"""Vertices closer than this in the plane, metres, and …"""
_SAME_HEIGHT = 5e-4
"""… closer than this in height are one: posts are stored to a fraction of it, places are known far better."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """What one unit adds to the triangulation."""

    vertices: NDArray[np.float64]
    """New vertices, X, Y, Z, shape (k, 3), metres; their numbers follow those of the parts before."""
    faces: NDArray[np.int64]
    """Vertex numbers, from 0 over all parts, of each triangle of the surface, counter-clockwise, shape (f, 3)."""
    walls: NDArray[np.int64]
    """The same of vertical triangles at two-sided breaklines, shape (w, 3)."""


def mesh_parts(source: UnitSource) -> Iterator[MeshPart]:
    """The triangulation of a model, a part for each unit that has a surface, row by row."""
    numbers = _SharedNumbers()
    layout = source.layout
    for row in range(layout.rows):
        for column in range(layout.columns):
            unit = source.unit(column, row)
            if unit is None:
                continue
            vertices, faces, walls = unit_mesh(unit)
            if not len(faces):
                continue
            number, new = numbers.take(vertices, _on_edge(vertices, unit))
            yield MeshPart(vertices[new], number[faces], number[walls])
        numbers.next_row()


def unit_mesh(unit: Unit) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices (k, 3), triangles (f, 3) and vertical triangles of walls (w, 3) of a unit; vertex numbers from 0."""
    n = unit.meshes
    post = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    along = np.arange(n + 1) * unit.width
    X, Y = np.meshgrid(unit.left + along, unit.top - along)
    vertices = np.stack([X, Y, unit.heights.astype(float) + unit.datum], axis=-1).reshape(-1, 3)
    plain = np.ones((n, n), bool)
    corners = np.empty((0, 3), np.int64)
    if unit.faces is not None:
        plain = (np.diff(unit.faces.start) == 0).reshape(n, n)
        own = unit.faces.corners.astype(np.int64)
        # Three equal corners mark a mesh without a surface.
        corners = own[(own[:, 0] != own[:, 1]) & (own[:, 1] != own[:, 2]) & (own[:, 0] != own[:, 2])] + len(vertices)
        vertices = np.concatenate([vertices, unit.faces.vertices])
    there = np.isfinite(unit.heights)
    plain &= there[:-1, :-1] & there[:-1, 1:] & there[1:, :-1] & there[1:, 1:]
    a, b, c, d = (part[plain] for part in (post[:-1, :-1], post[:-1, 1:], post[1:, :-1], post[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1), corners])
    if unit.faces is not None:
        faces = _joined(vertices)[faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    return vertices, faces, _walls(vertices, faces) if unit.faces is not None else np.empty((0, 3), np.int64)


def _joined(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each vertex the first that lies at its place."""
    there = np.flatnonzero(np.isfinite(vertices[:, 2]))
    scaled = vertices[there] / [_SAME, _SAME, _SAME_HEIGHT]
    pairs = there[cKDTree(scaled - scaled.min(axis=0)).query_pairs(1.0, output_type="ndarray")].reshape(-1, 2)
    first = np.arange(len(vertices))
    if len(pairs):
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
        group = connected_components(graph, directed=False)[1]
        _, lowest = np.unique(group, return_index=True)
        first = lowest[group]
    return first


def _walls(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Vertical triangles between edges that lie above each other and belong to one triangle each."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    open_edges = edges[first[count == 1]]
    if not len(open_edges):
        return np.empty((0, 3), np.int64)
    # Ends at one place in the plane have one number.
    ends = np.unique(open_edges)
    place = np.zeros(len(vertices), np.int64)
    flat = vertices[ends] * [1, 1, 0]
    place[ends] = _joined(flat)
    by_place: dict[tuple[int, int], tuple[int, int]] = {(place[a], place[b]): (a, b) for a, b in open_edges.tolist()}
    walls: list[tuple[int, int, int]] = []
    for (p, q), (a, b) in by_place.items():
        other = by_place.get((q, p))
        if other is None or p > q:
            continue
        c, d = other  # c lies at b's place, d at a's
        walls += [t for t in ((b, a, d), (b, d, c)) if len(set(t)) == 3]
    return np.array(walls, np.int64).reshape(-1, 3)


def _on_edge(vertices: NDArray[np.float64], unit: Unit) -> NDArray[np.bool_]:
    """Whether vertices lie on the border of their unit."""
    x, y = vertices[:, 0] - unit.left, unit.top - vertices[:, 1]
    inside = (x > _SAME) & (x < unit.side - _SAME) & (y > _SAME) & (y < unit.side - _SAME)
    return np.asarray(~inside)


class _SharedNumbers:
    """Numbers of vertices over all units."""

    def __init__(self) -> None:
        self.count = 0
        self._here: dict[tuple[int, int], list[tuple[float, float, float, int]]] = {}
        self._above: dict[tuple[int, int], list[tuple[float, float, float, int]]] = {}

    def next_row(self) -> None:
        """Forget vertices that no later unit can share."""
        self._above, self._here = self._here, {}

    def take(
        self, vertices: NDArray[np.float64], shared: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Number of each vertex, and which are new."""
        known = np.full(len(vertices), -1, np.int64)
        cells = np.floor(vertices[:, :2] / (4 * _SAME) + 0.5)
        # A vertex near the edge of its cell may lie in the next one as another unit has it.
        rest = vertices[:, :2] / (4 * _SAME) + 0.5 - cells
        near = np.where(rest < 0.25, -1, np.where(rest > 0.75, 1, 0)).astype(int)
        for i in np.flatnonzero(shared).tolist():
            known[i] = self._find(cells[i], near[i], vertices[i].tolist())
        new = known < 0
        known[new] = self.count + np.arange(np.count_nonzero(new))
        self.count += int(np.count_nonzero(new))
        for i in np.flatnonzero(shared).tolist():
            place = (int(cells[i, 0]), int(cells[i, 1]))
            x, y, z = vertices[i].tolist()
            self._here.setdefault(place, []).append((x, y, z, int(known[i])))
        return known, new

    def _find(self, cell: NDArray[np.float64], near: NDArray[np.int64], xyz: list[float]) -> int:
        column, row = int(cell[0]), int(cell[1])
        for c in {column, column + int(near[0])}:
            for r in {row, row + int(near[1])}:
                for kept in (self._here, self._above):
                    for x, y, z, number in kept.get((c, r), ()):
                        same = abs(x - xyz[0]) < _SAME and abs(y - xyz[1]) < _SAME
                        if same and abs(z - xyz[2]) < _SAME_HEIGHT:
                            return number
        return -1

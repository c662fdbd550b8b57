"""A part of a terrain as triangles with numbered vertices, the same at the edges that parts share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan.terrain.contours.parts import SurfacePart

#: Vertices nearer than this are one: metres in position …
SAME_PLACE = 1e-6
#: … and in height. Posts are kept in float32 above a datum of their unit; walls are higher.
SAME_HEIGHT = 2e-4
#: … where two parts meet: neighbouring units of a model agree to about a millimetre.
SAME_BORDER = 2e-3
#: A vertex of a breakline is looked for up to here, metres.
ON_LINE = 1e-5
_SCALE = np.array([SAME_PLACE, SAME_PLACE, SAME_HEIGHT])
_BORDER_SCALE = np.array([SAME_PLACE, SAME_PLACE, SAME_BORDER])


@dataclass(frozen=True, eq=False)
class PartMesh:
    """Triangles of a part: four round the centre of every bilinear mesh, and those that the part brings along."""

    xyz: NDArray[np.float64]
    """Posts row by row, further vertices of triangles, then the centre of every mesh; shape (n, 3)."""
    columns: int
    """Meshes in a row."""
    whole: NDArray[np.bool_]
    """Meshes that are bilinear, shape (meshes,)."""
    triangles: NDArray[np.int64]
    """Shape (m, 3), counter-clockwise."""
    shared: NDArray[np.int64]
    """Number of each vertex in the whole terrain if it lies on the part's outer edge, else -1; shape (n,)."""
    creases: NDArray[np.int64]
    """Edges on breaklines as lower · n + higher vertex, sorted."""

    @property
    def first_centre(self) -> int:
        """Number of the first mesh's centre."""
        return len(self.xyz) - len(self.whole)

    def bends(self, edges: NDArray[np.int64]) -> NDArray[np.float64]:
        """How a bilinear surface departs from the straight line along edges (m, 2), shape (m,), metres.

        Along half a diagonal of a mesh the height is z0 + (z1 − z0) s − bend s (1 − s); elsewhere edges are straight.
        """
        mesh = edges[:, 1] - self.first_centre
        half = np.flatnonzero(mesh >= 0)
        bends = np.zeros(len(edges))
        mesh = mesh[half]
        nw = mesh + mesh // self.columns
        sw = nw + self.columns + 1
        z = self.xyz[:, 2]
        twist = z[nw] - z[nw + 1] - z[sw] + z[sw + 1]
        post = edges[half, 0]
        falling = (post == nw) | (post == sw + 1)
        bends[half] = np.where(falling, twist, -twist) / 4
        return bends

    def on_crease(self, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether edges (m, 2), lower vertex first, lie on a breakline; shape (m,)."""
        if not len(self.creases):
            return np.zeros(len(edges), bool)
        keys = edges[:, 0] * len(self.xyz) + edges[:, 1]
        at = np.minimum(np.searchsorted(self.creases, keys), len(self.creases) - 1)
        return self.creases[at] == keys


@dataclass(eq=False)
class Front:
    """Vertices on the edges of the parts behind the sweep: what the next parts must share."""

    count: int = 0
    row: int = -1
    _above: dict[int, tuple[NDArray[np.float64], NDArray[np.int64]]] = field(default_factory=dict)
    _here: dict[int, tuple[NDArray[np.float64], NDArray[np.int64]]] = field(default_factory=dict)

    def share(self, part: SurfacePart, xyz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Take vertices on a part's outer edge: those that a neighbour has become the neighbour's."""
        if part.row != self.row:
            self._above = self._here if part.row == self.row + 1 else {}
            self._here, self.row = {}, part.row
        numbers = np.full(len(xyz), -1, np.int64)
        neighbours = [self._above.get(part.column + k) for k in (-1, 0, 1)] + [self._here.get(part.column - 1)]
        known = [n for n in neighbours if n is not None]
        if known and len(xyz):
            theirs = np.concatenate([n[0] for n in known])
            distance, nearest = cKDTree(theirs / _BORDER_SCALE).query(xyz / _BORDER_SCALE, distance_upper_bound=1.5)
            same = np.isfinite(distance)
            xyz = xyz.copy()
            xyz[same] = theirs[nearest[same]]
            numbers[same] = np.concatenate([n[1] for n in known])[nearest[same]]
        new = numbers < 0
        numbers[new] = self.count + np.arange(np.count_nonzero(new))
        self.count += int(np.count_nonzero(new))
        self._here[part.column] = (xyz, numbers)
        return xyz, numbers


def build_mesh(part: SurfacePart, front: Front) -> PartMesh:
    """Number the vertices of a part, and give those on its outer edge to the front."""
    rows, columns = (n - 1 for n in part.heights.shape)
    y, x = np.mgrid[: rows + 1, : columns + 1]
    posts = np.stack(
        [part.origin[0] + x * part.mesh[0], part.origin[1] - y * part.mesh[1], part.heights], axis=-1
    ).reshape(-1, 3)
    whole = np.isfinite(_corner_heights(part.heights)).all(axis=-1).ravel()
    more, triangles = np.empty((0, 3)), np.empty((0, 3), np.int64)
    if part.faces is not None:
        whole &= np.diff(part.faces.start) == 0
        more, triangles = _own_triangles(part, posts)
    xyz = np.concatenate([posts, more])
    shared = np.full(len(xyz) + rows * columns, -1, np.int64)
    edge = np.flatnonzero(_on_edge(part, xyz) & np.isfinite(xyz[:, 2]))
    xyz[edge], shared[edge] = front.share(part, xyz[edge])
    corners = _corner_heights(xyz[: len(posts), 2].reshape(rows + 1, columns + 1))
    middles = np.stack(
        [
            part.origin[0] + (x[:-1, :-1] + 0.5) * part.mesh[0],
            part.origin[1] - (y[:-1, :-1] + 0.5) * part.mesh[1],
            corners.mean(axis=-1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    creases = _crease_edges(part.creases, xyz, triangles, len(xyz) + len(middles))
    return PartMesh(
        xyz=np.concatenate([xyz, middles]),
        columns=columns,
        whole=whole,
        triangles=triangles,
        shared=shared,
        creases=creases,
    )


def _corner_heights(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights at the corners of each mesh, shape (rows, columns, 4)."""
    return np.stack([heights[:-1, :-1], heights[:-1, 1:], heights[1:, :-1], heights[1:, 1:]], axis=-1)


def _on_edge(part: SurfacePart, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    xmin, ymin, xmax, ymax = part.bounds
    across = np.minimum(np.abs(xyz[:, 0] - xmin), np.abs(xyz[:, 0] - xmax))
    along = np.minimum(np.abs(xyz[:, 1] - ymin), np.abs(xyz[:, 1] - ymax))
    return np.minimum(across, along) <= SAME_PLACE


def _own_triangles(part: SurfacePart, posts: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices of a part's triangles that are no posts, and the triangles by the numbers of both."""
    assert part.faces is not None
    used, corners = np.unique(part.faces.corners, return_inverse=True)
    xyz = part.faces.vertices[used]
    rows, columns = part.heights.shape
    col = np.rint((xyz[:, 0] - part.origin[0]) / part.mesh[0]).astype(np.int64)
    row = np.rint((part.origin[1] - xyz[:, 1]) / part.mesh[1]).astype(np.int64)
    inside = (col >= 0) & (col < columns) & (row >= 0) & (row < rows)
    post = np.where(inside, row * columns + col, 0)
    is_post = inside & (np.abs(xyz - posts[post]) <= _SCALE).all(axis=1)
    others = np.flatnonzero(~is_post)
    label, first = _joined(xyz[others])
    numbers = post.copy()
    numbers[others] = len(posts) + label
    triangles = numbers[corners.reshape(-1, 3)]
    a, b, c = triangles.T
    return xyz[others][first], triangles[(a != b) & (b != c) & (c != a)]


def _joined(xyz: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of vertices (n, 3) when those at one place are one, and the first vertex of each number."""
    n = len(xyz)
    if not n:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    pairs = cKDTree(xyz / _SCALE).query_pairs(1.0, output_type="ndarray")
    if not len(pairs):
        return np.arange(n), np.arange(n)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n, n))
    label = connected_components(graph, directed=False)[1].astype(np.int64)
    return label, np.unique(label, return_index=True)[1]


def _crease_edges(
    lines: Sequence[NDArray[np.float64]], xyz: NDArray[np.float64], triangles: NDArray[np.int64], count: int
) -> NDArray[np.int64]:
    """Edges of triangles on breaklines, as lower · count + higher vertex, sorted."""
    if not len(lines) or not len(triangles):
        return np.empty(0, np.int64)
    used = np.unique(triangles)
    tree = cKDTree(xyz[used, :2])
    keys = []
    for line in lines:
        near = [used[found] for found in tree.query_ball_point(line, ON_LINE)]
        for a, b in pairwise(near):
            keys += [min(i, j) * count + max(i, j) for i in a for j in b if i != j]
    return np.unique(np.array(keys, np.int64))

"""Contour lines: tracing, smoothing, labels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.contour import count_segments, cross_edges, fill_segments, link_segments, smooth_line, thin_line
from photoplan.surfaces.raster import HeightGrid
from photoplan.surfaces.units import LineElement, MeshFaces, Unit, UnitSource
from photoplan.terrain.shading import ContourOptions

Bounds = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax, metres."""


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """A piece of terrain: posts on a grid whose meshes may be oblong, and triangles where a mesh has its own.

    Parts form a chessboard; a neighbour on the right has the next column, one below the next row. On the edge that two
    parts share both must have the same vertices, to 1e-6 m in position and 2e-4 m in height.
    """

    column: int
    row: int
    origin: tuple[float, float]
    """X, Y of the upper-left post, metres."""
    mesh: tuple[float, float]
    """Mesh width in X and in Y, metres, both positive; rows run from north to south."""
    heights: NDArray[np.float64]
    """Posts, shape (rows + 1, columns + 1), metres; a mesh with a NaN corner is empty, unless it has triangles."""
    faces: MeshFaces | None = None
    """Triangles of the meshes that are not bilinear; None: all are."""
    creases: Sequence[NDArray[np.float64]] = ()
    """Breaklines, X, Y of shape (n, 2), whose edges are edges of `faces`: a contour bends sharply there."""

    def __post_init__(self) -> None:
        if self.heights.ndim != 2 or min(self.heights.shape) < 2 or min(self.mesh) <= 0:
            raise InputError(
                f"part {self.column}, {self.row} of a terrain: {self.heights.shape} posts, mesh {self.mesh}; at least "
                "2 × 2 posts and positive mesh widths are needed"
            )

    @property
    def bounds(self) -> Bounds:
        """Its outer posts."""
        rows, columns = (n - 1 for n in self.heights.shape)
        left, top = self.origin
        return left, top - rows * self.mesh[1], left + columns * self.mesh[0], top

    def cropped(self, bounds: Bounds | None) -> SurfacePart | None:
        """The meshes that touch `bounds`; None if there are none."""
        if bounds is None:
            return self
        xmin, ymin, xmax, ymax = bounds
        rows, columns = (n - 1 for n in self.heights.shape)
        col0 = max(0, math.floor((xmin - self.origin[0]) / self.mesh[0]))
        col1 = min(columns, math.ceil((xmax - self.origin[0]) / self.mesh[0]))
        row0 = max(0, math.floor((self.origin[1] - ymax) / self.mesh[1]))
        row1 = min(rows, math.ceil((self.origin[1] - ymin) / self.mesh[1]))
        if col0 >= col1 or row0 >= row1:
            return None
        if (col0, row0, col1, row1) == (0, 0, columns, rows):
            return self
        keep = np.zeros((rows, columns), bool)
        keep[row0:row1, col0:col1] = True
        return replace(
            self,
            origin=(self.origin[0] + col0 * self.mesh[0], self.origin[1] - row0 * self.mesh[1]),
            heights=self.heights[row0 : row1 + 1, col0 : col1 + 1],
            faces=None if self.faces is None else _kept_faces(self.faces, keep.ravel()),
        )


def _kept_faces(faces: MeshFaces, keep: NDArray[np.bool_]) -> MeshFaces:
    """The triangles of some of the meshes."""
    counts = np.diff(faces.start)
    corners = faces.corners[np.repeat(keep, counts)]
    start = np.concatenate([[0], np.cumsum(counts[keep])])
    return MeshFaces(faces.vertices, faces.sigmas, corners, start)


def unit_parts(
    source: UnitSource, bounds: Bounds | None = None, lines: Callable[[Bounds], Sequence[LineElement]] | None = None
) -> Iterator[SurfacePart]:
    """The units of a hybrid model, row by row from the north."""
    layout = source.layout
    for row in range(layout.rows):
        for column in range(layout.columns):
            left, top = layout.corner(column, row)
            around = left, top - layout.side, left + layout.side, top
            if bounds is not None and not _touch(around, bounds):
                continue
            unit = source.unit(column, row)
            if unit is None:
                continue
            part = _unit_part(unit, column, row, lines(around) if lines is not None and unit.faces else ())
            part_in = part.cropped(bounds)
            if part_in is not None:
                yield part_in


def _touch(a: Bounds, b: Bounds) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _unit_part(unit: Unit, column: int, row: int, lines: Sequence[LineElement]) -> SurfacePart:
    return SurfacePart(
        column=column,
        row=row,
        origin=(unit.left, unit.top),
        mesh=(unit.width, unit.width),
        heights=unit.heights.astype(float) + unit.datum,
        faces=unit.faces,
        creases=tuple(line.xyz[:, :2] for line in lines if line.kind == "breakline"),
    )


def grid_parts(
    grid: HeightGrid,
    origin: tuple[float, float],
    mesh: tuple[float, float],
    bounds: Bounds | None = None,
    side: int = 512,
) -> Iterator[SurfacePart]:
    """Pieces of a height grid, row by row from the north."""
    columns, rows = grid.size
    for row in range(-(-(rows - 1) // side)):
        for column in range(-(-(columns - 1) // side)):
            window = Window(column * side, row * side, side + 1, side + 1) & Window(0, 0, columns, rows)
            corner = origin[0] + window.col * mesh[0], origin[1] - window.row * mesh[1]
            around = corner[0], corner[1] - window.height * mesh[1], corner[0] + window.width * mesh[0], corner[1]
            if bounds is not None and not _touch(around, bounds):
                continue
            part = SurfacePart(
                column=column, row=row, origin=corner, mesh=mesh, heights=grid.read(window).astype(float)
            ).cropped(bounds)
            if part is not None:
                yield part


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
        """Return how a bilinear surface departs from the straight line along edges (m, 2), shape (m,), metres.

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
        """Return whether edges (m, 2), lower vertex first, lie on a breakline; shape (m,)."""
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


#: More pieces in one part mean an interval far below what the heights say.
MOST_PIECES = 30_000_000
#: Rounds of smoothing; the waves that it takes out are some vertices long.
PASSES = 20
#: Part of what is left of a band beside a line in which it is simplified: so that smooth lines stay smooth.
THIN = 0.2
Key = tuple[int, int, int]
"""Two vertex numbers of an edge in the whole terrain, and the level that crosses it."""
Ends = dict[Key, "Chain"]


@dataclass(frozen=True, eq=False)
class ContourLine:
    """One contour."""

    height: float
    """Metres."""
    xy: NDArray[np.float64]
    """Vertices, shape (n, 2), metres; of a closed line the last is the first. Higher ground is on the right."""
    index: bool
    """It is an index contour."""

    @property
    def closed(self) -> bool:
        """It is a ring."""
        return len(self.xy) > 3 and bool((self.xy[0] == self.xy[-1]).all())

    @property
    def depression(self) -> bool:
        """It is a ring round lower ground."""
        if not self.closed:
            return False
        x, y = (self.xy - self.xy[0]).T
        return bool(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0)

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.hypot(*np.diff(self.xy, axis=0).T).sum())


def trace_contours(parts: Iterable[SurfacePart], options: ContourOptions) -> Iterator[ContourLine]:
    """Contours of a terrain that comes in parts; a line is given as soon as nothing can continue it.

    Time grows linearly with the meshes and with the lines' vertices; memory holds one part and the lines that the
    present row of parts has open.
    """
    front, joiner = Front(), Joiner()
    shortest = options.shortest
    for part in parts:
        if part.row != joiner.row:
            yield from _lines(joiner.next_row(part.row), options, shortest)
        # Round a top exactly at a level runs a ring that only keeps off the post: nobody wants to see it.
        shortest = max(options.shortest, min(1e-3 * min(part.mesh), 0.01))
        done = (joiner.add(chain) for chain in _chains(build_mesh(part, front), options))
        yield from _lines((chain for chain in done if chain is not None), options, shortest)
    yield from _lines(joiner.finish(), options, shortest)


def _chains(mesh: PartMesh, options: ContourOptions) -> list[Chain]:
    """Contours of one part, from edge to edge."""
    # The millionth part lets 0.3 be three times 0.1. Missing heights are in no triangle: their rank does not matter.
    quotient = np.nan_to_num((mesh.xyz[:, 2] - options.base) / options.interval, nan=0.0)
    ranks = np.floor(quotient + 1e-9).astype(np.int64)
    count = count_segments(ranks, mesh.columns, mesh.whole, mesh.triangles)
    if count > MOST_PIECES:
        raise UsageError(
            f"contours every {options.interval} m give {count} pieces of lines in one part of the terrain (of heights "
            f"{np.nanmin(mesh.xyz[:, 2]):.2f} to {np.nanmax(mesh.xyz[:, 2]):.2f} m); choose a larger interval"
        )
    if count == 0:
        return []
    pieces = np.empty((count, 5), np.int64)
    fill_segments(ranks, mesh.columns, mesh.whole, mesh.triangles, pieces)
    order, ends = np.empty(count, np.int64), np.empty((count, 2), np.int64)
    chains = link_segments(_followers(pieces, len(mesh.xyz)), order, ends)
    pieces, ends = pieces[order], ends[:chains]
    places = _places(mesh, options, pieces[:, :2], pieces[:, 4])
    opened = ends[ends[:, 1] == 0, 0]
    last = _places(mesh, options, pieces[opened - 1, 2:4], pieces[opened - 1, 4])
    found = []
    start = 0
    for i, (stop, closed) in enumerate(ends.tolist()):
        level = int(pieces[start, 4])
        if closed:
            found.append(Chain(level=level, pieces=deque([places[start:stop]]), start=None, end=None, closed=True))
        else:
            line = np.concatenate([places[start:stop], last[i : i + 1]])
            keys = _key(mesh, pieces[start, :2], level), _key(mesh, pieces[stop - 1, 2:4], level)
            found.append(Chain(level, deque([line]), *keys))
        start = stop
    return found


def _followers(pieces: NDArray[np.int64], vertices: int) -> NDArray[np.int64]:
    """For each piece the one that begins where it ends, -1 if there is none."""
    levels = pieces[:, 4] - pieces[:, 4].min()
    span = int(levels.max()) + 1
    starts = (pieces[:, 0] * vertices + pieces[:, 1]) * span + levels
    stops = (pieces[:, 2] * vertices + pieces[:, 3]) * span + levels
    order = np.argsort(starts, kind="stable")
    ordered = starts[order]
    at = np.minimum(np.searchsorted(ordered, stops), len(order) - 1)
    return np.where(ordered[at] == stops, order[at], -1)


def _places(
    mesh: PartMesh, options: ContourOptions, edges: NDArray[np.int64], levels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Crossings and their ranges, shape (n, 6)."""
    places = np.empty((len(edges), 6))
    heights = options.base + levels * options.interval
    band = options.band * options.interval if options.smooth or options.simplify else 0.0
    edges = np.ascontiguousarray(edges)
    cross_edges(mesh.xyz, mesh.bends(edges), edges, heights, band, mesh.on_crease(edges), places)
    return places


def _key(mesh: PartMesh, edge: NDArray[np.int64], level: int) -> tuple[int, int, int] | None:
    """The edge's name in the whole terrain; None: no other part has it."""
    a, b = sorted(mesh.shared[edge].tolist())
    return None if a < 0 else (a, b, level)


def _lines(chains: Iterable[Chain], options: ContourOptions, shortest: float) -> Iterator[ContourLine]:
    """Whole lines, smoothed and simplified as wanted."""
    for chain in chains:
        places = chain.places()
        if _length(places, chain.closed) < shortest:
            continue
        if options.smooth:
            smooth_line(places, chain.closed, PASSES)
        if options.simplify and len(places) > 3:
            keep = np.empty(len(places), np.bool_)
            near = places.copy()
            for ends in (slice(2, 4), slice(4, 6)):
                near[:, ends] = places[:, :2] + THIN * (places[:, ends] - places[:, :2])
            if thin_line(near, chain.closed, keep) >= (3 if chain.closed else 2):
                places = places[keep]
        xy = np.ascontiguousarray(places[:, :2])
        if chain.closed:
            xy = np.concatenate([xy, xy[:1]])
        apart = np.append(True, (xy[1:] != xy[:-1]).any(axis=1))
        height = options.base + chain.level * options.interval
        yield ContourLine(height, xy[apart], options.index > 0 and chain.level % options.index == 0)


def _length(places: NDArray[np.float64], closed: bool) -> float:
    steps = np.diff(places[:, :2], axis=0, append=places[:1, :2] if closed else np.empty((0, 2)))
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


@dataclass(eq=False)
class Chain:
    """A piece of a contour, and where it may go on."""

    level: int
    pieces: deque[NDArray[np.float64]]
    """Vertices with their ranges, shapes (n, 6); the first of a piece is the last of the one before it."""
    start: Key | None
    """Edge of a part where the chain begins; None: it begins at a border or a wall, or is closed."""
    end: Key | None
    closed: bool = False

    def places(self) -> NDArray[np.float64]:
        """Vertices with their ranges, shape (n, 6), each once; a closed line's last vertex is followed by its first."""
        pieces = list(self.pieces)
        joined = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
        # Where pieces were joined to a ring, its first vertex stands at the end too.
        return joined[:-1] if self.closed and len(pieces) > 1 else joined


@dataclass(eq=False)
class Joiner:
    """Puts chains together by the edges that they share, row of parts by row of parts."""

    row: int = -1
    _starts: tuple[Ends, Ends] = field(default_factory=lambda: ({}, {}))
    """Chains by the edge where they begin: of the row before, and of this row."""
    _ends: tuple[Ends, Ends] = field(default_factory=lambda: ({}, {}))

    def add(self, chain: Chain) -> Chain | None:
        """Take a chain of the present row; returns it, or what it has completed, if nothing can follow any more."""
        if chain.start is not None:
            before = _pop(self._ends, chain.start)
            if before is not None:
                chain = self._append(before, chain)
        if chain.end is not None:
            after = _pop(self._starts, chain.end)
            if after is chain:
                chain.start, chain.end, chain.closed = None, None, True
            elif after is not None:
                chain = self._append(chain, after)
        if chain.start is None and chain.end is None:
            return chain
        # A chain that was known keeps its older end in the table of its row.
        if chain.start is not None and chain.start not in self._starts[0]:
            self._starts[1][chain.start] = chain
        if chain.end is not None and chain.end not in self._ends[0]:
            self._ends[1][chain.end] = chain
        return None

    def next_row(self, row: int) -> Iterator[Chain]:
        """Begin a row of parts; gives the chains that no part can continue any more."""
        while self.row < row and any((*self._starts, *self._ends)):
            for key, chain in self._starts[0].items():
                assert chain.start == key
                chain.start = None
                if chain.end is None:
                    yield chain
            for key, chain in self._ends[0].items():
                assert chain.end == key
                chain.end = None
                if chain.start is None:
                    yield chain
            self._starts, self._ends = (self._starts[1], {}), (self._ends[1], {})
            self.row += 1
        self.row = row

    def finish(self) -> Iterator[Chain]:
        """All that is left."""
        yield from self.next_row(self.row + 2)

    def _append(self, first: Chain, second: Chain) -> Chain:
        """One chain of two; the shorter list of pieces goes into the longer one."""
        if len(first.pieces) >= len(second.pieces):
            first.pieces.extend(second.pieces)
            kept, first.end = first, second.end
            if kept.end is not None:
                _replace(self._ends, kept.end, kept)
        else:
            second.pieces.extendleft(reversed(first.pieces))
            kept, second.start = second, first.start
            if kept.start is not None:
                _replace(self._starts, kept.start, kept)
        return kept


def _pop(tables: tuple[Ends, Ends], key: Key) -> Chain | None:
    return tables[1].pop(key, None) or tables[0].pop(key, None)


def _replace(tables: tuple[Ends, Ends], key: Key, chain: Chain) -> None:
    for table in tables:
        if key in table:
            table[key] = chain


#: Width of a digit as a part of the text's height, and what is kept free on either side of the text.
DIGIT, FREE = 0.62, 0.5
#: Steps along a text in which the line is looked at.
STEPS = 8
#: The line may depart from the text's axis by this part of the text's height.
STRAIGHT = 0.35


@dataclass(frozen=True)
class ContourLabel:
    """Text on a contour."""

    X: float
    """Middle of the text, metres."""
    Y: float
    height: float
    """Height of its contour, metres."""
    angle: float
    """Direction of the text, degrees counter-clockwise from east, above -180 to 180; its top is uphill."""
    text: str


def decimals_of(interval: float, base: float = 0.0) -> int:
    """Decimals that tell contours apart: those of the interval and the base, at most six."""
    for digits in range(6):
        if all(abs(round(value, digits) - value) < 1e-9 * max(1.0, abs(value)) for value in (interval, base)):
            return digits
    return 6


@dataclass(eq=False)
class Labeller:
    """Finds places for labels, line by line, and keeps those already taken free."""

    size: float
    """Height of the text, metres on the ground."""
    spacing: float
    """Distance of labels along a line, metres; a shorter line has one, if there is a straight part."""
    decimals: int = 0
    _taken: dict[tuple[int, int], list[tuple[float, float, float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.size) and self.size > 0 and self.spacing > 0):
            raise UsageError(f"labels {self.size} m high every {self.spacing} m; positive numbers are needed")

    def place(self, line: ContourLine) -> list[ContourLabel]:
        """Labels of one line; empty if it is short, crooked, or there is no room."""
        text = f"{line.height:.{self.decimals}f}"
        text = text.lstrip("-") if float(text) == 0 else text
        width = self.size * (DIGIT * len(text) + FREE)
        points = _evenly(line.xy, width / STEPS)
        if len(points) <= STEPS:
            return []
        bent, chord = _straightness(points)
        good = (bent <= STRAIGHT * self.size) & (np.hypot(*chord.T) >= 0.9 * width)
        radius = 0.5 * math.hypot(width, self.size)
        count = max(1, int((len(points) - 1) * width / STEPS / self.spacing))
        found = []
        for part in np.array_split(np.arange(len(bent)), count):
            for at in self._candidates(part, good, bent):
                X, Y = (points[at] + points[at + STEPS]) / 2
                if self._take(float(X), float(Y), radius):
                    # Higher ground is right of the line: read backwards, it is above the text.
                    angle = math.degrees(math.atan2(-chord[at, 1], -chord[at, 0]))
                    found.append(
                        ContourLabel(
                            X=float(X),
                            Y=float(Y),
                            height=line.height,
                            angle=180.0 if angle == -180 else angle,
                            text=text,
                        )
                    )
                    break
        return found

    @staticmethod
    def _candidates(part: NDArray[np.int64], good: NDArray[np.bool_], bent: NDArray[np.float64]) -> Sequence[int]:
        """Places of one stretch worth trying: the straightest ones, those in its middle first."""
        part = part[good[part]]
        if not len(part):
            return []
        rank = np.rint(4 * bent[part] / max(float(bent[part].max()), 1e-12))
        order = np.lexsort((np.abs(part - part.mean()), rank))
        return [int(i) for i in part[order[:: max(1, len(order) // 12)]]]

    def _take(self, X: float, Y: float, radius: float) -> bool:
        """Return whether a disc is free; if so it is taken."""
        # Texts are at most two dozen digits long; in cells of that size only neighbours can touch.
        cell = 16 * self.size
        column, row = math.floor(X / cell), math.floor(Y / cell)
        for j in (row - 1, row, row + 1):
            for i in (column - 1, column, column + 1):
                for x, y, r in self._taken.get((i, j), ()):
                    if math.hypot(x - X, y - Y) < r + radius:
                        return False
        self._taken.setdefault((column, row), []).append((X, Y, radius))
        return True


def _evenly(xy: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Points along a line at equal distances, shape (n, 2)."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    at = np.arange(0.0, along[-1], step)
    return np.column_stack([np.interp(at, along, xy[:, k]) for k in range(2)])


def _straightness(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest distance of points from the chord over `STEPS` steps, shape (n,), and the chords, shape (n, 2)."""
    chord = points[STEPS:] - points[:-STEPS]
    size = np.maximum(np.hypot(*chord.T), 1e-12)
    bent = np.zeros(len(chord))
    for k in range(1, STEPS):
        off = points[k : k + len(chord)] - points[:-STEPS]
        bent = np.maximum(bent, np.abs(chord[:, 0] * off[:, 1] - chord[:, 1] * off[:, 0]) / size)
    return bent, chord

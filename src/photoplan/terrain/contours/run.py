"""Contour lines of a terrain model, on its own surface.

The lines are traced in triangles: those of meshes with line elements as they are, and four in every bilinear mesh,
round its centre, whose height is the mean of the posts. Vertices of lines lie exactly on the bilinear surface, on the
edges of these triangles; between them the chord departs from the surface's hyperbola by at most a sixteenth of the
mesh's twist (z_nw − z_ne − z_sw + z_se) in height.

Higher ground is on a line's right, as `gdal_contour` has it: a line runs clockwise round a top, counter-clockwise round
a hollow. A post exactly at a level counts as above it; lines pass it at a distance that changes the height by 5e-7 m,
so that they stay apart from each other and have no gaps or forks. Lines end at borders and at two-sided breaklines and
bend where triangles meet, so sharply at breaklines.

Contours may be smoothed and thinned inside bands: a vertex moves along the edge it lies on as long as the surface's
height there differs from the level by less than `band` times the interval, less than half of it. The bands of two
levels on one edge have nothing in common, so the order of lines along every edge stays, and two lines never cross.
Where a line passes a breakline, or ends, it stays where it is.

Pieces become whole lines from part to part, with no more in memory than the sweep has open.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.kernels.contour import count_segments, cross_edges, fill_segments, link_segments, smooth_line, thin_line
from photoplan.terrain.contours.mesh import Front, PartMesh, build_mesh
from photoplan.terrain.contours.parts import SurfacePart
from photoplan.terrain.options import ContourOptions

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

"""Surfaces and terrain in general: rays, lattices, levels, columns."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.rays import (
    ABOVE,
    ASK,
    BELOW,
    LEFT,
    MISS,
    NONE,
    OVER,
    Columns,
    Faces,
    Pyramid,
    ShownGround,
    VerticalPlanes,
    begin_lines,
    end_lines,
    follow_columns,
    follow_unit,
    next_unit,
    pyramid_of,
    set_column_slopes,
)
from photoplan.targets.map import MapTarget, Target

#: Bytes of parts, with their pyramids, that are kept for the next rays, if all are as large as the last one.
CACHE = 128 << 20
#: Pieces of rays in another CRS, or where heights are shifted, are halved until their middles are no further than this
#: from where the rays are, metres …
STRAIGHT = 1e-3
#: … or there are so many of them.
MOST_CHORDS = 1024
#: How far before a place ground is looked for, metres, to tell a wall from the border of a hole.
_BEFORE = 1e-6

NO_FACES: Faces = (np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.int64), (0.0, 0.0, 1.0, 0))


@dataclass(frozen=True, eq=False)
class Hits:
    """First intersections of rays with the ground."""

    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres; NaN where a ray meets no ground."""
    along: NDArray[np.float64]
    """Piece of the path plus part of it, 0 to k − 1, shape (n,); NaN where a ray meets no ground."""
    result: NDArray[np.int64]
    """`kernels.rays.MISS`, `SURFACE` or `WALL`, shape (n,)."""
    below: NDArray[np.bool_]
    """True where a ray that met nothing ended below the ground: it started there, or went there through a hole."""
    normal: NDArray[np.float64]
    """Unit normals of what is met, shape (n, 3): of the ground upwards, of walls and objects towards where the ray
    comes from; NaN where a ray meets nothing. A shift of heights does not count."""
    owner: NDArray[np.int64]
    """Number of what is met, shape (n,): 0 for the ground, else of an object, from one; −1 if a ray meets nothing."""

    @classmethod
    def none(cls, n: int) -> Hits:
        """Rays that meet nothing."""
        return cls(
            XYZ=np.full((n, 3), np.nan),
            along=np.full(n, np.nan),
            result=np.full(n, MISS),
            below=np.zeros(n, bool),
            normal=np.full((n, 3), np.nan),
            owner=np.full(n, -1),
        )


@dataclass(frozen=True, eq=False)
class TerrainPart:
    """Posts of a part of the terrain, ready for rays."""

    corner: tuple[float, float]
    """X, Y of the upper-left post."""
    mesh: tuple[float, float]
    """Distance of the posts in X and in Y, metres."""
    posts: NDArray[np.float32]
    """Above the datum, shape (rows, cols), metres."""
    datum: float = 0.0
    faces: Faces = NO_FACES
    pyramid: Pyramid = field(init=False, repr=False)

    def __post_init__(self) -> None:
        faces = self.faces[:3] if len(self.faces[2]) else ()
        object.__setattr__(self, "posts", np.ascontiguousarray(self.posts, np.float32))
        object.__setattr__(self, "pyramid", pyramid_of(self.posts, *faces))

    @property
    def bytes(self) -> int:
        """Memory that it takes, nearly."""
        return 4 * self.posts.nbytes + self.faces[0].nbytes + self.faces[1].nbytes + self.faces[2].nbytes


Cache = OrderedDict[tuple[int, int], "TerrainPart | None"]
"""Parts that were used last. Threads may share one: two that want one part at once both make it."""
Carry = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class TerrainParts(Protocol):
    """Terrain in rectangular parts, row by row from north to south."""

    @property
    def corner(self) -> tuple[float, float]:
        """X, Y of the upper-left corner of the first part."""
        ...

    @property
    def step(self) -> tuple[float, float]:
        """Width and height of a part, metres."""
        ...

    @property
    def inside(self) -> tuple[float, float, float, float]:
        """Map bounds beyond which there is no ground."""
        ...

    def ranges(self, window: Window) -> NDArray[np.float64]:
        """Bounds of the parts of a window, shape (height, width, 2): NaN: no ground, infinite: not known yet."""
        ...

    def range(self, column: int, row: int) -> NDArray[np.float64]:
        """Bounds of a part, found out now if they were not known, shape (2,): NaN: no ground."""
        ...

    def part(self, column: int, row: int) -> TerrainPart | None:
        """A part; None if it has no ground."""
        ...

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at map points (..., 2), shape (...)."""
        ...


def chords(paths: NDArray[np.float64], bend: float, carry: Carry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Paths cut into pieces so short that in other coordinates they are straight, to a quarter of `STRAIGHT`."""
    # What a metre to the east and one to the north are there.
    corner = carry(paths[:, :1])
    metres = np.stack([(carry(paths[:, :1] + step) - corner)[:, 0, :2] for step in np.eye(3)[:2]], axis=-1)
    there = np.isfinite(metres).all(axis=(1, 2))
    times = 2
    while True:
        part = np.arange(times)[:, None] / times
        inner = paths[:, :-1, None] + part * np.diff(paths, axis=1)[:, :, None]
        fine = bent(np.concatenate([inner.reshape(len(paths), -1, 3), paths[:, -1:]], axis=1), bend)
        carried = carry(fine)
        off = (carried[there, 1::2] - (carried[there, :-1:2] + carried[there, 2::2]) / 2).swapaxes(1, 2)
        off[:, :2] = np.linalg.solve(metres[there], off[:, :2])
        # Twice as many chords have a fourth of the error of those that were measured at their middles.
        if np.nanmax(np.linalg.norm(off, axis=1), initial=0.0) <= STRAIGHT or times >= MOST_CHORDS:
            return fine, carried
        times *= 2


def bent(paths: NDArray[np.float64], bend: float) -> NDArray[np.float64]:
    """Paths (n, k, 3) whose points are raised by `bend` per squared distance from the first one."""
    away = np.linalg.norm(np.diff(paths[..., :2], axis=1), axis=-1).cumsum(axis=1)
    out = paths.copy()
    out[:, 1:, 2] += bend * away**2
    return out


def follow(parts: TerrainParts, paths: ArrayLike, bend: float = 0.0, cache: Cache | None = None) -> Hits:
    """First hits of rays over terrain in parts, with parts that are kept from the last time; see
    `Terrain.first_hit`.
    """
    at = np.asarray(paths, float)
    if at.ndim != 3 or at.shape[1] < 2 or at.shape[2] != 3:
        raise UsageError(f"paths of shape {at.shape}; n paths of two points X, Y, Z or more are needed (n, k, 3)")
    n = len(at)
    hits = Hits.none(n)
    states, away = np.full(n, NONE), np.zeros(n)
    lines, rays, spans = np.empty((n, 7)), np.empty((n, 10)), np.empty((n, 2))
    frame, cache = (*parts.corner, *parts.step), OrderedDict() if cache is None else cache
    for piece in range(at.shape[1] - 1):
        met = hits.result != MISS
        if piece and met.all():
            break
        # Of long paths only two points are near each other in memory.
        ends = np.ascontiguousarray(at[:, piece : piece + 2])
        box = begin_lines(ends, 0, bend, parts.inside, frame, away, hits.result, states, lines, rays, spans)
        if box[0] <= box[2]:
            which = np.flatnonzero(spans[:, 1] >= 0)
            over_parts(parts, box, which, _Rays(parts=parts, lines=lines, rays=rays, states=states, hits=hits), cache)
        end_lines(ends, 0, bend, away, rays, spans, hits.result, states, hits.XYZ, hits.along, hits.normal)
        hits.along[(hits.result != MISS) & ~met] += piece
    hits.below[:] = (hits.result == MISS) & (states == BELOW)
    hits.owner[hits.result != MISS] = 0
    return hits


def carried_hits(
    parts: TerrainParts, paths: NDArray[np.float64], carry: Carry | None, bend: float, cache: Cache | None = None
) -> Hits:
    """First hits of rays over parts that lie in another CRS, to which `carry` takes map points; None: in the same."""
    if carry is None:
        return follow(parts, paths, bend, cache)
    fine, carried = chords(paths, bend, lambda XYZ: np.concatenate([carry(XYZ[..., :2]), XYZ[..., 2:]], axis=-1))
    hits = follow(parts, carried, cache=cache)
    there = np.flatnonzero(np.isfinite(hits.along))
    piece = np.minimum(hits.along[there].astype(int), fine.shape[1] - 2)
    a, b = fine[there, piece], fine[there, piece + 1]
    with np.errstate(invalid="ignore"):  # what lies on no map is at infinity
        hits.XYZ[there, :2] = (a + (hits.along[there] - piece)[:, None] * (b - a))[:, :2]
    hits.along[there] *= (paths.shape[1] - 1) / (fine.shape[1] - 1)
    if len(there):
        _carry_back(hits, there, carry)
    return hits


def _carry_back(hits: Hits, there: NDArray[np.int64], carry: Carry) -> None:
    """Turn normals from the CRS that `carry` leads to into that of the map."""
    at, n = hits.XYZ[there, :2], hits.normal[there]
    here = carry(at)
    # A plane's gradient by the map is that by the other coordinates times their derivatives by the map.
    turned = [((carry(at + step) - here) * n[:, :2]).sum(axis=1) for step in np.eye(2)]
    n[:, :2] = np.stack(turned, axis=-1)
    hits.normal[there] = n / np.linalg.norm(n, axis=1, keepdims=True)


class Walk(Protocol):
    """Rays that are followed from part to part: lines of `kernels.rays`, each in one part at a time."""

    def next(
        self,
        ranges: tuple[NDArray[np.float64], NDArray[np.float64]],
        first: tuple[int, int],
        which: NDArray[np.int64],
        places: NDArray[np.int64],
    ) -> None:
        """Fill in the part that each of some rays has to be followed over next: see `kernels.rays.next_unit`."""
        ...

    def over(self, part: TerrainPart, group: NDArray[np.int64]) -> None:
        """Follow some rays over a part."""
        ...

    def going(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of some rays still look for ground."""
        ...


@dataclass(frozen=True, eq=False)
class _Rays:
    """One piece of all rays, as far as the first hit: see `kernels.rays`."""

    parts: TerrainParts
    lines: NDArray[np.float64]
    rays: NDArray[np.float64]
    states: NDArray[np.int64]
    hits: Hits

    def next(
        self,
        ranges: tuple[NDArray[np.float64], NDArray[np.float64]],
        first: tuple[int, int],
        which: NDArray[np.int64],
        places: NDArray[np.int64],
    ) -> None:
        next_unit(*ranges, first, self.rays, self.states, which, places)

    def over(self, part: TerrainPart, group: NDArray[np.int64]) -> None:
        hits, states = self.hits, self.states
        asks = follow_unit(part.posts, part.pyramid, part.faces, (*part.corner, *part.mesh, part.datum),
                           self.lines, self.rays, states, hits.result, hits.normal, group)  # fmt: skip
        if asks:
            asking = group[hits.result[group] == ASK]
            states[asking] = _before(self.parts, self.lines[asking], self.rays[asking, 7])
            hits.result[asking] = MISS

    def going(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray(self.hits.result[which] == MISS)


def over_parts(
    parts: TerrainParts, box: tuple[float, float, float, float], which: NDArray[np.int64], walk: Walk, cache: Cache
) -> None:
    """Follow rays from part to part inside lowest x, y and highest x, y, counted in parts; parts may be kept."""
    window = _window(parts, box)
    ranges, first = parts.ranges(window), (window.col, window.row)
    low, high = (np.array(ranges[..., j], order="C") for j in (0, 1))
    low[np.isnan(low)], high[np.isnan(high)] = np.inf, -np.inf
    while len(which):
        places = np.empty(len(which), np.int64)
        walk.next((low, high), first, which, places)
        for group, place in _groups(which, places):
            row, column = divmod(place, window.width)
            at = column + window.col, row + window.row
            if np.isinf(low[row, column]):
                # Only then it is known whether the rays have to go there.
                found = parts.range(*at)
                low[row, column], high[row, column] = (np.inf, -np.inf) if np.isnan(found[0]) else found
                continue
            part = _kept(parts, at, cache)
            if part is None:
                low[row, column], high[row, column] = np.inf, -np.inf
                continue
            walk.over(part, group)
        which = which[(places >= 0) & walk.going(which)]


def _window(parts: TerrainParts, box: tuple[float, float, float, float]) -> Window:
    """The parts that rays between lowest x, y and highest x, y, counted in parts, may touch."""
    columns = round((parts.inside[2] - parts.corner[0]) / parts.step[0] + 0.4999999)
    rows = round((parts.corner[1] - parts.inside[1]) / parts.step[1] + 0.4999999)
    ends = np.clip(np.floor(box), 0, (columns - 1, rows - 1) * 2).astype(int)
    left, top, right, bottom = ends.tolist()
    return Window(left, top, right - left + 1, bottom - top + 1)


def _groups(which: NDArray[np.int64], places: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], int]]:
    """Rays that are in one part, part by part; −1: in none."""
    order = np.argsort(places, kind="stable")
    ordered = places[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))
    for start, end in zip(starts, [*starts[1:], len(order)]):
        yield which[order[start:end]], int(ordered[start])


def _kept(parts: TerrainParts, at: tuple[int, int], cache: Cache) -> TerrainPart | None:
    """A part, from the cache if it is there; parts used longest ago are forgotten."""
    with suppress(KeyError):
        cache.move_to_end(at)
        return cache[at]
    part = cache[at] = parts.part(*at)
    while part is not None and len(cache) > max(1, CACHE // part.bytes):
        with suppress(KeyError):
            cache.popitem(last=False)
    return part


def _before(parts: TerrainParts, lines: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return whether there was ground just before the places at t: the state of rays that are below ground there."""
    back = lines[:, 3:5] / (np.hypot(lines[:, 3], lines[:, 4])[:, None] + 1e-300) * _BEFORE
    ground = parts.heights(lines[:, :2] + t[:, None] * lines[:, 3:5] - back)
    return np.where(np.isfinite(ground), ABOVE, NONE)


class _Relief(Protocol):
    def relief(self, target: Target, window: Window) -> NDArray[np.float32]: ...


@dataclass(frozen=True, eq=False)
class Lattice:
    """A raster of heights, bilinear in between, and where the pixels of a map are in it."""

    origin: NDArray[np.float64]
    """Column and row of the centre of the map's first pixel, shape (2,)."""
    steps: NDArray[np.float64]
    """Steps of a column and a row of the map in its columns and rows, shape (2, 2): origin + steps @ (u, v)."""
    read: Callable[[Window], NDArray[np.float32]]
    """Heights of a window, shape (height, width), metres; NaN where there is none, and beyond the surface."""

    @classmethod
    def of_relief(cls, surface: _Relief, grid: MapGrid, parts: float = 1.0) -> Lattice:
        """Relief of a surface at the pixels of a map, each cut into at least so many parts along a side.

        Their number is odd: the middle one has the centre of the pixel.
        """
        times = max(1, math.ceil(parts)) | 1
        finer = MapTarget(
            MapGrid(left=grid.left, top=grid.top, resolution=grid.resolution / times, width=1, height=1, crs=grid.crs)
        )
        return cls(np.full(2, (times - 1) / 2), times * np.eye(2), lambda window: surface.relief(finer, window))

    @property
    def per_pixel(self) -> float:
        """Posts along a pixel, at most."""
        return float(np.linalg.norm(self.steps, axis=0).max())

    def at(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Column and row of places (..., 2) of the map, given in its pixels."""
        return np.asarray(self.origin + np.asarray(uv, float) @ self.steps.T)

    def to_pixels(self, posts: ArrayLike) -> NDArray[np.float64]:
        """Inverse of `at`."""
        return np.asarray((np.asarray(posts, float) - self.origin) @ np.linalg.inv(self.steps).T)

    def around(self, pixels: Window) -> Window:
        """Posts around all centres of a window of the map."""
        (right, bottom) = (end - 1 for end in pixels.stop)
        corners = self.at([(u, v) for u in (pixels.col, right) for v in (pixels.row, bottom)])
        (col, row), (east, south) = np.floor(corners.min(axis=0)), np.floor(corners.max(axis=0)) + 2
        return Window(int(col), int(row), int(east - col), int(south - row))


class Surface(Protocol):
    """Surface of a product: a depth h for every pixel of a target."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Depth h of every pixel centre of `window`, shape (height, width), metres; NaN where there is no surface."""
        ...


class Terrain(Surface, Protocol):
    """A surface over the map whose heights can be asked for, and that rays can be followed to."""

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...), metres; NaN where there is no surface."""
        ...

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Lower and upper bound of the heights inside map bounds xmin, ymin, xmax, ymax (..., 4), shape (..., 2).

        Never narrower than the surface inside; cheap for many boxes and when asked again. NaN, NaN where there is no
        surface.
        """
        ...

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """Heights that, bilinear in between, are as good as all of them, around a window of a map.

        At best the surface's own posts; else the pixels of the map, cut as finely as the surface needs it.
        """
        ...

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return where rays first come down onto the surface, from above it."""
        ...


@dataclass(frozen=True)
class LevelSurface:
    """The same height everywhere."""

    height: float
    """Metres."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """The height for every pixel of the window, shape (height, width)."""
        return np.full((window.height, window.width), self.height, np.float32)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """The height at map points (..., 2), shape (...)."""
        return np.full(np.asarray(XY).shape[:-1], self.height)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """The height, twice, for map bounds (..., 4)."""
        return np.full((*np.shape(bounds)[:-1], 2), self.height)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """The pixels of the map."""
        return Lattice.of_relief(self, grid)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return where rays first come down to the height; see `Terrain.first_hit`."""
        at = np.asarray(paths, float).reshape(-1, np.shape(paths)[-1])[:, :2]
        low, high = np.fmin.reduce(at, axis=0, initial=np.inf), np.fmax.reduce(at, axis=0, initial=-np.inf)
        if not np.isfinite([low, high]).all():
            low, high = np.zeros(2), np.zeros(2)
        inside = (float(low[0]) - 1, float(low[1]) - 1, float(high[0]) + 1, float(high[1]) + 1)
        return follow(LevelParts(self, inside), paths, bend)


@dataclass(frozen=True)
class LevelParts:
    """A level as one part for rays, a single mesh below all of them."""

    surface: LevelSurface
    inside: tuple[float, float, float, float]
    """Its bounds."""

    @property
    def corner(self) -> tuple[float, float]:
        """X, Y of its upper-left corner."""
        return self.inside[0], self.inside[3]

    @property
    def step(self) -> tuple[float, float]:
        """Its width and height, metres."""
        return self.inside[2] - self.inside[0], self.inside[3] - self.inside[1]

    def ranges(self, window: Window) -> NDArray[np.float64]:
        """The height, twice, shape (height, width, 2)."""
        return np.full((window.height, window.width, 2), self.surface.height)

    def range(self, column: int, row: int) -> NDArray[np.float64]:
        """The height, twice."""
        return np.full(2, self.surface.height)

    def part(self, column: int, row: int) -> TerrainPart:
        """The mesh."""
        return TerrainPart(self.corner, self.step, np.zeros((2, 2), np.float32), self.surface.height)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """The height at points."""
        return self.surface.heights(XY)


@dataclass(frozen=True, eq=False)
class _Columns:
    """The rays of all columns: see `kernels.rays`."""

    fan: VerticalPlanes
    columns: Columns
    shown: ShownGround

    def next(
        self,
        ranges: tuple[NDArray[np.float64], NDArray[np.float64]],
        first: tuple[int, int],
        which: NDArray[np.int64],
        places: NDArray[np.int64],
    ) -> None:
        low, high = ranges
        # Only a mesh tells whether a ray is below the ground: a part may begin with a hole.
        low = np.where(low == np.inf, low, -np.inf)
        next_unit(low, high, first, self.columns[1], np.full(len(self.fan[3]), OVER), which, places)

    def over(self, part: TerrainPart, group: NDArray[np.int64]) -> None:
        frame = (*part.corner, *part.mesh, part.datum)
        follow_columns(part.posts, part.pyramid, part.faces, frame, self.fan, self.columns, self.shown, group)

    def going(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray(self.columns[2][which] >= self.fan[4])


def follow_fan(
    parts: TerrainParts,
    center: NDArray[np.float64],
    ends: NDArray[np.float64],
    rise: tuple[NDArray[np.float64], NDArray[np.float64]],
    rows: tuple[int, int],
    bend: float,
    cache: Cache,
) -> ShownGround:
    """First hits of the rays of a picture, column by column."""
    n, height = len(ends), len(rise[0])
    XYZ, normal, towards = np.full((3, height, n, 3), np.nan)
    shown: ShownGround = XYZ, normal, towards, np.full((height, n), np.nan), np.full((height, n), -1)
    shown[4][: rows[0]] = shown[4][rows[1] :] = LEFT
    paths = np.empty((n, 2, 3))
    paths[:, 0], paths[:, 1, :2], paths[:, 1, 2] = center, ends, center[2]
    lines, rays, spans, states = np.empty((n, 7)), np.empty((n, 10)), np.empty((n, 2)), np.full(n, OVER)
    frame = (*parts.corner, *parts.step)
    box = begin_lines(paths, 0, 0.0, parts.inside, frame, np.zeros(n), np.full(n, MISS), states, lines, rays, spans)
    if not box[0] <= box[2]:
        return shown
    metres = np.linalg.norm(ends - center[:2], axis=1)
    fan: VerticalPlanes = (float(center[2]), bend, *rise, rows[0], spans * metres[:, None])
    columns: Columns = lines, rays, np.full(n, rows[1] - 1)
    which = np.flatnonzero(spans[:, 1] >= 0)
    set_column_slopes(fan, columns, which)
    over_parts(parts, box, which, _Columns(fan, columns, shown), cache)
    return shown


#: Positions are computed at every so-manieth pixel and interpolated between.
STEP = 32


def carried_positions(
    grid: MapGrid, window: Window, carry: Callable[[NDArray[np.float64]], NDArray[np.float64]], tolerance: float
) -> NDArray[np.float64] | None:
    """Pixel centres of a window, carried from the map to other coordinates."""
    at_u = np.append(np.arange(0, window.width - 1, STEP), window.width - 1)
    at_v = np.append(np.arange(0, window.height - 1, STEP), window.height - 1)
    nodes = np.stack(np.meshgrid(at_u + window.col, at_v + window.row), axis=-1).astype(float)
    at_nodes = carry(grid.to_map(nodes))
    middles = (nodes[1:, 1:] + nodes[:-1, :-1]) / 2
    if middles.size:
        strict = carry(grid.to_map(middles))
        between = (at_nodes[1:, 1:] + at_nodes[1:, :-1] + at_nodes[:-1, 1:] + at_nodes[:-1, :-1]) / 4
        if np.abs(strict - between).max() > tolerance:
            return None
    return _between_nodes(at_nodes, at_u, at_v)


def _between_nodes(nodes: NDArray[np.float64], at_u: NDArray[np.int64], at_v: NDArray[np.int64]) -> NDArray[np.float64]:
    """Bilinear positions at every pixel between the nodes."""
    u, v = np.arange(at_u[-1] + 1.0), np.arange(at_v[-1] + 1.0)
    columns = np.empty((nodes.shape[0], len(u), 2))
    full = np.empty((len(v), len(u), 2))
    for k in range(2):
        for i in range(nodes.shape[0]):
            columns[i, :, k] = np.interp(u, at_u, nodes[i, :, k])
    upper = np.clip(np.searchsorted(at_v, v, side="right") - 1, 0, max(len(at_v) - 2, 0))
    lower = np.minimum(upper + 1, len(at_v) - 1)
    span = np.maximum(at_v[lower] - at_v[upper], 1)
    t = ((v - at_v[upper]) / span)[:, None, None]
    full[:] = columns[upper] * (1 - t) + columns[lower] * t
    return full


def box_points(
    boxes: NDArray[np.float64], carry: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None
) -> NDArray[np.float64]:
    """Points whose bounds hold the boxes xmin, ymin, xmax, ymax (n, 4) in other coordinates, shape (n, k, 2).

    Without `carry` these are two corners. Else they are a lattice over each box, and the same widened by a part in a
    hundred: edges bend between its points.
    """
    if carry is None:
        return boxes.reshape(-1, 2, 2)
    part = np.linspace(-0.01, 1.01, 9)
    x = boxes[:, None, None, 0] + part[None, None, :] * (boxes[:, 2] - boxes[:, 0])[:, None, None]
    y = boxes[:, None, None, 1] + part[None, :, None] * (boxes[:, 3] - boxes[:, 1])[:, None, None]
    lattice = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(len(boxes), 81, 2)
    return carry(lattice) if len(boxes) else lattice

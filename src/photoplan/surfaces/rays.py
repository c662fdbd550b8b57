"""Rays onto terrain that is kept in parts: which part comes next, and the first hit over it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.pyramid import Pyramid, pyramid_of
from photoplan.kernels.raycast import ABOVE, ASK, BELOW, MISS, NONE, Faces
from photoplan.kernels.raywalk import begin_lines, end_lines, follow_part, next_part

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
    """Where rays first come down onto the ground."""

    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres; NaN where a ray meets no ground."""
    along: NDArray[np.float64]
    """Piece of the path plus part of it, 0 to k − 1, shape (n,); NaN where a ray meets no ground."""
    result: NDArray[np.int64]
    """`kernels.raycast.MISS`, `SURFACE` or `WALL`, shape (n,)."""
    below: NDArray[np.bool_]
    """True where a ray that met nothing ended below the ground: it started there, or went there through a hole."""
    normal: NDArray[np.float64]
    """Of what is met, of length one, shape (n, 3): of the ground upwards, of walls and objects towards where the ray
    comes from; NaN where a ray meets nothing. A shift of heights does not count."""
    owner: NDArray[np.int64]
    """What is met, shape (n,): 0 the ground, else the number of an object, from one; −1 where a ray meets nothing."""

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
    """Rays that are followed from part to part: lines of `kernels.raywalk`, each in one part at a time."""

    def next(
        self,
        ranges: tuple[NDArray[np.float64], NDArray[np.float64]],
        first: tuple[int, int],
        which: NDArray[np.int64],
        places: NDArray[np.int64],
    ) -> None:
        """Fill in the part that each of some rays has to be followed over next: see `kernels.raywalk.next_part`."""
        ...

    def over(self, part: TerrainPart, group: NDArray[np.int64]) -> None:
        """Follow some rays over a part."""
        ...

    def going(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of some rays still look for ground."""
        ...


@dataclass(frozen=True, eq=False)
class _Rays:
    """One piece of all rays, as far as the first hit: see `kernels.raywalk`."""

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
        next_part(*ranges, first, self.rays, self.states, which, places)

    def over(self, part: TerrainPart, group: NDArray[np.int64]) -> None:
        hits, states = self.hits, self.states
        asks = follow_part(part.posts, part.pyramid, part.faces, (*part.corner, *part.mesh, part.datum),
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
    """Whether there was ground just before the places at t: the state of rays that are below ground there."""
    back = lines[:, 3:5] / (np.hypot(lines[:, 3], lines[:, 4])[:, None] + 1e-300) * _BEFORE
    ground = parts.heights(lines[:, :2] + t[:, None] * lines[:, 3:5] - back)
    return np.where(np.isfinite(ground), ABOVE, NONE)

"""Rays onto terrain that is kept in parts: which part comes next, and the first hit over it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.normals import hit_normals
from photoplan.kernels.pyramid import Pyramid, pyramid_of
from photoplan.kernels.raycast import (
    ABOVE,
    ASK,
    BELOW,
    MISS,
    NONE,
    Faces,
    first_hit,
    next_part,
)

#: Bytes of parts, with their pyramids, that are kept while rays are followed, if all are as large as the last one.
CACHE = 64 << 20
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
class Part:
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


Cache = OrderedDict[tuple[int, int], "Part | None"]
Carry = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Parts(Protocol):
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

    def part(self, column: int, row: int) -> Part | None:
        """A part; None if it has no ground."""
        ...

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at map points (..., 2), shape (...)."""
        ...


def chords(paths: NDArray[np.float64], bend: float, carry: Carry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Paths cut into pieces so short that in other coordinates they are straight, to a quarter of `STRAIGHT`.

    Parameters
    ----------
    paths : ndarray, shape (n, k, 3)
        Map coordinates and heights.
    bend : float
        See `Terrain.first_hit`.
    carry : callable
        Takes points (..., 3) to the other coordinates.

    Returns
    -------
    fine, carried : ndarrays, shape (n, (k − 1)·m + 1, 3)
        The points that cut them, here and there.
    """
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


def follow(parts: Parts, paths: ArrayLike, bend: float = 0.0) -> Hits:
    """First hits of rays over terrain in parts; see `Terrain.first_hit`.

    Raises
    ------
    UsageError
        The paths have another shape, or fewer than two points each.
    """
    at = np.asarray(paths, float)
    if at.ndim != 3 or at.shape[1] < 2 or at.shape[2] != 3:
        raise UsageError(f"paths of shape {at.shape}; n paths of two points X, Y, Z or more are needed (n, k, 3)")
    n = len(at)
    hits = Hits.none(n)
    states, away = np.full(n, NONE), np.zeros(n)
    cache: Cache = OrderedDict()
    for piece in range(at.shape[1] - 1):
        step = at[:, piece + 1] - at[:, piece]
        length = np.hypot(step[:, 0], step[:, 1])
        # X, Y, Z and their changes; the height is z + bend (away + length t)².
        lines = np.concatenate([at[:, piece], step, (bend * length**2)[:, None]], axis=1)
        lines[:, 2] += bend * away**2
        lines[:, 5] += 2 * bend * away * length
        away += length
        todo = np.flatnonzero((hits.result == MISS) & np.isfinite(lines).all(axis=1))
        if not len(todo):
            continue
        t, states[todo], hits.result[todo], hits.normal[todo] = _over_parts(parts, lines[todo], states[todo], cache)
        there, t = todo[np.isfinite(t)], t[np.isfinite(t)]
        hits.along[there] = piece + t
        hits.XYZ[there] = lines[there, :3] + t[:, None] * lines[there, 3:6]
        hits.XYZ[there, 2] += t**2 * lines[there, 6]
        _turn(hits.normal, there, step)
    hits.below[:] = (hits.result == MISS) & (states == BELOW)
    hits.owner[hits.result != MISS] = 0
    return hits


def _turn(normal: NDArray[np.float64], there: NDArray[np.int64], ways: NDArray[np.float64]) -> None:
    """Give normals of some rays the length one, and those of walls the side that rays come from."""
    n = normal[there]
    n[(n[:, 2] == 0) & ((n * ways[there]).sum(axis=1) > 0)] *= -1.0
    normal[there] = n / np.linalg.norm(n, axis=1, keepdims=True)


def carried_hits(
    parts: Parts,
    paths: NDArray[np.float64],
    carry: Carry | None,
    bend: float,
) -> Hits:
    """First hits of rays over parts that lie in another CRS, to which `carry` takes map points; None: in the same."""
    if carry is None:
        return follow(parts, paths, bend)
    fine, carried = chords(paths, bend, lambda XYZ: np.concatenate([carry(XYZ[..., :2]), XYZ[..., 2:]], axis=-1))
    hits = follow(parts, carried)
    there = np.flatnonzero(np.isfinite(hits.along))
    piece = np.minimum(hits.along[there].astype(int), fine.shape[1] - 2)
    a, b = fine[there, piece], fine[there, piece + 1]
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


def _over_parts(
    parts: Parts,
    lines: NDArray[np.float64],
    states: NDArray[np.int64],
    cache: OrderedDict[tuple[int, int], Part | None],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Straight pieces of rays (n, 7): parameters of hits (NaN: none), new states, results and normals."""
    lines, begin, size = _clipped(lines, parts.inside)
    t, results, normals = np.full(len(lines), np.nan), np.full(len(lines), MISS), np.full((len(lines), 3), np.nan)
    # Outside there is no ground.
    states = np.where((begin > 0) | (size < 0), NONE, states)
    rays, window = _in_parts(parts, lines)
    done = ~(size >= 0)
    ranges = parts.ranges(window)
    low, high = (np.array(ranges[..., j], order="C") for j in (0, 1))
    low[np.isnan(low)], high[np.isnan(high)] = np.inf, -np.inf
    while not done.all():
        active = np.flatnonzero(~done)
        moved, state, place = rays[active], states[active], np.empty((len(active), 2), np.int64)
        next_part(low, high, moved, state, place)
        rays[active], states[active] = moved, state
        done[active[place[:, 0] < 0]] = True
        active, place = active[place[:, 0] >= 0], place[place[:, 0] >= 0]
        for group in _groups(place):
            column, row = (int(v) for v in place[group[0]])
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
            here = active[group]
            local = _in_part(part, lines[here], rays[here])
            state, result = states[here], np.empty(len(here), np.int64)
            first_hit(part.posts, part.pyramid, part.faces, local, state, result)
            rays[here, 7] = local[:, 7]
            asks = result == ASK
            if asks.any():
                state[asks] = _before(parts, lines[here[asks]], local[asks, 7])
            states[here] = state
            met = (result != MISS) & ~asks
            done[here[met]], t[here[met]], results[here[met]] = True, local[met, 7], result[met]
            if met.any():
                normals[here[met]] = _normals(part, local[met], result[met])
    states[np.isnan(t) & (begin + size < 1)] = NONE
    return begin + size * t, states, results, normals


def _normals(part: Part, local: NDArray[np.float64], result: NDArray[np.int64]) -> NDArray[np.float64]:
    """Normals of a part's ground where rays have hit it, of no length in particular."""
    out = np.empty((len(local), 3))
    hit_normals(part.posts, part.faces, np.ascontiguousarray(local), result, out)
    return out / (part.mesh[0], -part.mesh[1], 1.0)


def _clipped(
    lines: NDArray[np.float64], inside: tuple[float, float, float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The parts of lines inside map bounds, with their own parameter 0 to 1, and begin and size of it in the old one;
    the size is negative where a line stays outside."""
    begin, end = np.zeros(len(lines)), np.ones(len(lines))
    for axis in (0, 1):
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = ((inside[axis + k] - lines[:, axis]) / lines[:, axis + 3] for k in (0, 2))
        still = lines[:, axis + 3] == 0
        out = still & ((lines[:, axis] < inside[axis]) | (lines[:, axis] > inside[axis + 2]))
        begin = np.maximum(begin, np.where(still, np.where(out, np.inf, 0), np.minimum(a, b)))
        end = np.minimum(end, np.where(still, 1.0, np.maximum(a, b)))
    size = np.where(begin <= end, end - begin, -1.0)
    begin = np.where(size < 0, 0.0, begin)
    s, cut = np.maximum(size, 0.0), lines.copy()
    cut[:, :3] += begin[:, None] * lines[:, 3:6]
    cut[:, 2] += begin**2 * lines[:, 6]
    cut[:, 5] += 2 * begin * lines[:, 6]
    cut[:, 3:6] *= s[:, None]
    cut[:, 6] *= s**2
    return cut, begin, size


def _in_parts(parts: Parts, lines: NDArray[np.float64]) -> tuple[NDArray[np.float64], Window]:
    """Rays for `next_part`, and the window of parts in which their columns and rows are counted."""
    rays = np.zeros((len(lines), 10))
    rays[:, :7] = lines
    rays[:, 0] = (lines[:, 0] - parts.corner[0]) / parts.step[0]
    rays[:, 1] = (parts.corner[1] - lines[:, 1]) / parts.step[1]
    rays[:, 3:5] /= (parts.step[0], -parts.step[1])
    rays[:, 8] = 1.0
    ends = np.concatenate([rays[:, :2], rays[:, :2] + rays[:, 3:5]])
    columns = round((parts.inside[2] - parts.corner[0]) / parts.step[0] + 0.4999999)
    rows = round((parts.corner[1] - parts.inside[1]) / parts.step[1] + 0.4999999)
    low = np.clip(np.floor(ends.min(axis=0)), 0, (columns - 1, rows - 1)).astype(int)
    high = np.clip(np.floor(ends.max(axis=0)), 0, (columns - 1, rows - 1)).astype(int)
    rays[:, :2] -= low
    return rays, Window(int(low[0]), int(low[1]), int(high[0] - low[0] + 1), int(high[1] - low[1] + 1))


def _in_part(part: Part, lines: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays for `first_hit`, from lines in metres and what `next_part` has found."""
    local = np.concatenate([lines, rays[:, [7, 9]]], axis=1)
    local[:, 0] = (lines[:, 0] - part.corner[0]) / part.mesh[0]
    local[:, 1] = (part.corner[1] - lines[:, 1]) / part.mesh[1]
    local[:, 2] -= part.datum
    local[:, 3:5] /= (part.mesh[0], -part.mesh[1])
    return local


def _groups(place: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Indices of rays that are in one part."""
    if not len(place):
        return []
    order = np.lexsort((place[:, 0], place[:, 1]))
    return np.split(order, np.flatnonzero((np.diff(place[order], axis=0) != 0).any(axis=1)) + 1)


def _kept(parts: Parts, at: tuple[int, int], cache: Cache) -> Part | None:
    """A part, from the cache if it is there; parts used longest ago are forgotten."""
    if at not in cache:
        part = cache[at] = parts.part(*at)
        while part is not None and len(cache) > max(1, CACHE // part.bytes):
            cache.popitem(last=False)
    cache.move_to_end(at)
    return cache[at]


def _before(parts: Parts, lines: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.int64]:
    """Whether there was ground just before the places at t: the state of rays that are below ground there."""
    back = lines[:, 3:5] / (np.hypot(lines[:, 3], lines[:, 4])[:, None] + 1e-300) * _BEFORE
    ground = parts.heights(lines[:, :2] + t[:, None] * lines[:, 3:5] - back)
    return np.where(np.isfinite(ground), ABOVE, NONE)

"""Heights at common vertices of lines: one height for all that meet there, and two at walls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from photoplan.surfaces.measured import MeasuredLine
from photoplan.terrain.clean.nodes import Network

LEAST_SIGMA = 1e-6
"""Standard deviation that stands for exact heights in weights, metres."""


@dataclass(frozen=True, eq=False)
class Joined:
    """Points that became part of a vertex of lines."""

    vertex: NDArray[np.int64]
    z: NDArray[np.float64]
    sigma: NDArray[np.float64]
    labels: list[str]

    @staticmethod
    def all(parts: Sequence[Joined]) -> Joined:
        """The points of all parts."""
        return Joined(
            np.concatenate([np.empty(0, np.int64), *(p.vertex for p in parts)]),
            np.concatenate([np.empty(0), *(p.z for p in parts)]),
            np.concatenate([np.empty(0), *(p.sigma for p in parts)]),
            [label for p in parts for label in p.labels],
        )


@dataclass(frozen=True)
class Meeting:
    """Lines or points that meet at one place with different heights."""

    X: float
    Y: float
    names: tuple[str, ...]
    heights: tuple[float, ...]
    taken: float
    """Height that all of them have now; NaN at walls, where each side has its own."""


def one_height(
    net: Network, lines: Sequence[MeasuredLine], sigmas: NDArray[np.float64], joined: Joined, tolerance: float
) -> tuple[Network, list[Meeting]]:
    """The network with one height wherever lines meet: the mean, weighted by the standard deviations.

    Border lines and holes take the height of other lines where they meet, and never change it. At walls heights stay
    as they are. Heights that differ by more than `tolerance` are returned one by one.
    """
    terrain = np.array([line.kind in ("breakline", "formline") for line in lines], bool)
    wall = np.array([line.right is not None for line in lines], bool)
    weight = 1.0 / np.maximum(sigmas, LEAST_SIGMA) ** 2
    z = net.z.copy()
    meetings: list[Meeting] = []
    mean = np.full(len(net.xy), np.nan)
    # At a wall, lines have the height of the side that they come from: `cut_at_walls` gives it to them.
    free = ~np.isin(net.vertex, list(_sides(net, lines).walls)) & ~wall[net.line] & ~np.isnan(z)
    for leading in (True, False):
        place = np.flatnonzero((terrain[net.line] == leading) & free)
        vertex, height, w = net.vertex[place], z[place], weight[net.line[place]]
        if leading:
            vertex, height = np.concatenate([vertex, joined.vertex]), np.concatenate([height, joined.z])
            w = np.concatenate([w, 1.0 / np.maximum(joined.sigma, LEAST_SIGMA) ** 2])
        own, low, high = _means(vertex, height, w, len(net.xy))
        mean = np.where(np.isnan(mean), own, mean)
        different = np.flatnonzero(high - low > tolerance)
        owner = net.line[place]

        def name(k: int, owner: NDArray[np.int64] = owner) -> str:
            return lines[owner[k]].name if k < len(owner) else joined.labels[k - len(owner)]

        meetings += _meetings(net, name, different, vertex, height, mean)
        z[place] = mean[net.vertex[place]]
    return replace(net, z=z), meetings


def _means(
    vertex: NDArray[np.int64], z: NDArray[np.float64], weight: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean, lowest and highest height of every vertex; NaN where there is none."""
    total = np.bincount(vertex, weight, minlength=count)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, vertex, z)
    np.maximum.at(high, vertex, z)
    none = total == 0
    low[none] = high[none] = np.nan
    base = np.where(none, 0.0, low)
    with np.errstate(invalid="ignore"):  # equal heights keep their bits: their mean is `base`, plus zero
        mean = base + np.bincount(vertex, weight * (z - base[vertex]), minlength=count) / total
    return mean, low, high


def _meetings(
    net: Network,
    name: Callable[[int], str],
    different: NDArray[np.int64],
    vertex: NDArray[np.int64],
    z: NDArray[np.float64],
    mean: NDArray[np.float64],
) -> list[Meeting]:
    """Meetings at the vertices `different`, from the vertex and height of every entry and the name of each."""
    if not len(different):
        return []
    at = np.flatnonzero(np.isin(vertex, different))
    at = at[np.argsort(vertex[at], kind="stable")]
    out = []
    for part in np.split(at, np.flatnonzero(np.diff(vertex[at])) + 1):
        names = [name(k) for k in part.tolist()]
        seen = dict(zip(names, z[part].tolist()))  # a line that passes twice is named once, unless it is alone
        pairs = list(seen.items()) if len(seen) > 1 else list(zip(names, z[part].tolist()))
        v = int(vertex[part[0]])
        X, Y = net.xy[v].tolist()
        out.append(
            Meeting(
                X=X, Y=Y, names=tuple(n for n, _ in pairs), heights=tuple(h for _, h in pairs), taken=float(mean[v])
            )
        )
    return out


def cut_at_walls(
    net: Network, lines: Sequence[MeasuredLine], tolerance: float
) -> tuple[list[MeasuredLine], list[Meeting]]:
    """Lines of the network; those with one height are cut where they meet a wall, and take the height of its sides.

    A segment that a line shares with a wall is left to the wall. At the ends of a wall lines are not cut. Returned
    besides: meetings whose heights lie outside those of the wall by more than `tolerance`.
    """
    sides = _sides(net, lines)
    meetings: list[Meeting] = []
    out: list[MeasuredLine] = []
    bounds = np.searchsorted(net.line, np.arange(len(lines) + 1))
    for number, line in enumerate(lines):
        places = np.arange(bounds[number], bounds[number + 1])
        if len(places) < 2:
            continue
        touching = line.right is None and line.kind in ("breakline", "formline")
        v = net.vertex[places].tolist()
        meets = any(a in sides.walls for a in v) or any((min(a, b), max(a, b)) in sides.edges for a, b in pairwise(v))
        if not touching or not meets:
            out.append(_line(line, net, places))
            continue
        out += _pieces(net, line, places, sides, tolerance, meetings)
    return out, meetings


@dataclass(frozen=True, eq=False)
class _Walls:
    """Where walls pass."""

    walls: dict[int, tuple[int, int, float, float, str]]
    """By inner vertex: the vertex before and after, heights left and right, name."""
    edges: set[tuple[int, int]]
    """Segments of walls, smaller vertex first."""


def _sides(net: Network, lines: Sequence[MeasuredLine]) -> _Walls:
    walls: dict[int, tuple[int, int, float, float, str]] = {}
    edges: set[tuple[int, int]] = set()
    bounds = np.searchsorted(net.line, np.arange(len(lines) + 1))
    for number in (k for k, line in enumerate(lines) if line.right is not None):
        places = range(bounds[number], bounds[number + 1])
        v = net.vertex[places.start : places.stop].tolist()
        edges |= {(min(a, b), max(a, b)) for a, b in pairwise(v)}
        closed = len(v) > 3 and v[0] == v[-1]
        for k, place in enumerate(places):
            inner = 0 < k < len(v) - 1
            if inner or closed:
                before, after = (v[k - 1], v[k + 1]) if inner else (v[-2], v[1])
                walls.setdefault(
                    v[k], (before, after, float(net.z[place]), float(net.right[place]), lines[number].name)
                )
    return _Walls(walls, edges)


def _pieces(
    net: Network,
    line: MeasuredLine,
    places: NDArray[np.int64],
    sides: _Walls,
    tolerance: float,
    meetings: list[Meeting],
) -> list[MeasuredLine]:
    v = net.vertex[places].tolist()
    pieces: list[list[tuple[int, float]]] = [[]]
    for k, vertex in enumerate(v):
        own = float(net.z[places[k]])
        shared = k > 0 and (min(v[k - 1], vertex), max(v[k - 1], vertex)) in sides.edges
        arriving = leaving = own
        if vertex in sides.walls:
            arriving = _side(net, sides, vertex, v[k - 1]) if k and not shared else own
            leaving = _side(net, sides, vertex, v[k + 1]) if k + 1 < len(v) else own
            low, high = sorted(sides.walls[vertex][2:4])
            if not low - tolerance <= own <= high + tolerance:
                X, Y = net.xy[vertex].tolist()
                names = (line.name, sides.walls[vertex][4])
                meetings.append(Meeting(X=X, Y=Y, names=names, heights=(own, low, high), taken=float("nan")))
        if shared:
            pieces.append([])
        else:
            pieces[-1].append((vertex, arriving))
        if shared or leaving != arriving:
            pieces.append([(vertex, leaving)])
    kept = [p for p in pieces if len(p) > 1]
    return [
        replace(
            line,
            name=line.name if len(kept) == 1 else f"{line.name} part {k}",
            xyz=np.column_stack([net.xy[[a for a, _ in piece]], [h for _, h in piece]]),
        )
        for k, piece in enumerate(kept, 1)
    ]


def _side(net: Network, sides: _Walls, vertex: int, other: int) -> float:
    """Height of the side of the wall from which `other` is seen at its vertex."""
    before, after, left, right, _ = sides.walls[vertex]
    angle = [np.arctan2(*(net.xy[p] - net.xy[vertex])[::-1]) for p in (after, before, other)]
    # Left of the direction of travel lies what is met turning from the way ahead to the way back, anticlockwise.
    return left if (angle[2] - angle[0]) % (2 * np.pi) < (angle[1] - angle[0]) % (2 * np.pi) else right


def _line(line: MeasuredLine, net: Network, places: NDArray[np.int64]) -> MeasuredLine:
    xyz = np.column_stack([net.xy[net.vertex[places]], net.z[places]])
    return replace(line, xyz=xyz, right=None if line.right is None else net.right[places])

"""From measurements to a stochastic model: covariance functions, their choice in every patch, gross errors.

The area is cut into squares that hold few points each: every one is the core of a patch of prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.events import SILENT, Events, Map
from photoplan.kernels.patch_test import score_models, test_points
from photoplan.surfaces.units import UnitLayout
from photoplan.terrain.covariance import LADDER, Covariance, Neighbours, estimate_all, estimate_unit, ladder, near_lines
from photoplan.terrain.observations import Observations
from photoplan.terrain.settings import BuildSettings

#: A patch reaches this many half sides from the middle of its leaf (see the weights in `photoplan.kernels.patch`).
REACH = 1.5
#: Rounds of looking for gross errors; each finds at most one in a patch.
_ROUNDS = 12
#: Residuals whose spread a unit's own ones must outweigh: its standard deviations follow their neighbours' till then.
_EXPECTED_RESIDUALS = 50
#: Points within so many spacings support each other if both deviate by more than so many standard deviations.
_CLOSE, _CLEAR = 1.5, 2.0
#: A point tells nothing of its error if less than this share of it shows in the residual.
_LEAST_REDUNDANCY = 0.02
#: Points that a leaf holds at most.
CAPACITY = 24
#: A leaf is not smaller than this many meshes.
_SMALLEST = 2


@dataclass(frozen=True, eq=False)
class Leaves:
    """Squares that cover all units, sorted by unit."""

    middle: NDArray[np.float64]
    """X, Y of the middles, shape (n, 2), in the coordinates that were given."""
    half: NDArray[np.float64]
    """Half sides, shape (n,), metres."""
    unit: NDArray[np.int64]
    """Number of each leaf's unit, row · columns + column, shape (n,)."""
    count: NDArray[np.int64]
    """Points inside, shape (n,)."""
    order: NDArray[np.int64]
    """Points in the order of leaves, shape (p,)."""
    first: NDArray[np.int64]
    """Points of leaf i are order[first[i]:first[i] + count[i]]."""

    def of_unit(self, unit: int) -> NDArray[np.int64]:
        """Leaves of a unit."""
        return np.arange(np.searchsorted(self.unit, unit), np.searchsorted(self.unit, unit, side="right"))


def quadtree(xy: NDArray[np.float64], layout: UnitLayout, meshes: int) -> Leaves:
    """Quarter each unit until a leaf holds at most `CAPACITY` points or is two meshes wide.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Points inside the layout, in its coordinates.
    layout : UnitLayout
    meshes : int
        Meshes along a unit's side, a power of two.
    """
    deepest = max(0, int(np.log2(meshes / _SMALLEST)))
    place = np.stack([xy[:, 0] - layout.left, layout.top - xy[:, 1]], axis=1) / layout.side
    column = np.clip(place[:, 0].astype(np.int64), 0, layout.columns - 1)
    row = np.clip(place[:, 1].astype(np.int64), 0, layout.rows - 1)
    inside = np.clip(((place - np.stack([column, row], axis=1)) * 2**deepest).astype(np.int64), 0, 2**deepest - 1)
    key = (row * layout.columns + column) << (2 * deepest) | _interleave(inside)
    order = np.argsort(key, kind="stable")
    key = key[order]
    cells = np.arange(layout.columns * layout.rows, dtype=np.int64)
    found: list[tuple[NDArray[np.int64], int]] = []
    for level in range(deepest + 1):
        shift = 2 * (deepest - level)
        count = np.searchsorted(key, (cells + 1) << shift) - np.searchsorted(key, cells << shift)
        split = (count > CAPACITY) & (level < deepest)
        found.append((cells[~split], level))
        cells = (cells[split, None] << 2 | np.arange(4)).ravel()
    code = np.concatenate([c << (2 * (deepest - level)) for c, level in found])
    levels = np.concatenate([np.full(len(c), level) for c, level in found])
    sort = np.argsort(code)
    code, levels = code[sort], levels[sort]
    first = np.searchsorted(key, code)
    count = np.searchsorted(key, code + (np.int64(1) << (2 * (deepest - levels)))) - first
    unit = code >> (2 * deepest)
    half = layout.side / 2.0 ** (levels + 1)
    corner = _separate(code & ((1 << (2 * deepest)) - 1)) * (layout.side / 2**deepest)
    x = layout.left + (unit % layout.columns) * layout.side + corner[:, 0] + half
    y = layout.top - (unit // layout.columns) * layout.side - corner[:, 1] - half
    return Leaves(np.stack([x, y], axis=1), half, unit, count, order, first)


def _interleave(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Column and row (n, 2) to one number whose bits alternate, so that quarters are ranges."""
    code = np.zeros(len(cells), np.int64)
    for bit in range(12):
        code |= ((cells[:, 0] >> bit) & 1) << (2 * bit) | ((cells[:, 1] >> bit) & 1) << (2 * bit + 1)
    return code


def _separate(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Inverse of `_interleave`."""
    cells = np.zeros((len(code), 2), np.int64)
    for bit in range(12):
        cells[:, 0] |= ((code >> (2 * bit)) & 1) << bit
        cells[:, 1] |= ((code >> (2 * bit + 1)) & 1) << bit
    return cells


@dataclass(frozen=True, eq=False)
class TerrainFit:
    """The stochastic model of a terrain, and what its points say of it."""

    seen: Observations
    layout: UnitLayout
    """Units, relative to the origin of the observations."""
    leaves: Leaves
    neighbours: Neighbours
    whole: Covariance
    """Covariance function of the whole area."""
    units: tuple[Covariance, ...]
    """That of each unit, row by row."""
    noise: NDArray[np.float64]
    """Variances of all data, m²; negative: gross errors, which are not used."""
    shares: NDArray[np.float64]
    """Weight of each function of the ladder in every patch, shape (leaves, len(LADDER))."""
    residuals: NDArray[np.float64]
    """Residual (metres), redundancy and normalised residual of every point, shape (points, 3); NaN: not tested."""
    spread: NDArray[np.float64]
    """Spread of the normalised residuals in each unit, by which standard deviations are multiplied."""
    members: tuple[NDArray[np.int64], ...]
    """Points of each unit."""

    @property
    def gross(self) -> NDArray[np.int64]:
        """Points flagged as gross errors."""
        return np.flatnonzero(self.noise[: self.seen.points] < 0)

    def models(self, leaves: NDArray[np.int64]) -> NDArray[np.float64]:
        """Functions of the given leaves, shape (n, len(LADDER), 4)."""
        table = {unit: ladder(self.units[unit]) for unit in np.unique(self.leaves.unit[leaves]).tolist()}
        return np.stack([table[unit] for unit in self.leaves.unit[leaves].tolist()])


def patches_at(leaves: Leaves, some: NDArray[np.int64]) -> NDArray[np.float64]:
    """Middle and half side of leaves, shape (n, 3)."""
    return np.column_stack([leaves.middle[some], leaves.half[some]])


def fit(
    seen: Observations, layout: UnitLayout, settings: BuildSettings, run: Map = map, events: Events = SILENT
) -> TerrainFit:
    """Estimate the covariance functions, choose among them in every patch, and flag gross errors.

    What `run` computes is returned to it, so that it can be kept: nothing else changes but by what it gives back.
    """
    vertices = seen.lines.xyz[:, :2]
    leaves = quadtree(np.vstack([seen.xyz[: seen.points, :2], vertices]), layout, settings.unit_meshes)
    order = leaves.order[leaves.order < seen.points]
    neighbours = Neighbours.of(seen.xyz[:, :2], seen.points, order)
    count = layout.columns * layout.rows
    events.begin("covariance functions and gross errors", 3 * count + 1, "units")
    unit_of_point = _unit_of(seen.xyz[:, :2], layout)
    members = _members(unit_of_point[: seen.points], count)
    (whole,) = run(lambda members: estimate_all(seen, neighbours, members, settings), [members])
    units = list(run(lambda u: estimate_unit(seen, neighbours, members[u], whole, settings), range(count)))
    mass = np.array([unit.noise for unit in units])
    found = TerrainFit(
        seen=seen,
        layout=layout,
        leaves=leaves,
        neighbours=neighbours,
        whole=whole,
        units=tuple(units),
        noise=seen.noise(mass[unit_of_point]),
        shares=np.empty((len(leaves.half), len(LADDER))),
        residuals=np.full((seen.points, 3), np.nan),
        spread=np.ones(count),
        members=tuple(members),
    )
    for u, shares in enumerate(run(lambda u: _choose(found, u), range(count))):
        found.shares[leaves.of_unit(u)] = shares
    _test_all(found, [leaves.of_unit(u) for u in range(count)], run)
    if settings.gross > 0:
        events.begin("gross errors", unit="units")
        _flag(found, settings.gross, run)
    return replace(found, spread=_spread(found))


def _unit_of(xy: NDArray[np.float64], layout: UnitLayout) -> NDArray[np.int64]:
    column = np.clip(((xy[:, 0] - layout.left) / layout.side).astype(np.int64), 0, layout.columns - 1)
    row = np.clip(((layout.top - xy[:, 1]) / layout.side).astype(np.int64), 0, layout.rows - 1)
    unit: NDArray[np.int64] = row * layout.columns + column
    return unit


def _members(unit: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    order = np.argsort(unit, kind="stable")
    return np.split(order, np.searchsorted(unit[order], np.arange(1, count)))


def lines_of(
    found: TerrainFit, patches: NDArray[np.float64], ids: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Barriers that any of the patches can meet, from their squares and their data."""
    data = found.seen.xyz[ids.ravel()[ids.ravel() >= 0], :2]
    reach = REACH * patches[:, 2:]
    low = np.minimum(data.min(axis=0), (patches[:, :2] - reach).min(axis=0))
    high = np.maximum(data.max(axis=0), (patches[:, :2] + reach).max(axis=0))
    return near_lines(found.seen, low, high)


def _choose(found: TerrainFit, unit: int) -> NDArray[np.float64]:
    """Weights of the ladder's functions in the patches of a unit, shape (patches, len(LADDER))."""
    some = found.leaves.of_unit(unit)
    ids = found.neighbours.query(found.leaves.middle[some])
    scores = np.zeros((len(some), len(LADDER)))
    patches = patches_at(found.leaves, some)
    lines = lines_of(found, patches, ids)
    score_models(found.seen.xyz, found.noise, ids, patches, found.seen.points, *lines, found.models(some), scores)
    scores -= np.where(np.isfinite(scores), scores, np.inf).min(axis=1, keepdims=True)
    weight = np.exp(-scores / 2)
    weight = np.where(np.isfinite(weight), weight, 0.0)
    weight[weight.sum(axis=1) == 0] = 1.0
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _test_all(found: TerrainFit, leaves: list[NDArray[np.int64]], run: Map) -> None:
    """Residuals of the points in groups of leaves."""
    for points, residuals in run(lambda some: _test(found, some), leaves):
        found.residuals[points] = residuals


def _test(found: TerrainFit, some: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The points in some leaves and their residuals, by the best function of each patch."""
    leaves, points = found.leaves, found.seen.points
    own = [leaves.order[leaves.first[k] : leaves.first[k] + leaves.count[k]] for k in some]
    own = [numbers[numbers < points] for numbers in own]
    start = np.concatenate([[0], np.cumsum([len(numbers) for numbers in own])])
    numbers = np.concatenate([np.empty(0, np.int64), *own])
    if not len(numbers):
        return numbers, np.empty((0, 3))
    models = found.models(some)[np.arange(len(some)), found.shares[some].argmax(axis=1)]
    ids = found.neighbours.query(leaves.middle[some])
    patches = patches_at(leaves, some)
    test_points(
        found.seen.xyz,
        found.noise,
        ids,
        patches,
        numbers,
        start,
        *lines_of(found, patches, ids),
        models,
        found.residuals,
    )
    return numbers, found.residuals[numbers]


def _flag(found: TerrainFit, limit: float, run: Map) -> None:
    """Flag the worst point of each neighbourhood, test the neighbourhood again, until none is left (data snooping).

    A point that fits no smooth surface may still show what the terrain is like: a ditch or a stone that no line
    describes. It is an error only if no neighbour deviates as it does.
    """
    points = found.seen.points
    cleared = np.zeros(points, bool)
    for _ in range(_ROUNDS):
        used = (found.noise[:points] >= 0) & ~cleared
        wild = (np.abs(found.residuals[:, 2]) > limit) & (found.residuals[:, 1] > _LEAST_REDUNDANCY)
        suspect = np.flatnonzero(used & wild)
        if not len(suspect):
            return
        supported = _supported(found, suspect)
        cleared[suspect[supported]] = True
        suspect = suspect[~supported]
        if not len(suspect):
            return
        near = found.neighbours.near[0].query(found.seen.xyz[suspect, :2])
        size = np.where(found.noise[:points] >= 0, np.abs(found.residuals[:, 2]), 0.0)
        flagged = suspect[size[suspect] >= np.nan_to_num(size[near]).max(axis=1)]
        if not len(flagged):
            return
        found.noise[flagged] = -1.0
        touched = np.unique(found.neighbours.near[0].query(found.seen.xyz[flagged, :2]))
        leaves = np.unique(_leaf_of(found)[touched])
        unit = found.leaves.unit[leaves]
        _test_all(found, [leaves[unit == u] for u in np.unique(unit)], run)


def _supported(found: TerrainFit, suspect: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether another point close by deviates clearly and to the same side."""
    near = found.neighbours.near[0].query(found.seen.xyz[suspect, :2])
    apart = np.linalg.norm(found.seen.xyz[near, :2] - found.seen.xyz[suspect, None, :2], axis=2)
    close = (apart <= _CLOSE * found.seen.spacing) & (near != suspect[:, None])
    same = found.residuals[near, 2] * np.sign(found.residuals[suspect, 2])[:, None] > _CLEAR
    supported: NDArray[np.bool_] = (close & same).any(axis=1)
    return supported


def _leaf_of(found: TerrainFit) -> NDArray[np.int64]:
    """Leaf of every point and vertex."""
    leaf = np.empty(len(found.leaves.order), np.int64)
    leaf[found.leaves.order] = np.repeat(np.arange(len(found.leaves.half)), found.leaves.count)
    return leaf


def _spread(found: TerrainFit) -> NDArray[np.float64]:
    """Spread of the normalised residuals of each unit's points, drawn to that of all where there are few."""
    points = found.seen.points
    good = (found.noise[:points] >= 0) & np.isfinite(found.residuals[:, 2])
    z2 = found.residuals[:, 2] ** 2
    if not good.any():
        return np.ones(len(found.members))
    whole = float(z2[good].mean())
    sums = np.array([z2[m][good[m]].sum() for m in found.members])
    counts = np.array([good[m].sum() for m in found.members])
    return np.sqrt((sums + _EXPECTED_RESIDUALS * whole) / (counts + _EXPECTED_RESIDUALS))

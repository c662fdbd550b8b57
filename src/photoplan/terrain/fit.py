"""From measurements to a stochastic model: covariance functions, their choice in every patch, gross errors.

The area is cut into squares that hold few points each: every one is the core of a patch of prediction.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photoplan.events import SILENT, Events, Map
from photoplan.kernels.local_planes import local_scales
from photoplan.kernels.patch import MOST_MISFIT
from photoplan.kernels.patch_test import score_models, test_points
from photoplan.surfaces.units import UnitLayout
from photoplan.terrain.calibration import NONE, SigmaFactor
from photoplan.terrain.covariance import LADDER, Covariance, Neighbours, estimate_all, estimate_unit, ladder, near_lines
from photoplan.terrain.leaves import Leaves, patches_at, quadtree
from photoplan.terrain.observations import Observations, told_by
from photoplan.terrain.screen import MEETS_MODEL, PART, Neighbourhoods, Screened, screen, supported
from photoplan.terrain.settings import BuildSettings

#: A patch reaches this many half sides from the middle of its leaf (see the weights in `photoplan.kernels.patch`).
REACH = 1.5
#: Rounds of looking for gross errors; each finds at most one in a patch.
_ROUNDS = 12
#: Spacings at which data count a quarter for the roughness; points of a leaf from which it is judged whether roughness
#: differs; the usual roughness counts as so many data.
_ROUGH, _LEAST_OF_LEAF, _WEIGHTS = 3.0, 6, (1.0, 100.0)
#: So many leaves say whether the ground is rougher than blocks of points say: by so much lower a mean of their scores,
#: if those of such a part of them are lower; by the first functions of the ladder.
_LEAVES, _GAIN, _SHARE, _STEPS = 128, 0.5, 0.4, 3
#: Standard deviations of a mean of squares by which the residuals must lie below the stated noise to contradict it.
_CERTAIN = 3.1
#: Residuals of so many points around say what the filter took away, each with so many neighbours, beyond so many
#: standard deviations of chance.
_WINDOW, _TOUCHING, _BEYOND = 24, 6, 2.0
#: With fewer points no one is a gross error.
_FEWEST = 8
#: While the stochastic model is estimated, the standard deviation of what looks like a gross error is so many times it.
_WEIGHTLESS = 30.0


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
    """Height less its prediction from all others that are not far off themselves (metres), redundancy (share of this
    difference that the filtered surface leaves) and the difference in its standard deviations, of every point, shape
    (points, 3); NaN: not tested. Of gross errors: without any of them."""
    ground: NDArray[np.float64]
    """Variance in each unit that is taken for noise and may be ground, m²."""
    members: tuple[NDArray[np.int64], ...]
    """Points of each unit."""
    suspects: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 5)))
    """Points that are used, but look like part of a gross error: number, group, and residuals as above, as if the
    group were not used; shape (n, 5)."""
    usual: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    """Mean of the squared normalised residuals, how many data it counts as beside those around a place, and the
    distance at which these count a quarter, metres."""
    lost: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    """Variance of ground that the filter took for noise at each datum, m²: what residuals of neighbours share."""
    calibration: SigmaFactor = NONE

    @property
    def squares(self) -> NDArray[np.float64]:
        """Squared normalised residuals of all data; NaN: not tested, or not used."""
        squares = np.full(len(self.noise), np.nan)
        squares[: self.seen.points] = self.residuals[:, 2] ** 2
        squares[self.noise < 0] = np.nan
        return squares

    @property
    def least_noise(self) -> float:
        """Share of the stated variance of noise, at most 1, that the residuals allow with a confidence of 99.9 %."""
        count = max(int(np.isfinite(self.squares).sum()), 1)
        return float(min(1.0, self.usual[0] * (1 + _CERTAIN * np.sqrt(2 / count))))

    @property
    def gross(self) -> NDArray[np.int64]:
        """Points flagged as gross errors."""
        return np.flatnonzero(self.noise[: self.seen.points] < 0)

    def models(self, leaves: NDArray[np.int64]) -> NDArray[np.float64]:
        """Functions of the given leaves, shape (n, len(LADDER), 4)."""
        table = {unit: ladder(self.units[unit]) for unit in np.unique(self.leaves.unit[leaves]).tolist()}
        return np.stack([table[unit] for unit in self.leaves.unit[leaves].tolist()])


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
    unit_of_point = unit_of(seen.xyz[:, :2], layout)
    members = _members(unit_of_point[: seen.points], count)
    around = screened = None
    trusted = seen
    if settings.gross > 0 and seen.points >= _FEWEST:
        around = Neighbourhoods.of(seen)
        screened = screen(seen, around, settings.gross)
        trusted = _weightless(seen, screened)
    told, near, subjects = told_by(trusted), neighbours, members
    if told is not trusted:
        near = Neighbours.of(told.xyz[:, :2], told.points, np.arange(told.points))
        subjects = _members(unit_of(told.xyz[:, :2], layout), count)

    def untested(whole: Covariance, units: Sequence[Covariance]) -> TerrainFit:
        mass = np.array([unit.noise for unit in units])
        return TerrainFit(
            seen=seen,
            layout=layout,
            leaves=leaves,
            neighbours=neighbours,
            whole=whole,
            units=tuple(units),
            noise=trusted.noise(mass[unit_of_point]),
            shares=np.empty((len(leaves.half), len(LADDER))),
            residuals=np.full((seen.points, 3), np.nan),
            ground=whole.ground * mass**2,
            lost=np.zeros(len(seen.xyz)),
            members=tuple(members),
        )

    def of_all(some: Iterable[NDArray[np.int64]]) -> Covariance:
        candidates = estimate_all(told, near, some, settings)
        return _by_leaves([untested(one, [one] * count) for one in candidates])

    (whole,) = run(of_all, [subjects])
    found = untested(whole, list(run(lambda u: estimate_unit(told, near, subjects[u], whole, settings), range(count))))
    for u, shares in enumerate(run(lambda u: choose(found, leaves.of_unit(u)), range(count))):
        found.shares[leaves.of_unit(u)] = shares
    _test_all(found, [leaves.of_unit(u) for u in range(count)], run)
    if around is not None and screened is not None:
        events.begin("gross errors", unit="units")
        mass = np.array([unit.noise for unit in found.units])[unit_of_point]
        suspects = _judge(found, around, screened, seen.noise(mass), settings.gross, run)
        _flag(found, around, screened, settings.gross, run)
        found = replace(found, suspects=_whole_groups(found, screened, suspects, settings.gross, run))
    return replace(found, usual=_usual(found), lost=_lost(found))


def _weightless(seen: Observations, screened: Screened) -> Observations:
    """Observations among which those that look like gross errors have next to no weight."""
    parts = seen.parts.copy()
    parts[: seen.points, 0] += (_WEIGHTLESS * screened.size) ** 2
    return replace(seen, parts=parts)


def _usual(found: TerrainFit) -> NDArray[np.float64]:
    """How rough ground is on average, and how much that counts: the less, the more leaves differ beyond chance."""
    points, leaf = found.seen.points, _leaf_of(found)
    square = np.minimum(found.squares[:points], MOST_MISFIT)
    known = np.isfinite(square)
    reach = _ROUGH * found.seen.spacing
    if not known.any():
        return np.array([1.0, 1.0, reach])
    square, leaf = square[known], leaf[:points][known]
    mean = float(square.mean())
    count = np.bincount(leaf)
    full = count >= _LEAST_OF_LEAF
    count, total, squared = (np.bincount(leaf, w)[full] for w in (None, square, square**2))
    of_leaf = total / count
    chance = (squared / count - of_leaf**2) / (count - 1)
    differ = float(((of_leaf - mean) ** 2 - chance).mean()) / max(mean, 1e-9) ** 2 if len(count) else 0.0
    # Two thirds: data further off count too, less each, so that the sum of their weights is a third of their number.
    return np.array([max(mean, 1e-9), np.clip(2 / 3 / max(differ, 1e-9), *_WEIGHTS), reach])


def _lost(found: TerrainFit) -> NDArray[np.float64]:
    """Variance of ground that the filter took for noise, m², at each datum.

    Residuals of noise alone are independent, or differ in sign a little more often than not. The mean product of those
    of neighbours is therefore what the filtered surface is off by, squared; it counts by what exceeds chance.
    """
    lost = np.zeros(len(found.seen.xyz))
    points = found.seen.points
    residual = found.residuals[:, 0] * found.residuals[:, 1]
    some = np.flatnonzero((found.noise[:points] >= 0) & np.isfinite(residual))
    if len(some) <= _WINDOW:
        return lost
    v = residual[some]
    near = cKDTree(found.seen.xyz[some, :2]).query(found.seen.xyz[some, :2], k=_WINDOW + 1)[1]
    shared = v * v[near[:, 1 : _TOUCHING + 1]].mean(axis=1)
    chance = (v**2)[near].mean(axis=1) / np.sqrt(_WINDOW * _TOUCHING / 2)
    lost[some] = np.maximum(shared[near].mean(axis=1) - _BEYOND * chance, 0.0)
    return lost


def unit_of(xy: NDArray[np.float64], layout: UnitLayout) -> NDArray[np.int64]:
    """Number of the unit, row · columns + column, of places (n, 2); outside, the nearest."""
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


def _by_leaves(fits: list[TerrainFit]) -> Covariance:
    """Function of the whole area by which leaves all over it are predicted better; fits, the smoothest function first.

    Blocks of points are few, and leaves choose among lengths: crests are met, and seen as what they are.
    """
    leaves = fits[0].leaves
    some = np.flatnonzero(leaves.count > 0)
    some = some[:: max(1, -(-len(some) // _LEAVES))]
    if len(fits) < 2 or not len(some):
        return fits[0].whole
    scores = []
    for found in fits:
        score = np.concatenate(
            [_scores(found, some[leaves.unit[some] == u], _STEPS) for u in np.unique(leaves.unit[some])]
        )
        least = score.min(axis=1)
        with np.errstate(invalid="ignore"):  # no function has a solution
            scores.append(least - 2 * np.log(np.exp((least[:, None] - score) / 2).mean(axis=1)))
    with np.errstate(invalid="ignore"):
        gain = scores[0] - scores[1]
    gain = gain[np.isfinite(gain)]
    return fits[int(len(gain) > 0 and gain.mean() > _GAIN and (gain > 0).mean() > _SHARE)].whole


def choose(found: TerrainFit, some: NDArray[np.int64]) -> NDArray[np.float64]:
    """Weights of the ladder's functions in the patches of some leaves, shape (patches, len(LADDER))."""
    scores = _scores(found, some)
    scores -= np.where(np.isfinite(scores), scores, np.inf).min(axis=1, keepdims=True)
    weight = np.exp(-scores / 2)
    weight = np.where(np.isfinite(weight), weight, 0.0)
    weight[weight.sum(axis=1) == 0] = 1.0
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _scores(found: TerrainFit, some: NDArray[np.int64], steps: int = len(LADDER)) -> NDArray[np.float64]:
    """How badly the ladder's functions predict the points of some leaves, shape (leaves, steps)."""
    ids = found.neighbours.query(found.leaves.middle[some])
    scores = np.zeros((len(some), steps))
    patches = patches_at(found.leaves, some)
    models = np.ascontiguousarray(found.models(some)[:, :steps])
    lines = lines_of(found, patches, ids)
    score_models(found.seen.xyz, found.noise, ids, patches, found.seen.points, *lines, models, scores)
    scores[:, 1:][(scores == 0).all(axis=1)] = np.inf  # without points, the unit's own function
    return scores


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


def _judge(
    found: TerrainFit, around: Neighbourhoods, screened: Screened, noise: NDArray[np.float64], limit: float, run: Map
) -> NDArray[np.float64]:
    """Compare what looks like gross errors with the model that was estimated without it, and use the rest again.

    Returns the suspects. `noise` are the variances of all data, with their weight.
    """
    some = screened.all
    inflated, result = found.noise[some], found.residuals
    # A datum of variance s² adds it to the variance of the difference from its prediction; the rest is the latter's.
    variance = np.maximum(inflated / result[some, 1] - inflated, 0.0) + noise[some]
    result[some, 1] = noise[some] / variance
    result[some, 2] = result[some, 0] / np.sqrt(variance)
    found.noise[some] = noise[some]
    trusted = np.ones(found.seen.points, bool)
    trusted[some] = False
    scale = np.full(found.seen.points, np.nan)
    local_scales(result[:, 2], around.wide, trusted, some, scale)
    ratio = np.abs(result[:, 2]) / np.fmax(scale, 1.0)
    gross = [screened.single[ratio[screened.single] > PART * limit]]
    gross += [
        group
        for group in screened.clusters
        if np.median(ratio[group]) > limit and not _at_edge(found, around, screened, group)
    ]
    wrong = np.unique(np.concatenate(gross))
    kept = [group[~np.isin(group, wrong)] for group in (*screened.clusters, *screened.suspects)]
    kept = [group for group in kept if len(group) and np.median(ratio[group]) > PART * limit]
    rows = [np.column_stack([group, np.full(len(group), k), result[group]]) for k, group in enumerate(kept, 1)]
    found.noise[wrong] = -1.0
    _test_near(found, some, run)
    return np.vstack([np.empty((0, 5)), *rows])


def _at_edge(found: TerrainFit, around: Neighbourhoods, screened: Screened, group: NDArray[np.int64]) -> np.bool_:
    """Whether the planes of neighbours beyond a group meet half of its points: a crest that breaks off all round."""
    near = around.points[group]
    beyond = np.where(np.isin(near, group), -1, near)
    within = MEETS_MODEL * np.abs(found.residuals[group, 0])
    return supported(found.seen, beyond, screened.slopes, group, within).mean() >= 0.5


def _test_near(found: TerrainFit, changed: NDArray[np.int64], run: Map) -> NDArray[np.int64]:
    """Test the neighbourhoods of points again whose use has changed; returns the points of them."""
    if not len(changed):
        return changed
    near = np.unique(found.neighbours.near[0].query(found.seen.xyz[changed, :2]))
    leaves = np.unique(_leaf_of(found)[near])
    unit = found.leaves.unit[leaves]
    _test_all(found, [leaves[unit == u] for u in np.unique(unit)], run)
    return near


def _flag(found: TerrainFit, around: Neighbourhoods, screened: Screened, limit: float, run: Map) -> None:
    """Flag the worst point of each neighbourhood, test the neighbourhood again, until none is left (data snooping).

    A point that fits no smooth surface may still show what the terrain is like: a ditch or a stone that no line
    describes. It is an error only if it contradicts the model by more than its neighbours do, and their planes as well.
    """
    points = found.seen.points
    cleared = np.zeros(points, bool)
    scale, changed = np.full(points, np.nan), np.arange(points)
    for _ in range(_ROUNDS):
        used = found.noise[:points] >= 0
        local_scales(found.residuals[:, 2], around.wide, used, changed, scale)
        ratio = np.where(used & ~cleared, np.abs(found.residuals[:, 2]) / np.fmax(scale, 1.0), 0.0)
        wild = np.flatnonzero(ratio > limit)
        within = MEETS_MODEL * np.abs(found.residuals[wild, 0])
        meets = supported(found.seen, around.points[wild], screened.slopes, wild, within)
        cleared[wild[meets]] = True
        wild = wild[~meets]
        near = found.neighbours.near[0].query(found.seen.xyz[wild, :2])
        flagged = wild[ratio[wild] >= np.where(cleared[near], 0.0, np.nan_to_num(ratio[near])).max(axis=1, initial=0.0)]
        if not len(flagged):
            return
        found.noise[flagged] = -1.0
        changed = _test_near(found, flagged, run)


def _whole_groups(
    found: TerrainFit, screened: Screened, suspects: NDArray[np.float64], limit: float, run: Map
) -> NDArray[np.float64]:
    """Suspects that stay: where half of a group or more is flagged, those of it that are as far off are flagged too."""
    wrong = np.zeros(found.seen.points, bool)
    wrong[found.gross] = True
    groups = [group for group in (*screened.clusters, *screened.suspects) if wrong[group].mean() >= 0.5]
    off = suspects[np.abs(suspects[:, 4]) > PART * limit, 0].astype(np.int64)
    rest = off[np.isin(off, np.concatenate([np.empty(0, np.int64), *groups])) & ~wrong[off]]
    found.noise[rest] = -1.0
    _test_near(found, rest, run)
    return suspects[~np.isin(suspects[:, 0], found.gross)]


def _leaf_of(found: TerrainFit) -> NDArray[np.int64]:
    """Leaf of every point and vertex."""
    leaf = np.empty(len(found.leaves.order), np.int64)
    leaf[found.leaves.order] = np.repeat(np.arange(len(found.leaves.half)), found.leaves.count)
    return leaf

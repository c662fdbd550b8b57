"""Covariance functions estimated from the data of each computing unit, such that points predict each other best."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from photoplan.adjustment.least_squares import solve, spread
from photoplan.codec import storable
from photoplan.kernels.prediction import block_score, sides_of, total_score
from photoplan.terrain.observations import FAMILIES, BuildSettings, Observations

#: How many of the nearest data are taken …
POINTS, LINES = 72, 56
#: … and, where these lie in a row, how many of every 8th and of every 64th.
_FURTHER = ((8, 24), (64, 16))
#: Data whose extent across is less than this part of their extent along lie in a row.
_ROW = 0.1


@dataclass(frozen=True, eq=False)
class Tree:
    """A search tree of some of the data."""

    tree: cKDTree
    numbers: NDArray[np.int64]
    """Numbers of its data."""
    count: int
    """Number of them that are taken."""

    def query(self, middles: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers of the nearest data, shape (p, count)."""
        near = self.tree.query(middles, k=np.arange(1, self.count + 1), p=np.inf)[1]
        found: NDArray[np.int64] = self.numbers[near]
        return found


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Search trees over points and over the points of lines, all of them and thinned.

    Where measurements lie in profiles, the nearest ones all lie in one row, and the slope across it is unknown; only
    there the thinned sets are asked too. Elsewhere far data would only bend the trend.
    """

    xy: NDArray[np.float64]
    """The data, shape (n, 2)."""
    near: tuple[Tree, ...]
    far: tuple[Tree, ...]

    @classmethod
    def of(cls, xy: NDArray[np.float64], points: int, order: NDArray[np.int64]) -> Neighbours:
        """Trees of data xy (n, 2), of which the first `points` are points."""
        near, far = [], []
        for numbers, most in ((order, POINTS), (np.arange(points, len(xy)), LINES)):
            if len(numbers):
                near.append(Tree(cKDTree(xy[numbers]), numbers, min(most, len(numbers))))
            for step, count in _FURTHER:
                some = numbers[step // 2 :: step]
                if len(some):
                    far.append(Tree(cKDTree(xy[some]), some, min(count, len(some))))
        return cls(xy, tuple(near), tuple(far))

    def query(self, middles: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers of the data around places (p, 2), shape (p, k); some may appear twice, −1 is none."""
        found = np.concatenate([tree.query(middles) for tree in self.near], axis=1)
        rows = _in_a_row(self.xy[found])
        if not rows.any() or not self.far:
            return found
        more = np.full((len(middles), sum(tree.count for tree in self.far)), -1, np.int64)
        more[rows] = np.concatenate([tree.query(middles[rows]) for tree in self.far], axis=1)
        return np.concatenate([found, more], axis=1)


def _in_a_row(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which sets of points (p, k, 2) are narrow."""
    centred = xy - xy.mean(axis=1, keepdims=True)
    a = (centred[..., 0] ** 2).mean(axis=1)
    b = (centred[..., 1] ** 2).mean(axis=1)
    c = (centred[..., 0] * centred[..., 1]).mean(axis=1)
    root = np.sqrt((a - b) ** 2 + 4 * c**2)
    narrow: NDArray[np.bool_] = a + b - root < _ROW**2 * (a + b + root)
    return narrow


#: Distance between the two sides of a breakline in half-value distances, by family: what is left of the correlation
#: is 6 %, 15 % and 18 %.
GAPS = (2.0, 2.0, 2.5)
#: Within a unit the terrain may be smooth here and rough there: factors of variance and length from which each patch
#: takes what suits its own points.
LADDER = ((1.0, 1.0), (1.0, 0.5), (1.0, 0.25), (1.0, 0.125), (2.0, 0.125))
#: Data of a block, blocks of a unit, and units from which the whole area's function is estimated.
_BLOCK, _BLOCKS, _UNITS = 72, 3, 48
#: A family of rougher surfaces is taken if it lowers the mean score of a block by this much, or by less if it lowers
#: that of most blocks.
_MUCH, _CLEARLY, _MOST = 1.5, 0.8, 0.55
#: A wide block takes every so-manieth of so many times as many points: it sees further.
_WIDE = 4
#: How far a unit's parameters are expected from those of the whole area: standard deviations of their logarithms.
_EXPECTED = np.array([0.5, 0.35, 0.3])
#: Bounds of the half-value distance in spacings of the points.
_SHORTEST, _LONGEST = 0.5, 30.0
#: Bound of the noise's variance, in squares of the median deviation of the heights from their mean.
_MOST_NOISE = 10.0
#: Data further than this from their block's plane, in robust standard deviations, do not count in the estimation.
_OUTLIER = 6.0


@storable
@dataclass(frozen=True)
class Covariance:
    """A covariance function: variance · correlation(distance / length), and the noise of mass points."""

    family: int
    """Number of the family, see `photoplan.terrain.fit.FAMILIES`."""
    variance: float
    """Variance of the signal, m²."""
    length: float
    """Distance at which the correlation is one half, metres."""
    noise: float
    """Standard deviation of mass points, metres: their filter value."""
    ground: float = 0.0
    """Part of the noise's variance that may be ground: what other families, weighed by their scores, do not need."""

    @property
    def name(self) -> str:
        """Name of the family."""
        return FAMILIES[self.family]

    @property
    def logs(self) -> NDArray[np.float64]:
        """Logarithms of variance, length and noise variance."""
        return np.log([self.variance, self.length, self.noise**2])


@dataclass(frozen=True, eq=False)
class _PointBlocks:
    """Data of some blocks as the likelihood takes them."""

    d2: NDArray[np.float64]
    sides: NDArray[np.float64]
    b: NDArray[np.float64]
    noise: NDArray[np.float64]


def estimate_all(
    seen: Observations, neighbours: Neighbours, members: Iterable[NDArray[np.int64]], settings: BuildSettings
) -> tuple[Covariance, ...]:
    """The covariance function of the whole area, from blocks of some of its units; of the family that predicts best.

    Where that is the smoothest of several, the next one follows: a few blocks may not meet the crests of an area.
    """
    parts = [_blocks(seen, neighbours, points) for points in _some(list(members))]
    size = min(part.b.shape[1] for part in parts)
    blocks = _join([_cut(part, size) for part in parts])
    first, bounds = _start(seen, blocks, settings)
    families = range(len(FAMILIES)) if settings.family == "auto" else [FAMILIES.index(settings.family)]
    prior = np.stack([first, np.zeros(3), *bounds])
    found: list[tuple[NDArray[np.float64], Covariance]] = []
    best = 0
    for family in families:
        scaled = blocks.sides * GAPS[family] ** 2 / 4
        logs, _ = minimise(blocks.d2, scaled, blocks.b, blocks.noise, prior, first, family)
        logs, _ = minimise(blocks.d2, scaled, blocks.b, blocks.noise, prior, logs, family)
        each = zip(blocks.d2, scaled, blocks.b, blocks.noise)
        scores = np.array([block_score(*block, np.exp(logs), family) for block in each])
        found.append((scores, _covariance(family, logs)))
        if _clearly_better(found[best][0] - scores):
            best = len(found) - 1
    few = found[best : best + (2 if best == 0 else 1)]
    return tuple(replace(one, ground=_ground(found, one.noise)) for _, one in few)


def _ground(found: list[tuple[NDArray[np.float64], Covariance]], noise: float) -> float:
    """Share of the noise's variance that may be ground, where points decide little between families."""
    scores = np.array([scores.mean() for scores, _ in found])
    weight = np.exp(scores.min() - scores)
    less = [max(0.0, 1 - (covariance.noise / noise) ** 2) for _, covariance in found]
    return float(np.average(less, weights=weight))


def _clearly_better(gain: NDArray[np.float64]) -> bool:
    """Return whether blocks gain much by a rougher family, or most of them clearly: a few ditches are no reason."""
    return bool(gain.mean() > _MUCH or (gain.mean() > _CLEARLY and (gain > 0).mean() > _MOST))


def estimate_unit(
    seen: Observations, neighbours: Neighbours, points: NDArray[np.int64], whole: Covariance, settings: BuildSettings
) -> Covariance:
    """The covariance function of one unit, drawn to that of the whole area as far as its data say little."""
    if len(points) < 10:
        return whole
    blocks = _blocks(seen, neighbours, points)
    _, bounds = _start(seen, blocks, settings)
    first = np.clip(whole.logs, *bounds)
    prior = np.stack([first, 1 / _EXPECTED**2, *bounds])
    scaled = blocks.sides * GAPS[whole.family] ** 2 / 4
    logs, _ = minimise(blocks.d2, scaled, blocks.b, blocks.noise, prior, first, whole.family)
    return _covariance(whole.family, logs)


def minimise(
    d2: NDArray[np.float64],
    sides: NDArray[np.float64],
    b: NDArray[np.float64],
    noise: NDArray[np.float64],
    prior: NDArray[np.float64],
    first: NDArray[np.float64],
    family: int,
) -> tuple[NDArray[np.float64], float]:
    """Return the logarithms of variance, length and noise that predict best, and their score.

    Blocks (k, …) and `prior` are those of `photoplan.kernels.prediction.total_score`; equal bounds hold a parameter.
    """
    # A simplex of the free parameters only: one with a corner too many in a plane collapses onto a line.
    free = np.flatnonzero(prior[3] > prior[2])

    def at(logs: NDArray[np.float64]) -> float:
        every = first.copy()
        every[free] = logs
        return float(total_score(d2, sides, b, noise, prior, every, family))

    if not len(free):
        return first, at(first[free])
    step = np.minimum(0.7, prior[3] - prior[2])
    step = np.where(first + step <= prior[3], step, -step)[free]
    simplex = first[free] + np.vstack([np.zeros(len(free)), np.diag(step)])
    ends = {"initial_simplex": simplex, "xatol": np.inf, "fatol": 0.02, "maxiter": 120, "maxfev": 10_000}
    found = minimize(at, simplex[0], method="Nelder-Mead", options=ends)
    logs = first.copy()
    logs[free] = found.x
    return logs, float(found.fun)


def ladder(covariance: Covariance) -> NDArray[np.float64]:
    """The functions that a patch chooses from, as the kernels take them, shape (len(LADDER), 4)."""
    family, variance, length = covariance.family, covariance.variance, covariance.length
    return np.array([(family, variance * v, length * c, GAPS[family]) for v, c in LADDER], float)


def _covariance(family: int, logs: NDArray[np.float64]) -> Covariance:
    variance, length, noise = np.exp(logs)
    return Covariance(family, float(variance), float(length), float(np.sqrt(noise)))


def _some(members: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """Some units with enough points, spread evenly over all; if there are none, all points as one."""
    rich = [points for points in members if len(points) >= _BLOCK]
    if not rich:
        return [np.concatenate(members)]
    return rich[:: max(1, -(-len(rich) // _UNITS))]


def _blocks(seen: Observations, neighbours: Neighbours, points: NDArray[np.int64]) -> _PointBlocks:
    """Blocks around some of the points: close ones and, last, a wide one."""
    rng = np.random.default_rng(int(points[0]) if len(points) else 0)
    middles = seen.xyz[rng.choice(points, _BLOCKS) if len(points) else [0] * _BLOCKS, :2]
    numbers = neighbours.query(middles)[:, :]
    point_tree = neighbours.near[0]
    chosen = []
    for k, middle in enumerate(middles):
        wide = _WIDE if k == _BLOCKS - 1 else 1
        lines = numbers[k][numbers[k] >= seen.points][: _BLOCK // 3]
        count = min(_BLOCK - len(lines), len(point_tree.numbers) // wide)
        near = point_tree.tree.query(middle, k=np.arange(1, max(1, count * wide) + 1), p=np.inf)[1]
        chosen.append(np.concatenate([point_tree.numbers[near[::wide]], lines])[:_BLOCK])
    size = min(len(c) for c in chosen)
    return _join([_block(seen, numbers[:size]) for numbers in chosen])


def _block(seen: Observations, numbers: NDArray[np.int64]) -> _PointBlocks:
    xyz = seen.xyz[numbers]
    xy = xyz[:, :2] - xyz[:, :2].mean(axis=0)
    d2 = ((xy[:, None] - xy[None]) ** 2).sum(axis=2)
    vertices, start = near_lines(seen, xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0))
    sides = np.zeros((len(numbers), max(1, len(start) - 1)))
    if len(start) > 1:
        sides_of(np.ascontiguousarray(xyz[:, :2]), vertices, start, len(start) - 1, sides)
    apart = ((sides[:, None] - sides[None]) ** 2).sum(axis=2)
    scale = max(float(np.sqrt(d2.max())), 1e-9)
    b = np.column_stack([xyz[:, 2] - xyz[:, 2].mean(), np.ones(len(xy)), xy / scale])
    noise = np.column_stack([seen.parts[numbers], numbers < seen.points])
    rest = -solve(b[:, 1:], b[:, 0]).residuals
    size = spread(rest, None)
    wild = np.abs(rest - np.median(rest)) > _OUTLIER * size
    if size > 0:
        noise[wild, 0] = 1e6 * size**2
    return _PointBlocks(d2[None], apart[None], b[None], noise[None])


def near_lines(
    seen: Observations, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and beginnings of the barriers whose rectangle meets a rectangle."""
    vertices, start = seen.barriers
    if len(start) < 2:
        return vertices, start
    boxes = seen.barrier_boxes
    meets = (boxes[:, :2] <= high).all(axis=1) & (boxes[:, 2:] >= low).all(axis=1)
    picked = np.flatnonzero(meets)
    parts = [vertices[start[k] : start[k + 1]] for k in picked]
    sizes = [len(part) for part in parts]
    return np.vstack([np.empty((0, 2)), *parts]), np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def _join(parts: list[_PointBlocks]) -> _PointBlocks:
    return _PointBlocks(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("d2", "sides", "b", "noise"))
    )


def _cut(blocks: _PointBlocks, size: int) -> _PointBlocks:
    return _PointBlocks(
        blocks.d2[:, :size, :size], blocks.sides[:, :size, :size], blocks.b[:, :size], blocks.noise[:, :size]
    )


def _start(
    seen: Observations, blocks: _PointBlocks, settings: BuildSettings
) -> tuple[NDArray[np.float64], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Logarithms to begin with and their bounds, from the size of the heights and the spacing."""
    size = float(np.median(np.abs(blocks.b[..., 0]))) or 1.0
    variance = size**2 + 1e-8
    low = np.log([1e-8 * variance, _SHORTEST * seen.spacing, 1e-8 * variance])
    # On level ground the whole variance is noise: 2.2 times the square of the median deviation, and more by chance.
    high = np.log([1e4 * variance, _LONGEST * seen.spacing, _MOST_NOISE * variance])
    first = np.log([0.3 * variance, 4 * seen.spacing, 0.01 * variance])
    if seen.rounding > 0:
        low[2] = min(max(low[2], 2 * np.log(seen.rounding)), high[2])
        first[2] = max(first[2], low[2])
    known = seen.known_noise
    given = settings.filters.get("mass") if known is None else known
    if given is not None:
        low[2] = first[2] = np.log(max(given, 1e-9) ** 2)
        high[2] = max(high[2], low[2]) if known else low[2]
    return first, (low, high)

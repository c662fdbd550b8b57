"""Rejection of gross errors of terrain, and estimation of covariance functions and filter values of a model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from photoplan.adjustment.least_squares import MEDIAN_1D, geman_mcclure, huber
from photoplan.events import SILENT, Events, Map
from photoplan.kernels.local_planes import (
    component_borders,
    connected_components,
    fit_planes,
    local_scales,
    neighbour_differences,
    separate_across_lines,
)
from photoplan.kernels.prediction import MOST_MISFIT, score_models, test_points
from photoplan.surfaces.units import UnitLayout
from photoplan.terrain.covariance import LADDER, Covariance, Neighbours, estimate_all, estimate_unit, ladder, near_lines
from photoplan.terrain.observations import (
    BuildSettings,
    Leaves,
    Observations,
    paraboloids,
    patches_at,
    quadtree,
    told_by,
)

#: Distances to the nearest datum in spacings, between which the logarithm of the factor is linear in their logarithm.
KNOTS = np.array([0.35, 0.7, 1.4, 2.8, 5.6])
#: Names of the classes around them, and where one ends and the next begins.
_LIMITS = np.sqrt(KNOTS[1:] * KNOTS[:-1])
#: What is expected before anything is held out, as standard deviations of the logarithm: of the factor at the first
#: knot, of its change to the next, of what a line adds, and of the power of the roughness about 1.
_LEVEL, _CHANGE, _LINE, _POWER = 0.5, 0.25, 0.4, 0.2
#: Squared normalised errors count with their logarithm beyond this.
_KNEE = 16.0
#: Half of an error is averaged noise where its standard deviation is this part of the noise of a point.
_AVERAGED = 0.5
#: Parts of the heights where the ground bends less than in the classes that follow.
_BENDS = np.array([0.8, 0.95])
#: A class is judged from so many held-out blocks.
_ENOUGH = 8


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Surroundings of places: four numbers of each, shape (n,)."""

    signal: NDArray[np.float64]
    """Share of the error that is not averaged noise, 0 to 1, see `signal_share`."""
    distance: NDArray[np.float64]
    """To the nearest datum, in spacings."""
    beside: NDArray[np.float64]
    """Nearness of a line: 1 on it, one half a spacing from it, 0 far off."""
    rough: NDArray[np.float64]
    """Mean square of the normalised residuals around."""

    @property
    def columns(self) -> NDArray[np.float64]:
        """Return what the logarithm of the factor depends on linearly, shape (n, knots + 2)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            rough = 0.5 * np.log(self.rough)
        signal = self.signal[:, None]
        return np.column_stack([signal * _hats(self.distance), self.signal * self.beside, rough])


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Data that were held out and predicted from the others."""

    error: NDArray[np.float64]
    """Predicted minus measured, shape (n,), metres."""
    sigma: NDArray[np.float64]
    """Standard deviation of the prediction before calibration, metres."""
    noise: NDArray[np.float64]
    """Variance of measuring, m², without what may be ground."""
    around: Surroundings
    """Surroundings of what was not held out."""
    block: NDArray[np.int64]
    """Number of the block that was held out together."""
    bend: NDArray[np.float64]
    """Curvature of the ground there, 1/m."""

    @property
    def weight(self) -> NDArray[np.float64]:
        """A block counts as the square root of its number, for its errors are alike; what noise hides counts little."""
        visible = self.sigma**2 / (self.sigma**2 + self.noise)
        weight: NDArray[np.float64] = visible / np.sqrt(np.bincount(self.block)[self.block])
        return weight


def joined(parts: Sequence[HeldOut]) -> HeldOut:
    """Return what was held out in several rounds."""
    first = np.cumsum([0, *(part.block.max(initial=-1) + 1 for part in parts)])
    around = (np.concatenate([getattr(part.around, f.name) for part in parts]) for f in fields(Surroundings))
    names = ("error", "sigma", "noise", "bend")
    error, sigma, noise, bend = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    block = np.concatenate([part.block + k for part, k in zip(parts, first)])
    return HeldOut(error=error, sigma=sigma, noise=noise, around=Surroundings(*around), block=block, bend=bend)


@dataclass(frozen=True)
class ClassFigures:
    """Figures of held-out points in a class of distance to data, or of curvature."""

    nearest: float
    """Distances from here, in spacings; or the part of all heights where the ground bends less, 0 to 1."""
    furthest: float
    """To here."""
    count: int
    """Heights that were held out."""
    blocks: int
    """Blocks that they are in."""
    before: float
    """Spread of the errors over what the model said, NaN: none was held out."""
    after: float
    """The same by calibrated standard deviations."""

    @property
    def enough(self) -> bool:
        """Return whether there are blocks enough to judge by."""
        return self.blocks >= _ENOUGH


@dataclass(frozen=True, eq=False)
class SigmaFactor:
    """A factor of standard deviations as a function of the surroundings."""

    coefficients: NDArray[np.float64]
    """Coefficients of its logarithm: at `KNOTS`, on a line, and the power of the roughness; shape (knots + 2,)."""
    classes: tuple[ClassFigures, ...] = ()
    """By distance."""
    bends: tuple[ClassFigures, ...] = ()
    """By how much the ground bends, which the factor does not know; the last one is where it bends most."""

    def factor(self, around: Surroundings) -> NDArray[np.float64]:
        """Return the factor of standard deviations at places, shape (n,)."""
        return np.asarray(np.exp(around.columns @ self.coefficients))


NONE = SigmaFactor(np.append(np.zeros(len(KNOTS) + 1), 1.0))
"""By the roughness alone."""


def signal_share(sigma: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """Share of an error that is not averaged noise of points of standard deviation `noise`, 0 to 1.

    A surface that is much better known than a point is a mean of many: that part of its error follows from the noise.
    """
    square = sigma**2
    return np.asarray(square / (square + (_AVERAGED * noise) ** 2 + 1e-30))


def calibrate(held: HeldOut) -> SigmaFactor:
    """The factor under which what was held out is most probable, drawn to that of the roughness alone."""
    if not len(held.error):
        return NONE
    columns, weight, knots = held.around.columns, held.weight, len(KNOTS)
    mean, expected = NONE.coefficients, np.array([_LEVEL] + [_CHANGE] * (knots - 1) + [_LINE, _POWER])
    # Neighbouring knots are alike: their differences are what is drawn to zero.
    sums = np.eye(knots + 2)
    sums[:knots, :knots] = np.tri(knots)
    columns = columns @ sums

    def objective(x: NDArray[np.float64]) -> float:
        variance = held.sigma**2 * np.exp(2 * columns @ x) + held.noise
        square = held.error**2 / variance
        square = np.where(square > _KNEE, _KNEE * (1 + np.log(np.maximum(square, _KNEE) / _KNEE)), square)
        return float((weight * (square + np.log(variance))).sum() + (((x - mean) / expected) ** 2).sum())

    found = SigmaFactor(sums @ minimize(objective, mean, method="BFGS").x)
    order = np.argsort(np.argsort(held.bend, kind="stable"), kind="stable") / len(held.bend)
    return SigmaFactor(
        found.coefficients,
        _classes(held, found, held.around.distance, np.concatenate([[0.0], _LIMITS, [np.inf]])),
        _classes(held, found, order, np.concatenate([[0.0], _BENDS, [1.0]])),
    )


def _classes(
    held: HeldOut, found: SigmaFactor, value: NDArray[np.float64], edges: NDArray[np.float64]
) -> tuple[ClassFigures, ...]:
    of_class = np.searchsorted(edges[1:-1], value, side="right")
    figures = []
    for k in range(len(edges) - 1):
        some = of_class == k
        before, after = (
            float(np.sqrt(np.average(held.error[some] ** 2 / variance[some], weights=held.weight[some])))
            if some.any()
            else np.nan
            for variance in (held.sigma**2 + held.noise, (held.sigma * found.factor(held.around)) ** 2 + held.noise)
        )
        blocks = len(np.unique(held.block[some]))
        figures.append(
            ClassFigures(
                nearest=float(edges[k]),
                furthest=float(edges[k + 1]),
                count=int(some.sum()),
                blocks=blocks,
                before=before,
                after=after,
            )
        )
    return tuple(figures)


def _hats(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the knots at distances, shape (n, knots)."""
    at = np.interp(np.log(np.maximum(distance, 1e-9)), np.log(KNOTS), np.arange(len(KNOTS)))
    hats: NDArray[np.float64] = np.maximum(1 - np.abs(at[:, None] - np.arange(len(KNOTS))), 0.0)
    return hats


#: Neighbours of a plane, those of lines beside them, and those whose misfits tell what is usual here.
_NEAR, _LINES, _WIDE = 14, 6, 32
#: Points are asked for again at most so often; each time the worst of every neighbourhood is set aside.
_ROUNDS = 40
#: Misfit beyond which a point is suspected, as a part of the limit for gross errors: the model has the last word.
PART = 0.9
#: Misfits below this part of the spacing are nothing to look at.
_FINEST = 1e-3
#: So many neighbours whose planes meet a point say that it lies at an edge: to this part of its misfit to its
#: own plane, which bends with the ground, or of its difference from the prediction of the model.
_SUPPORT, _MEETS, MEETS_MODEL = 3, 0.4, 0.2
#: Points of a cluster at most.
MOST = 20
#: Neighbours whose heights differ by more standard deviations than this do not hang together.
_HOLD = 2.0
#: Mean break around a cluster, in those standard deviations: of a gross error, of a suspect.
_CLEAR, _SUSPECT = 4.0, 3.0
#: Part of the border that breaks to the same side: of a gross error, of a suspect. And the least number of its edges.
_ROUND, _PARTLY, _EDGES = 0.95, 0.6, 6
#: A gross error is surrounded: neighbours outside leave no wider angle than this.
_OPEN = np.radians(110.0)
#: Every so-manieth point, and so many of these: the neighbourhood in which a cluster is small.
_THIN, _AROUND = 4, 25
#: Iterations of a paraboloid there, those of Huber's weights before; neighbourhoods at once.
_BENT_ROUNDS, _BENT_HUBER, _CHUNK = 6, 2, 20_000


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """Neighbours of each point on its own side of breaklines; −1: none."""

    near: NDArray[np.int32]
    """The nearest points, shape (p, 14) or fewer, then of the points of lines, shape (p, 6) or fewer: data numbers."""
    wide: NDArray[np.int32]
    """The nearest points, more of them, the nearest first."""

    @property
    def points(self) -> NDArray[np.int32]:
        """The nearest points without those of lines."""
        return np.ascontiguousarray(self.wide[:, :_NEAR])

    @classmethod
    def of(cls, seen: Observations) -> Neighbourhoods:
        """Look them up."""
        p, xy = seen.points, np.ascontiguousarray(seen.xyz[:, :2])
        wide = cKDTree(xy[:p]).query(xy[:p], k=np.arange(2, min(_WIDE + 1, p) + 1))[1].astype(np.int32)
        beside = np.empty((p, 0), np.int32)
        if len(xy) > p:
            beside = cKDTree(xy[p:]).query(xy[:p], k=np.arange(1, min(_LINES, len(xy) - p) + 1))[1].astype(np.int32) + p
        both = np.column_stack([wide, beside])
        _part(seen, both)
        wide, beside = both[:, : wide.shape[1]], both[:, wide.shape[1] :]
        wide[wide == np.arange(p)[:, None]] = -1  # where two points coincide, the first of them is not always itself
        wide = np.take_along_axis(wide, np.argsort(wide < 0, axis=1, kind="stable"), axis=1)
        return cls(np.ascontiguousarray(np.column_stack([wide[:, :_NEAR], beside])), np.ascontiguousarray(wide))


def _part(seen: Observations, near: NDArray[np.int32], chunk: int = 50_000) -> None:
    """Take neighbours beyond breaklines away."""
    vertices, start = seen.barriers
    if len(start) < 2:
        return
    last = np.zeros(len(vertices), bool)
    last[start[1:] - 1] = True
    a, b = vertices[:-1][~last[:-1]], vertices[1:][~last[:-1]]
    count = np.maximum(1, np.ceil(np.linalg.norm(b - a, axis=1) / seen.spacing).astype(int))
    part = np.repeat(np.arange(len(a)), count)
    t = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    step = ((b - a) / count[:, None])[part]
    ends = a[part] + step * t[:, None]
    ends = np.column_stack([ends, ends + step])
    tree, xy = cKDTree((ends[:, :2] + ends[:, 2:]) / 2), seen.xyz[:, :2]
    longest = float(np.linalg.norm(step, axis=1).max(initial=0.0)) / 2
    for begin in range(0, seen.points, chunk):
        some = np.arange(begin, min(begin + chunk, seen.points))
        reach = np.linalg.norm(xy[near[some]] - xy[some, None], axis=2).max(axis=1) + longest
        some, reach = (each[tree.query(xy[some])[0] <= reach] for each in (some, reach))
        found = tree.query_ball_point(xy[some], reach)
        sizes = np.array([len(f) for f in found], np.int64)
        of = np.concatenate([np.empty(0, np.int64), *(np.asarray(f, np.int64) for f in found)])
        separate_across_lines(seen.xyz, near, some, ends, of, np.concatenate([[0], np.cumsum(sizes)]))


@dataclass(frozen=True, eq=False)
class Screened:
    """Candidates for gross errors, which the model then tests."""

    single: NDArray[np.int64]
    """Points that contradict all their neighbours."""
    clusters: tuple[NDArray[np.int64], ...]
    """Groups of points whose border breaks off all round."""
    suspects: tuple[NDArray[np.int64], ...]
    """Groups whose border breaks off in part, or that lie at the edge of the data."""
    size: NDArray[np.float64]
    """By how much each of these is wrong, about, shape (points,), metres; zero: all others."""
    slopes: NDArray[np.float64]
    """Slopes of the robust plane through the neighbours of each point, x and y, shape (points, 2); NaN if unknown."""

    @property
    def all(self) -> NDArray[np.int64]:
        """All of these points."""
        return np.flatnonzero(self.size > 0)


def screen(seen: Observations, around: Neighbourhoods, limit: float) -> Screened:
    """Find candidates for gross errors by robust planes and broken borders."""
    planes = np.full((seen.points, 3), np.nan)
    used = np.ones(len(seen.xyz), bool)
    fit_planes(seen.xyz, around.near, used, np.arange(seen.points), planes)
    slopes = planes[:, 1:].copy()
    clusters, suspects, size = _clusters(seen, around.points, np.nan_to_num(slopes))
    single = _singles(seen, around, planes, slopes, used, limit)
    size[single] = np.maximum(size[single], np.abs(planes[single, 0]))
    return Screened(single=single, clusters=clusters, suspects=suspects, size=size, slopes=slopes)


def finest(seen: Observations) -> NDArray[np.float64]:
    """Least misfit to be expected of each point, shape (points,), metres: its known noise, or next to nothing."""
    known = seen.noise(np.full(len(seen.xyz), seen.known_noise or 0.0))[: seen.points]
    return np.maximum(np.sqrt(known), _FINEST * seen.spacing)


def _singles(
    seen: Observations,
    around: Neighbourhoods,
    planes: NDArray[np.float64],
    slopes: NDArray[np.float64],
    used: NDArray[np.bool_],
    limit: float,
) -> NDArray[np.int64]:
    """Points far from their neighbours' planes, the worst of each neighbourhood first; the others are asked again."""
    p = seen.points
    floor, scale = finest(seen), np.full(p, np.nan)
    asked, changed = np.arange(p), np.arange(p)
    for _ in range(_ROUNDS):
        local_scales(planes[:, 0], around.wide, used, changed, scale)
        ratio = np.abs(planes[:, 0]) / np.maximum(scale, floor)
        found = asked[used[asked] & (ratio[asked] > PART * limit)]
        within = _MEETS * np.abs(planes[found, 0])
        found = found[~supported(seen, around.points[found], slopes, found, within)]
        worst = np.zeros(p)
        worst[found] = ratio[found]
        near = around.points[found]
        best = found[ratio[found] >= np.where(near >= 0, worst[near], 0.0).max(axis=1, initial=0.0)]
        if not len(best):
            break
        used[best] = False
        near = around.wide[best]
        touched = np.unique(near[near >= 0]).astype(np.int64)
        fit_planes(seen.xyz, around.near, used, touched, planes)
        near = around.wide[touched]
        changed = np.unique(near[near >= 0]).astype(np.int64)
        asked = np.union1d(changed, found)
    return np.flatnonzero(~used[:p])


def supported(
    seen: Observations,
    near: NDArray[np.int32],
    slopes: NDArray[np.float64],
    some: NDArray[np.int64],
    within: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return whether the planes of several neighbours meet a point, as on one side of an edge without a line."""
    xyz = seen.xyz
    step = xyz[some, None] - xyz[near]
    off = step[..., 2] - (step[..., :2] * slopes[near]).sum(axis=2)
    meets = (near >= 0) & (np.abs(off) < within[:, None])
    return np.asarray(meets.sum(axis=1) >= _SUPPORT)


def _clusters(
    seen: Observations, near: NDArray[np.int32], slopes: NDArray[np.float64]
) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.int64], ...], NDArray[np.float64]]:
    """Small groups whose border breaks: all round; in part; and by how much, of each point.

    Heights break off from the slopes around, which are those of planes in the middle, or of a paraboloid. On curved
    ground the differences between neighbours are larger than a group's with the first, on rough ground groups draw the
    second along. What breaks off all round from one of them is wrong.
    """
    p = seen.points
    thin = np.arange(min(_THIN // 2, p - 1), p, _THIN)
    tree = cKDTree(seen.xyz[thin, :2])
    wide = thin[tree.query(seen.xyz[thin, :2], k=np.arange(1, min(_AROUND, len(thin)) + 1))[1]]
    at = tree.query(seen.xyz[:p, :2])[1]
    clear, partly, size = _broken(seen, near, np.median(slopes[wide], axis=1)[at], wide, at)
    bent, _, by_bent = _broken(seen, near, _bent_slopes(seen.xyz, thin, wide, at), wide, at)
    number = np.zeros(p, np.int64)
    for k, group in enumerate((*clear, *partly), 1):
        number[group] = k
    # What is known already is known as a whole: a part of it that breaks off from another slope is nothing new.
    counts = np.bincount(number, minlength=len(clear) + len(partly) + 1)
    for group in bent:
        touched = np.unique(number[group])
        touched = touched[touched > 0]
        if (touched > len(clear)).all() and counts[touched].sum() == (number[group] > 0).sum():
            clear = (*clear, group)
            number[group] = -1
            size[group] = by_bent[group]
    return clear, tuple(group for group in partly if number[group[0]] > 0), size


def _bent_slopes(
    xyz: NDArray[np.float64], thin: NDArray[np.int64], wide: NDArray[np.int64], at: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Slopes at all points, shape (p, 2), of the robust paraboloid through the heights around the nearest of `thin`."""
    found = np.empty((len(thin), 5))
    size = np.empty(len(thin))
    for begin in range(0, len(thin), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        A, size[some] = paraboloids(xyz[wide[some], :2] - xyz[thin[some], None, :2])
        z = xyz[wide[some], 2] - np.median(xyz[wide[some], 2], axis=1)[:, None]
        weight = np.ones_like(z)
        for turn in range(_BENT_ROUNDS):
            transposed = np.swapaxes(A * weight[..., None], 1, 2)
            c = np.linalg.solve(transposed @ A + 1e-6 * np.eye(6), transposed @ z[..., None])
            e = np.abs(z - (A @ c)[..., 0])
            e /= np.median(e, axis=1)[:, None] / MEDIAN_1D + 1e-300
            weight = huber(e, 1.0) if turn < _BENT_HUBER else geman_mcclure(e, 2.0)
        found[some] = c[:, 1:, 0]
    d = (xyz[: len(at), :2] - xyz[thin[at], :2]) / size[at, None]
    sx, sy, xx, xy, yy = (found[at] / size[at, None]).T
    return np.column_stack([sx + xx * d[:, 0] + xy * d[:, 1], sy + xy * d[:, 0] + yy * d[:, 1]])


def _broken(
    seen: Observations,
    near: NDArray[np.int32],
    slopes: NDArray[np.float64],
    wide: NDArray[np.int64],
    at: NDArray[np.int64],
) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.int64], ...], NDArray[np.float64]]:
    """Groups that break off from the slopes (p, 2) around all points."""
    p = seen.points
    off, middle = np.empty(near.shape), np.empty(p)
    neighbour_differences(seen.xyz, near, slopes, off, middle)
    scale = np.median(np.nan_to_num(middle)[wide], axis=1)[at] / MEDIAN_1D
    scale = np.maximum(scale, finest(seen))
    label, border = np.empty(p, np.int64), np.empty((p, 6))
    connected_components(near, off, scale, _HOLD, label)
    component_borders(near, off, scale, _HOLD, label, border)
    edges = np.maximum(border[:, 0], 1.0)
    upper = border[:, 1] >= border[:, 2]
    broken = np.where(upper, border[:, 1], border[:, 2])
    mean = np.where(upper, border[:, 3], border[:, 4]) / np.maximum(broken, 1.0)
    count = np.bincount(label, minlength=p)
    small = (count > 0) & (count <= MOST) & (border[:, 0] >= _EDGES)
    picked = small & (mean >= _SUSPECT) & (broken >= _PARTLY * edges)
    size = np.zeros(p)
    members = np.flatnonzero(picked[label])
    members = members[np.argsort(label[members], kind="stable")]
    size[members] = (border[:, 5] / edges)[label[members]]
    groups = np.split(members, np.flatnonzero(np.diff(label[members])) + 1) if len(members) else []
    clear: list[NDArray[np.int64]] = []
    partly: list[NDArray[np.int64]] = []
    for group in groups:
        k = label[group[0]]
        sure = mean[k] >= _CLEAR and broken[k] >= _ROUND * edges[k]
        (clear if sure and _surrounded(seen.xyz, group, near[group], label) else partly).append(group)
    return tuple(clear), tuple(partly), size


def _surrounded(
    xyz: NDArray[np.float64], group: NDArray[np.int64], near: NDArray[np.int32], label: NDArray[np.int64]
) -> bool:
    """Return whether the neighbours outside a group lie on all its sides."""
    outside = np.unique(near[(near >= 0) & (label[near] != label[group[0]])])
    if not len(outside):
        return False
    step = xyz[outside, :2] - xyz[group, :2].mean(axis=0)
    angle = np.sort(np.arctan2(step[:, 1], step[:, 0]))
    return bool(np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() < _OPEN)


#: A patch reaches this many half sides from the middle of its leaf (see the weights in `photoplan.kernels.prediction`).
REACH = 1.5
#: Rounds of looking for gross errors; each finds at most one in a patch.
_ROUNDS_FIT = 12
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
    """Return the mean roughness, and its weight, which falls if leaves differ by more than chance."""
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
    """Return how badly the ladder's functions predict the points of some leaves, shape (leaves, steps)."""
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
    """Return whether planes of neighbours beyond a group meet half of its points, as at a crest."""
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
    for _ in range(_ROUNDS_FIT):
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

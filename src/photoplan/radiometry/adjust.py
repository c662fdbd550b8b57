"""Tables and trends of all images at once, by least squares over all that they have in common.

Cumulative histograms of the same ground are made equal (He and Jansa 1990, in Ecker 1991, section 4.3.2), here those
of cells of the map, so that a trend over an image is found with the tables. What has changed between two images counts
less by a robust weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from photoplan.adjustment.robust import MEDIAN_1D, cauchy
from photoplan.radiometry.equations import Band, BandState
from photoplan.radiometry.priors import Prior
from photoplan.radiometry.solve import Solved

_Floats = NDArray[np.float64]

#: Residuals of this many standard deviations weigh half; 95 % of the efficiency are kept at normally distributed ones.
_HALF = 2.385
#: Least slope of a table.
_LEAST_SLOPE = 0.05
#: What a table that may not fall weighs beside the observations; their least standard deviation, part of the range.
_HARD, _FLOOR = 1e4, 0.001
#: Parts of the ground that are darker than the two grey values at which the mean of all curves is held.
_HELD = (0.1, 0.9)
_ROUNDS, _CONVERGED = 30, 1e-3
#: Observations that err together by what the model leaves out; each counts as this part of one.
_CORRELATED = 16.0
#: Observations whose equations are made at once, at least.
_AT_ONCE = 120_000
#: Parts of the ground that are left out in turn, and draws of what was known beforehand.
_PARTS, _DRAWS = 16, 64
#: Rounds in which variance components are estimated, and random vectors for a trace.
_COMPONENTS, _PROBES = 15, 16


@dataclass(frozen=True, eq=False)
class Gauge:
    """What is held, since overlaps alone do not tell it."""

    parts: NDArray[np.int64]
    """Images (n,) of one number hang together; each part gets a gauge of its own."""
    fixed: int | None = None
    """The image that stays as it is; else the mean of a part's tables changes nothing, if there is no reference."""


@dataclass(frozen=True, eq=False)
class AdjustedBand:
    """Result for one band."""

    state: BandState
    sigma: float
    """Standard deviation of a quantile of an image in a cell, grey values."""
    rounds: int
    down: float
    """Part of the observations that count less than half."""
    prior: Prior
    """With the variance components that were found."""
    errors: _Floats
    """Errors of all unknowns, (unknowns, k): their sum of squares over k is the variance."""
    prior_errors: _Floats
    """The same if there were no observations, (unknowns, k)."""
    curve_last: bool = True
    """Whether curves act after trends."""
    relative: bool = False
    """Whether only departures of the tables from their mean matter, since light becomes grey again by that mean."""

    @cached_property
    def sigmas(self) -> BandState:
        """Standard deviations of tables and trends, beside the gauge; of the ground none."""
        errors, parts, (images, nodes) = self.errors.copy(), self.prior.parts, self.state.tables.shape
        if self.relative:
            tables = errors[: images * self.state.width].reshape(images, self.state.width, -1)[:, :nodes]
            for part in np.unique(parts):
                tables[parts == part] -= tables[parts == part].mean(axis=0)
        blank = replace(self.state, ground=np.full(len(self.state.ground), np.nan))
        return blank.with_vector(np.sqrt(np.square(errors).sum(axis=1)))


@dataclass(frozen=True, eq=False)
class _Weights:
    """What counts how much at a state."""

    of: _Floats
    """Of the observations, inverse variances, (n,)."""
    ground: _Floats
    """Of what holds the ground, (groups,)."""
    moved: _Floats
    """What the ground lacks to that, (groups,)."""
    robust: _Floats
    """By the size of residuals, (n,)."""
    sigma: float


@dataclass(frozen=True, eq=False)
class _Normals:
    """Normal equations N x = g of the observations at a state, without the ground."""

    N: csr_array
    g: _Floats
    alone: _Floats
    """Step of the ground if images stay, (groups,)."""
    lost: csr_array
    """What that loses with theirs, (groups, unknowns)."""


def adjust(band: Band, gauge: Gauge, prior: Prior, *, judged: bool = True) -> AdjustedBand:
    """Tables and trends of one band."""
    images = len(gauge.parts)
    state, span = band.start(images, prior.common), float(np.ptp(band.nodes))
    H, held = _gauge(band, state, gauge)
    flat, robust = np.zeros((images, len(band.nodes) - 1), bool), np.ones(len(band.grey))
    rounds = 0
    while True:
        rounds += 1
        weights = _weigh(band, state, robust, gauge.fixed is None)
        found = _normals(band, state, weights)
        robust, x = weights.robust, state.vector
        P, wanted, component = prior.rows()
        rising, missing = _rising(band, state, flat)
        hard = _HARD * float(found.N.diagonal().max())
        N = found.N + P.T @ P + hard * (rising.T @ rising)
        solved = Solved.of(N, H)
        step = solved.step(found.g + P.T @ (wanted - P @ x) + hard * (rising.T @ missing), held - H @ x)
        state = state.with_vector(x + step)
        state = replace(state, ground=state.ground + found.alone - found.lost @ step)
        falling = np.diff(state.tables, axis=1) < _LEAST_SLOPE * band.step * (1 - 1e-6)
        done = float(np.abs(step).max()) < _CONVERGED * span and not (falling & ~flat).any()
        if done or rounds == _ROUNDS:
            break
        flat |= falling
        if rounds <= _COMPONENTS:
            prior = _with_components(prior, solved, P, wanted, component, state.vector)
    weights = _weigh(band, state, robust, gauge.fixed is None)
    errors, before = np.zeros((2, state.vector.size, 0))
    if judged:
        drawn = P.T @ np.random.default_rng(0).normal(size=(P.shape[0], _DRAWS)) / np.sqrt(_DRAWS)
        errors = np.concatenate([_without_parts(band, state, weights, solved, N), solved.step(drawn, 0.0)], axis=1)
        before = Solved.of(csr_array(P.T @ P), H).step(drawn, 0.0)
    return AdjustedBand(
        state=state,
        sigma=weights.sigma,
        rounds=rounds,
        down=float((robust < 0.5).mean()),
        prior=prior,
        errors=errors,
        prior_errors=before,
        curve_last=band.curve_last,
        relative=band.curve_last and gauge.fixed is None and not band.referred,
    )


def _with_components(
    prior: Prior, solved: Solved, P: csr_array, wanted: _Floats, component: NDArray[np.int64], x: _Floats
) -> Prior:
    """The prior with variance components re-estimated by one step of expectation and maximisation."""
    missing, rng = wanted - P @ x, np.random.default_rng(0)
    squares, counts = np.zeros((2, len(prior.sigmas)))
    for k in range(len(prior.sigmas)):
        rows = component == k
        counts[k] = rows.sum()
        if counts[k]:
            probes = rng.choice([-1.0, 1.0], (int(counts[k]), _PROBES))
            D = P[np.flatnonzero(rows)]
            trace = float((probes * (D @ solved.step(D.T @ probes, 0.0))).sum()) / _PROBES
            squares[k] = float(np.square(missing[rows]).sum()) + trace
    return replace(prior, sigmas=prior.updated(squares, counts))


def _weigh(band: Band, state: BandState, robust: _Floats, own: bool) -> _Weights:
    """Weights at a state; `own`: whether a reference holds the ground."""
    shown, slope = band.predicted(state)
    residual = band.grey - shown
    w = band.weight * robust * slope**2
    # The part of its own error that an observation shows beside the others of its group.
    size = residual / np.sqrt(np.maximum(1.0 - w / np.bincount(band.group, w)[band.group], 0.1))
    sigma = max(float(np.median(np.abs(size))) / MEDIAN_1D, _FLOOR * float(np.ptp(band.nodes)))
    robust = cauchy(size / sigma, _HALF)
    moved, share = _held(band, state, sigma) if own and band.referred else np.zeros((2, len(state.ground)))
    # The reference errs together with what is compared to it.
    share /= _CORRELATED
    of = band.weight * robust / (_CORRELATED * sigma**2)
    return _Weights(of=of, ground=share, moved=moved, robust=robust, sigma=sigma)


def _normals(band: Band, state: BandState, weights: _Weights) -> _Normals:
    """Normal equations of observations that have weights; the ground is taken out of them, cells by cells."""
    starts = np.flatnonzero(np.diff(band.cell, prepend=-1))
    firsts = starts[np.unique(np.searchsorted(starts, np.arange(0, len(band.cell), _AT_ONCE)).clip(0, len(starts) - 1))]
    found, groups = [], []
    for first, end in zip(firsts, [*firsts[1:].tolist(), len(band.cell)]):
        rows, of = np.arange(first, end), slice(int(band.group[first:end].min()), int(band.group[first:end].max()) + 1)
        some = band.some(rows)
        ground = replace(state, ground=state.ground[of])
        mine = replace(weights, of=weights.of[rows], ground=weights.ground[of], moved=weights.moved[of])
        found.append(_normals_of(replace(some, group=some.group - of.start), ground, mine))
        groups.append(np.arange(of.start, of.stop))
    N, g = found[0].N, found[0].g
    for each in found[1:]:
        N, g = N + each.N, g + each.g
    alone = np.zeros(len(state.ground))
    alone[np.concatenate(groups)] = np.concatenate([each.alone for each in found])
    return _Normals(N, g, alone, csr_array(vstack([each.lost for each in found])))


def _normals_of(band: Band, state: BandState, weights: _Weights) -> _Normals:
    """The same of some cells."""
    groups = _sums(band.group, len(state.ground))
    (shown, slope), A = band.predicted(state), band.design(state)
    residual, w = band.grey - shown, weights.of
    total = np.maximum(groups @ (w * slope**2) + weights.ground, 1e-300)
    pull = groups @ (w * slope * residual) + weights.ground * weights.moved
    B = _scaled(A, w)
    lost = _scaled(groups @ _scaled(B, slope), 1 / total)
    N = A.T @ B - lost.T @ _scaled(lost, total)
    return _Normals(N, B.T @ residual - lost.T @ pull, pull / total, lost)


def _held(band: Band, state: BandState, sigma: float) -> tuple[_Floats, _Floats]:
    """What ground lacks to the reference, and what that weighs."""
    share = np.bincount(band.group, band.weight) / np.bincount(band.group)
    moved = band.beside_reference(state)
    known = np.isfinite(moved)
    moved[~known] = 0.0
    least = max(float(np.median(np.abs(moved[known]))) / MEDIAN_1D, sigma)
    return moved, np.where(known, share * cauchy(moved / least, _HALF), 0.0) / least**2


def _scaled(A: csr_array, by: _Floats) -> csr_array:
    """A matrix with its rows multiplied; without the copies of its indices that the library makes."""
    return csr_array((A.data * np.repeat(by, np.diff(A.indptr)), A.indices, A.indptr), shape=A.shape)


def _sums(of: NDArray[np.int64], count: int) -> csr_array:
    """The matrix that adds up observations of one number, of `count` numbers."""
    starts = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=count))])
    order = np.argsort(of, kind="stable")
    parts = np.ones(len(of)), order.astype(np.int32), starts.astype(np.int32)
    return csr_array(parts, shape=(count, len(of)))


def _gauge(band: Band, state: BandState, gauge: Gauge) -> tuple[_Floats, _Floats]:
    """Conditions H x = held on the unknowns of the images."""
    nodes, width = state.tables.shape[1], state.width
    rows: list[_Floats] = []
    held: list[float] = []
    for part in np.unique(gauge.parts):
        members = np.flatnonzero(gauge.parts == part)
        fixed = members[members == gauge.fixed]
        if band.referred and not len(fixed):
            continue
        used = fixed if len(fixed) else members
        # Where curves act last, fall-off is multiplied in light: overlaps determine the mean curve but for two values.
        few = band.curve_last and not len(fixed)
        k = np.clip(np.searchsorted(band.nodes, np.quantile(band.own, _HELD)), 1, nodes - 2)
        for node in np.unique(k).tolist() if few else range(nodes):
            row = np.zeros(state.vector.size)
            row[used * width + node] = 1 / len(used)
            rows.append(row)
            held.append(float(band.nodes[node]))
    return np.array(rows).reshape(-1, state.vector.size), np.array(held)


def _rising(band: Band, state: BandState, flat: NDArray[np.bool_]) -> tuple[csr_array, _Floats]:
    """Tables that may not fall: their rises as rows, and what these lack."""
    width = state.width
    image, k = np.nonzero(flat)
    first, n = image * width + k, len(image)
    columns = np.stack([first, first + 1], axis=1).ravel()
    rows = csr_array((np.tile([-1.0, 1.0], n), columns, np.arange(0, 2 * n + 1, 2)), shape=(n, state.vector.size))
    return rows, _LEAST_SLOPE * band.step - np.diff(state.tables, axis=1)[image, k]


def _without_parts(band: Band, state: BandState, weights: _Weights, solved: Solved, N: csr_array) -> _Floats:
    """Errors of the unknowns, (n, parts), by what they become without a part of the ground (Tukey 1958).

    What lies near each other errs together; so parts are blocks of cells, drawn by lot, where there are enough.
    """
    unit = band.block if band.block.max() + 1 >= _PARTS else band.cell
    units = int(unit.max()) + 1
    # Of a narrow block the cells may be fewer than parts.
    count = min(_PARTS, units)
    part = np.random.default_rng(0).permutation(units) % count
    of, ground = part[unit], np.zeros(len(state.ground), np.int64)
    ground[band.group] = of
    moved = np.zeros((count, state.vector.size))
    if count < 2:
        return moved.T
    for k in range(count):
        rows = np.flatnonzero(of == k)
        some = replace(weights, of=weights.of[rows], ground=weights.ground * (ground == k))
        one = _normals(band.some(rows), state, some)
        moved[k] = solved.without(one.N, N, -one.g)
    # What residuals change with the unknowns under robust weights, beside what the weights alone say.
    kept = max(float(np.mean(2 * weights.robust**2 - weights.robust) / np.mean(weights.robust)), 0.2)
    moved /= kept
    return np.asarray(np.sqrt((count - 1) / count) * (moved - moved.mean(axis=0)).T)

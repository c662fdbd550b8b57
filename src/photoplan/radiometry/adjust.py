"""Tables and trends of all images at once, by least squares over all that they have in common.

Cumulative histograms of the same ground are made equal (He and Jansa 1990, in Ecker 1991, section 4.3.2), here those
of cells of the map, so that a trend over an image is found with the tables. What has changed between two images counts
less by a robust weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array, eye_array, kron
from scipy.sparse.linalg import SuperLU, splu

from photoplan.adjustment.robust import MEDIAN_1D, huber
from photoplan.radiometry.equations import Band, State

_Floats = NDArray[np.float64]

#: Residuals beyond this many standard deviations lose influence.
_HUBER = 3.0
#: Standard deviations of what is known of tables and trends beforehand: the bend between two intervals of a table in
#: parts of the range of grey values, slopes, coefficients of a trend.
_BEND, _SLOPE, _TREND = 0.02, 1.0, 0.25
#: That the ground is what images show in the mean, counts where nothing else tells: as an observation of so many
#: standard deviations, and of so many times what the block moves by.
_OWN, _MOVES = 8.0, 2.0
#: Least slope of a table.
_LEAST_SLOPE = 0.05
#: What a table that may not fall weighs beside the observations; their least standard deviation, part of the range.
_HARD, _FLOOR = 1e4, 0.001
_ROUNDS, _CONVERGED = 30, 1e-3
#: Unknowns whose standard deviations are computed at once.
_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Gauge:
    """What is held, since overlaps alone do not tell it."""

    parts: NDArray[np.int64]
    """Images (n,) of one number hang together; each part gets a gauge of its own."""
    fixed: int | None = None
    """The image that stays as it is; elsewhere the mean of a part's tables changes nothing."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result for one band."""

    state: State
    sigmas: State
    """Standard deviations of tables and trends, beside the gauge; of the ground none."""
    sigma: float
    """Standard deviation of a quantile of an image in a cell, grey values."""
    rounds: int
    down: float
    """Part of the observations that count less."""


@dataclass(frozen=True, eq=False)
class _Normals:
    """Normal equations N x = g of the observations at a state, without the ground."""

    N: csr_array
    g: _Floats
    pulls: csr_array
    """What each observation pulls at the unknowns (n, unknowns)."""
    ground: tuple[_Floats, csr_array]
    """Step of the ground (groups,) if images stay, and what it loses with theirs (groups, unknowns)."""
    robust: _Floats
    """Weights by the size of residuals, (n,)."""
    sigma: float


def adjust(band: Band, gauge: Gauge) -> Adjusted:
    """Tables and trends of one band.

    Parameters
    ----------
    band : Band
        Of cells that more than one image shows; every image is in some.
    gauge : Gauge
    """
    images = len(gauge.parts)
    state, span = band.start(images), float(np.ptp(band.nodes))
    prior, wanted = _prior(band, state)
    H, held = _gauge(band, state, gauge)
    flat, robust = np.zeros((images, len(band.nodes) - 1), bool), np.ones(len(band.grey))
    rounds = 0
    while True:
        rounds += 1
        found = _normals(band, state, robust, gauge.fixed is None)
        robust, x = found.robust, state.vector
        rising, missing = _rising(band, state, flat)
        hard = _HARD * float(found.N.diagonal().max())
        N = found.N + prior.T @ prior + hard * (rising.T @ rising)
        solved = _Solved.of(splu(N.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}), H)
        step = solved.step(found.g + prior.T @ (wanted - prior @ x) + hard * (rising.T @ missing), held - H @ x)
        alone, lost = found.ground
        state = state.with_vector(x + step)
        state = State(state.tables, state.trends, state.ground + alone - lost @ step)
        falling = np.diff(state.tables, axis=1) < _LEAST_SLOPE * band.step * (1 - 1e-6)
        done = float(np.abs(step).max()) < _CONVERGED * span and not (falling & ~flat).any()
        if done or rounds == _ROUNDS:
            break
        flat |= falling
    sigmas = _sigmas(solved, _sums(band.cell) @ found.pulls, prior, state)
    return Adjusted(state, sigmas, found.sigma, rounds, float((robust < 1).mean()))


def _normals(band: Band, state: State, robust: _Floats, own: bool) -> _Normals:
    """Normal equations; `own`: whether the images' own mean counts where nothing else tells."""
    groups = _sums(band.group)
    shown, slope, A = band.predicted(state)
    residual = band.grey - shown
    w = band.weight * robust
    # The part of its own error that an observation shows beside the others of its group.
    total = groups @ (w * slope**2)
    size = residual / np.sqrt(np.maximum(1.0 - w * slope**2 / total[band.group], 0.1))
    sigma = max(float(np.median(np.abs(size))) / MEDIAN_1D, _FLOOR * float(np.ptp(band.nodes)))
    robust = huber(size / sigma, _HUBER)
    w = band.weight * robust / sigma**2
    total, pull = groups @ (w * slope**2), groups @ (w * slope * residual)
    if own:
        moved = band.own - state.ground
        least = max(_OWN * sigma, _MOVES * float(np.sqrt(np.mean(moved**2))))
        share = np.bincount(band.group, band.weight) / np.bincount(band.group) / least**2
        total, pull = total + share, pull + share * moved
    B = A.multiply(w[:, None]).tocsr()
    lost = (groups @ B.multiply(slope[:, None]).tocsr()).multiply(1 / total[:, None]).tocsr()
    alone = pull / total
    N = A.T @ B - lost.T @ lost.multiply(total[:, None])
    g = B.T @ residual - lost.T @ pull
    after = residual - slope * alone[band.group]
    return _Normals(N, g, B.multiply(after[:, None]).tocsr(), (alone, lost), robust, sigma)


def _sums(of: NDArray[np.int64]) -> csr_array:
    """The matrix that adds up observations of one number."""
    n = len(of)
    return csr_array((np.ones(n), (of, np.arange(n))), shape=(int(of.max()) + 1, n))


def _prior(band: Band, state: State) -> tuple[csr_array, _Floats]:
    """What is known of an image beforehand, as equations of weight one, the same for all."""
    (images, nodes), terms = state.tables.shape, state.trends.shape[1]
    bend = np.diff(np.eye(nodes), 2, axis=0) / (_BEND * np.ptp(band.nodes))
    slope = np.diff(np.eye(nodes), axis=0) / (_SLOPE * band.step)
    one = np.concatenate([bend, slope])
    wanted = np.r_[np.zeros(nodes - 2), np.full(nodes - 1, 1.0 / _SLOPE), np.zeros(terms)]
    whole = block_diag([one, np.eye(terms) / _TREND]) if terms else one
    return csr_array(kron(eye_array(images), whole)), np.tile(wanted, images)


def _gauge(band: Band, state: State, gauge: Gauge) -> tuple[_Floats, _Floats]:
    """Conditions H x = held on the unknowns of the images."""
    (images, nodes), width = state.tables.shape, state.width
    rows: list[_Floats] = []
    held: list[float] = []
    for part in np.unique(gauge.parts):
        members = np.flatnonzero(gauge.parts == part)
        fixed = members[members == gauge.fixed]
        used = fixed if len(fixed) else members
        for k in range(width if len(fixed) else nodes):
            row = np.zeros((images, width))
            row[used, k] = 1 / len(used)
            rows.append(row.ravel())
            held.append(float(band.nodes[k]) if k < nodes else 0.0)
    return np.array(rows), np.array(held)


def _rising(band: Band, state: State, flat: NDArray[np.bool_]) -> tuple[csr_array, _Floats]:
    """Tables that may not fall: their rises as rows, and what these lack."""
    (images, _), width = state.tables.shape, state.width
    image, k = np.nonzero(flat)
    first, n = image * width + k, len(image)
    columns = np.stack([first, first + 1], axis=1).ravel()
    rows = csr_array((np.tile([-1.0, 1.0], n), columns, np.arange(0, 2 * n + 1, 2)), shape=(n, images * width))
    return rows, _LEAST_SLOPE * band.step - np.diff(state.tables, axis=1)[image, k]


@dataclass(frozen=True, eq=False)
class _Solved:
    """Normal equations, factored, under the conditions of the gauge."""

    factors: SuperLU
    H: _Floats
    W: _Floats
    """N⁻¹ Hᵀ."""

    @classmethod
    def of(cls, factors: SuperLU, H: _Floats) -> _Solved:
        return cls(factors, H, factors.solve(np.ascontiguousarray(H.T)))

    def step(self, g: _Floats, missing: _Floats | float) -> _Floats:
        """Solutions for right sides (unknowns,) or (unknowns, k) that fulfil the conditions."""
        free = self.factors.solve(g)
        return np.asarray(free + self.W @ np.linalg.solve(self.H @ self.W, missing - self.H @ free))


def _sigmas(solved: _Solved, pulls: csr_array, prior: csr_array, state: State) -> State:
    """Standard deviations of the unknowns: by how cells differ (White 1980), since the quantiles of one do not err
    independently, and by what was known beforehand."""
    count = pulls.shape[1]
    found = np.empty(count)
    for first in range(0, count, _AT_ONCE):
        columns = np.arange(first, min(first + _AT_ONCE, count))
        unit = np.zeros((count, len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        x = solved.step(unit, 0.0)
        found[columns] = np.sqrt(((pulls @ x) ** 2).sum(axis=0) + ((prior @ x) ** 2).sum(axis=0))
    return State(state.tables, state.trends, np.full(len(state.ground), np.nan)).with_vector(found)

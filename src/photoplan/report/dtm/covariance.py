"""Fitted covariance functions beside what the data show: is the stochastic model that of these points?"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.sides import sides_of
from photoplan.terrain.covariance import Covariance, near_lines
from photoplan.terrain.fit import TerrainFit
from photoplan.terrain.settings import FAMILIES

#: Neighbourhoods that are looked at, points of each, and classes of distance.
_BLOCKS, _POINTS, _CLASSES = 160, 60, 14
#: So many times as many neighbourhoods are tried, since breaklines part some.
_ROUNDS = 8
#: Squared difference of side coordinates from which points lie on two sides of a breakline; 4 across its middle.
_PARTED = 0.4
#: Factor between measured and expected covariances that is told. One field of known covariance scatters by 1.4.
_DIFFER = 2.0
#: Argument at which (1 + t) exp(−t) is one half.
_MATERN_HALF = 1.6783469900166605


@dataclass(frozen=True, eq=False)
class CovarianceTest:
    """Covariance over distance: what was fitted, and what the data show."""

    distance: NDArray[np.float64]
    """Shape (n,), metres, from 0."""
    whole: NDArray[np.float64]
    """The function of the whole area, shape (n,), m²."""
    low: NDArray[np.float64]
    """The tenth and the ninetieth of a hundred units at each distance, shape (n,), m²."""
    high: NDArray[np.float64]
    classes: NDArray[np.float64]
    """Mean distance of the pairs of each class, shape (k,), metres."""
    empirical: NDArray[np.float64]
    """Mean product of the pairs' residuals from a plane, shape (k,), m²; NaN: no pairs."""
    expected: NDArray[np.float64]
    """What the fitted functions let expect of these means, shape (k,), m²."""
    pairs: NDArray[np.int64]
    """Pairs in each class, shape (k,)."""

    noise: float = 0.0
    """Variance of the noise of mass points, m²: what is smaller cannot be told from it."""

    @property
    def ratio(self) -> float:
        """Factor by which the means are those expected, by least squares over all classes; NaN: no pairs."""
        known = np.isfinite(self.empirical) & np.isfinite(self.expected)
        weight = self.pairs[known] * self.expected[known]
        scale = float((weight * self.expected[known]).sum())
        return float((weight * self.empirical[known]).sum()) / scale if scale > 0 else np.nan

    @property
    def warning(self) -> str:
        """What to say where measured and expected covariances differ by more than chance and noise; or empty."""
        first = int(np.argmax(self.pairs > 0))
        measured, expected = float(self.empirical[first]), float(self.expected[first])
        if not abs(measured - expected) > self.noise / 2 or 1 / _DIFFER <= self.ratio <= _DIFFER:
            return ""
        return (
            f"the covariance of neighbouring points is {measured:.3g} m² where the fitted functions let expect "
            f"{expected:.3g} m²: they are fitted to predict points from their neighbours, but in gaps and at edges "
            f"standard deviations may be too {'large' if self.ratio < 1 else 'small'}"
        )


def correlation_at(family: str, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation at distances in half-value distances: ½ at 1."""
    if family == "gaussian":
        return np.asarray(np.exp(-np.log(2) * t**2))
    if family == "matern":
        return np.asarray((1 + _MATERN_HALF * t) * np.exp(-_MATERN_HALF * t))
    return np.asarray(np.exp(-np.log(2) * t))


def covariance_test(fit: TerrainFit) -> CovarianceTest:
    """Fitted functions over distance, and the covariance of the points' heights above local planes.

    A plane through a neighbourhood takes a part of the signal with it. So the fitted functions are not compared with
    the products of residuals r = P z themselves, but their expectation is, P (C + N) Pᵀ. Neighbourhoods that
    breaklines part are left out: the functions let their two sides differ as they like, and it is the points of the
    line that tie them together.
    """
    reach = 4.0 * fit.whole.length
    distance = np.linspace(0.0, reach, 81)
    curves = np.array([_curve(unit, distance) for unit, m in zip(fit.units, fit.members) if len(m) >= 10])
    if not len(curves):
        curves = _curve(fit.whole, distance)[None]
    low, high = np.percentile(curves, [10, 90], axis=0)
    blocks = (_block(fit, leaf) for leaf in _leaves(fit))
    pairs = list(itertools.islice((block for block in blocks if len(block[0])), _BLOCKS))
    d, product, expected = (
        (np.concatenate([np.empty(0), *parts]) for parts in zip(*pairs)) if pairs else [np.empty(0)] * 3
    )
    edge = float(np.percentile(d, 90)) if len(d) else reach
    number = np.clip((d / edge * _CLASSES).astype(int), 0, _CLASSES)
    count = np.bincount(number, minlength=_CLASSES + 1)[:_CLASSES]

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        with np.errstate(invalid="ignore"):
            return np.asarray(np.bincount(number, values, minlength=_CLASSES + 1)[:_CLASSES] / count)

    return CovarianceTest(
        distance=distance,
        whole=_curve(fit.whole, distance),
        low=low,
        high=high,
        classes=mean(d),
        empirical=mean(product),
        expected=mean(expected),
        pairs=count,
        noise=fit.whole.noise**2,
    )


def _curve(covariance: Covariance, distance: NDArray[np.float64]) -> NDArray[np.float64]:
    return covariance.variance * correlation_at(covariance.name, distance / covariance.length)


def _leaves(fit: TerrainFit) -> list[int]:
    """Leaves that hold points, in an order in which the first of them already cover the area evenly."""
    rich = np.flatnonzero(fit.leaves.count >= 3)
    step = max(1, -(-len(rich) // _BLOCKS))
    return [leaf for first in range(min(step, _ROUNDS)) for leaf in rich[first::step].tolist()]


def _block(fit: TerrainFit, leaf: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Distances of all pairs of a neighbourhood's points, products of their residuals, and these products' means."""
    seen = fit.seen
    tree = fit.neighbours.near[0]
    near = np.atleast_1d(tree.tree.query(fit.leaves.middle[leaf], k=min(_POINTS, len(tree.numbers)))[1])
    some = tree.numbers[near]
    some = some[(some < seen.points) & (fit.noise[some] >= 0)]
    if len(some) < 8:
        return np.empty(0), np.empty(0), np.empty(0)
    xy = seen.xyz[some, :2]
    if _apart(fit, xy).max() > _PARTED:
        return np.empty(0), np.empty(0), np.empty(0)
    centred = xy - xy.mean(axis=0)
    plane = np.column_stack([np.ones(len(xy)), centred / max(float(np.abs(centred).max()), 1e-9)])
    q = np.linalg.qr(plane)[0]
    without = np.eye(len(xy)) - q @ q.T
    r = without @ (seen.xyz[some, 2] - seen.xyz[some, 2].mean())
    expected = without @ (_matrix(fit, leaf, xy) + np.diag(fit.noise[some])) @ without
    first, second = np.triu_indices(len(xy), 1)
    d = np.hypot(*(xy[first] - xy[second]).T)
    return d, r[first] * r[second], expected[first, second]


def _apart(fit: TerrainFit, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared differences of the side coordinates of places (n, 2): not zero where breaklines part them."""
    vertices, start = near_lines(fit.seen, xy.min(axis=0), xy.max(axis=0))
    sides = np.zeros((len(xy), max(1, len(start) - 1)))
    if len(start) > 1:
        sides_of(np.ascontiguousarray(xy), vertices, start, len(start) - 1, sides)
    return np.asarray(((sides[:, None] - sides[None]) ** 2).sum(axis=2))


def _matrix(fit: TerrainFit, leaf: int, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariances of the signal at places (n, 2), by the functions that the leaf's patch uses."""
    d2 = ((xy[:, None] - xy[None]) ** 2).sum(axis=2)
    apart = _apart(fit, xy)
    total = np.zeros_like(d2)
    for share, (family, variance, length, gap) in zip(fit.shares[leaf], fit.models(np.array([leaf]))[0]):
        t = np.sqrt(d2 / length**2 + apart * gap**2 / 4)
        total += share * variance * correlation_at(FAMILIES[int(family)], t)
    return total

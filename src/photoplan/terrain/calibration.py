"""Standard deviations judged by what was held out: a factor by the distance to data and the roughness around."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

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

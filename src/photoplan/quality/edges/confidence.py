"""Figures of a line spread function with standard deviations and intervals from repeated profiles."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, nan, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from photoplan.quality.edges.profile import EdgeFit
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.spread import GAUSSIAN_WIDTH

#: Line spread function and edge profile are looked at this densely: lines for each standard deviation.
DENSITY = 25
#: Reach, in standard deviations of the trend, within which width, over- and undershoot are looked for.
REACH = 8.0
#: Standard deviation of the light beyond the window, relative to what is estimated by the square of the distance: 95 %
#: reach from none of it, as where a bell ends, to twice as much.
BEYOND = 0.5
#: Frequencies for each cycle per pixel at which the transfer function is computed.
FREQUENCIES = 128


@dataclass(frozen=True, eq=False)
class EdgeShape:
    """Linear maps from the coefficients of a profile, and from light beyond the window, to what is read from it.

    That light is half of it on each side, so far away that only the levels and the modulation at frequency 0 have it;
    it is never less than none.
    """

    at: NDArray[np.float64]
    edge: NDArray[np.float64]
    ends: NDArray[np.float64]
    line: NDArray[np.float64]
    frequency: NDArray[np.float64]
    transfer: NDArray[np.complex128]
    steps: NDArray[np.float64]
    tails: NDArray[np.float64]

    @classmethod
    def of(cls, fit: EdgeFit, highest: float) -> EdgeShape:
        """Maps for a fit, with frequencies up to the highest one that its pixels determine."""
        basis = fit.basis
        spacing = basis.model.total / DENSITY
        low = max(basis.low, -REACH * basis.model.total)
        high = min(basis.high, REACH * basis.model.total)
        at = np.linspace(low, high, int((high - low) / spacing) + 2)
        frequency = np.linspace(0.0, highest, max(2, round(highest * FREQUENCIES) + 1))
        far = (np.full(at.size, 0.5), np.zeros(at.size), (frequency == 0.0) + 0.0j, 1.0)
        near = (basis.edge(at), basis.line(at), basis.transfer(frequency), basis.steps)
        edge, line, transfer, steps = (np.append(a, np.expand_dims(b, -1), axis=-1) for a, b in zip(near, far))
        ends = np.append(basis.edge(np.array([basis.low, basis.high])), [[0.5], [0.5]], axis=-1)
        return cls(
            at=at,
            edge=edge,
            ends=ends,
            line=line,
            frequency=frequency,
            transfer=transfer,
            steps=steps,
            tails=np.append(basis.tails, 1.0),
        )

    def allowed(self, shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coefficients (k, size + 1) with what makes negative tails none."""
        filled = shapes.copy()
        filled[:, -1] += np.maximum(0.0, -(shapes @ self.tails))
        return filled

    def modulation(self, shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Modulation (k, frequencies) of coefficients (k, size + 1): 1 at frequency 0."""
        return np.asarray(np.abs(shapes @ self.transfer.T) / (shapes @ self.steps)[:, None])

    def figures(self, shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """MTF50, MTF10, FWHM, overshoot, undershoot, modulation at 0.5: shape (k, 6) for coefficients (k, size + 1)."""
        step = (shapes @ self.steps)[:, None]
        edges, ends, lines = (shapes @ each.T / step for each in (self.edge, self.ends, self.line))
        rows = []
        for edge, end, line, curve in zip(edges, ends, lines, self.modulation(shapes)):
            mtf = MtfCurve(self.frequency, curve)
            over, under = _beyond(self.at, edge, end)
            rows.append([mtf.mtf50, mtf.mtf10, _width(self.at, line), over, under, mtf.at(0.5)])
        return np.array(rows)


@dataclass(frozen=True, eq=False)
class EdgeFigures:
    """What `edge_figures` returns; standard deviations and intervals as in `EdgeMeasurement`."""

    values: NDArray[np.float64]
    sigma: NDArray[np.float64]
    modulation: NDArray[np.float64]
    modulation_sigma: NDArray[np.float64]
    factor: float
    """How many standard deviations the interval reaches to each side."""
    freedom: int
    """Degrees of freedom of the intervals."""

    def interval(self, which: int) -> tuple[float, float]:
        """Interval of a figure; NaN where it would reach 0 or below, so that the pixels do not determine the figure."""
        value, reach = float(self.values[which]), self.factor * float(self.sigma[which])
        return (value - reach, value + reach) if reach < value else (np.nan, np.nan)


def edge_figures(fit: EdgeFit, shape: EdgeShape, confidence: float) -> EdgeFigures:
    """Figures of a profile and their standard deviations.

    The edge is split along its length into blocks, each of which is a profile of its own. The spread between the
    figures with one block left out (jackknife; Efron and Tibshirani 1993, eq. 11.5) holds noise of any distribution
    and correlation within a block. It cannot hold what the prior hides in all blocks alike, which is added: the change
    of a figure in each direction in which the shape may differ unseen, and by the light beyond the window (`BEYOND`).
    Intervals use Student's distribution with one degree of freedom less than blocks.
    """
    blocks = fit.left_out.shape[0]
    unseen = np.zeros((fit.hidden.shape[0] + 1, fit.shape.size + 1))
    unseen[:-1, :-1] = fit.hidden
    unseen[-1, -1] = BEYOND * fit.beyond[0] * fit.step
    known = np.pad(np.vstack([fit.shape, fit.left_out]), ((0, 0), (0, 1)))
    all_shapes = shape.allowed(np.concatenate([known, known[:1] + unseen, known[:1] - unseen]))
    figures, curves = shape.figures(all_shapes), shape.modulation(all_shapes)
    sigma = _spread(figures, blocks)
    factor = float(stdtrit(blocks - 1, 0.5 + confidence / 2))
    return EdgeFigures(
        values=figures[0],
        sigma=sigma,
        modulation=curves[0],
        modulation_sigma=_spread(curves, blocks),
        factor=factor,
        freedom=blocks - 1,
    )


def gaussian_width(mtf50: float) -> float:
    """FWHM of the Gaussian with the same frequency at half modulation, pixels."""
    return GAUSSIAN_WIDTH * sqrt(log(2.0) / 2.0) / (pi * mtf50) if mtf50 > 0.0 else nan


def _spread(values: NDArray[np.float64], blocks: int) -> NDArray[np.float64]:
    left_out = values[1 : blocks + 1]
    hidden = (values.shape[0] - blocks - 1) // 2
    plus, minus = values[blocks + 1 : blocks + 1 + hidden], values[blocks + 1 + hidden :]
    jackknife = (blocks - 1) / blocks * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(jackknife + (((plus - minus) / 2.0) ** 2).sum(axis=0)))


def _width(at: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Distance between the outermost crossings of half the maximum; NaN if a side does not fall so low."""
    top = int(np.argmax(line))
    half = _peak(line, top) / 2.0
    above = np.flatnonzero(line >= half)
    if half <= 0.0 or above.size == 0 or above[0] == 0 or above[-1] == line.size - 1:
        return nan
    a, b = int(above[0]) - 1, int(above[-1]) + 1
    start = at[a] + (half - line[a]) / (line[a + 1] - line[a]) * (at[a + 1] - at[a])
    end = at[b] - (half - line[b]) / (line[b - 1] - line[b]) * (at[b] - at[b - 1])
    return float(end - start)


def _peak(line: NDArray[np.float64], top: int) -> float:
    """Height of the parabola through the largest value and its neighbours."""
    if top in (0, line.size - 1):
        return float(line[top])
    left, middle, right = line[top - 1 : top + 2]
    curvature = 2.0 * middle - left - right
    return float(middle + (right - left) ** 2 / (8.0 * curvature)) if curvature > 0.0 else float(middle)


def _beyond(at: NDArray[np.float64], edge: NDArray[np.float64], ends: NDArray[np.float64]) -> tuple[float, float]:
    """How far the profile rises above what it is at the bright end, and falls below the dark one; not below 0."""
    bright, dark = edge[at > 0.0], edge[at < 0.0]
    over = float(bright.max() - ends[1]) if bright.size else 0.0
    under = float(ends[0] - dark.min()) if dark.size else 0.0
    return max(over, 0.0), max(under, 0.0)

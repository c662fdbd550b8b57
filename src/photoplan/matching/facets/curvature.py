"""Adaptive regularisation: curvatures of the heights as observations whose variances are estimated.

A second difference of the heights is observed to be zero (Wrobel, Kaiser and Hausladen 1992). How little that says,
its variance, is a component estimated from the heights themselves, in patches and for each direction, since terrain is
rough here and smooth there. Differences follow Student's distribution, which lets breaklines be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_Doubles = NDArray[np.float64]

#: Posts along a patch that has its own variances.
_PATCH = 16
#: Degrees of freedom of the curvatures.
_FREEDOM = 4.0
#: Redundancy with which the mean of a block takes part in the variance of each patch.
_ENOUGH = 10.0


#: Posts over which second differences are taken.
SPANS = (1, 2, 4, 8)


@dataclass(frozen=True, eq=False)
class Known:
    """Variances of second differences of heights, as they come out of an adjustment."""

    single: _Doubles
    """Of each, shape (3, rows, columns); 0: unknown."""
    wide: _Doubles
    """Mean of those over each of `SPANS`."""


@dataclass(frozen=True, eq=False)
class Roughness:
    """Curvatures along columns, along rows and across, at the posts of a block."""

    squares: _Doubles
    """Their variances, shape (3, rows, columns), m²."""
    factors: _Doubles
    """Robust factors of their weights, the same shape; 0 where a curvature is not inside."""

    @classmethod
    def uniform(cls, shape: tuple[int, int], sigma: float) -> Roughness:
        """One standard deviation everywhere, metres."""
        return cls(np.full((3, *shape), sigma**2), _inside(shape).astype(float))

    @property
    def weights(self) -> _Doubles:
        """Of the curvatures, shape (3, rows, columns)."""
        return self.factors / self.squares

    def gradient(self, heights: _Doubles) -> _Doubles:
        """Half the gradient of the weighted sum of their squares, shape (rows, columns)."""
        c, out = self.weights * curvatures(heights), np.zeros_like(heights)
        for shift, a in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            out += a * np.roll(c[0], shift, axis=1) + a * np.roll(c[1], shift, axis=0)
        for k in range(4):
            out += (1.0 if k in (0, 3) else -1.0) * np.roll(c[2], (k // 2, k % 2), axis=(0, 1))
        return out

    def smoothing(self, weights: _Doubles) -> float:
        """Posts over which a surface is smoothed, from the weights that pixels give to the heights (rows, columns):
        the fourth root of what a curvature weighs in them."""
        known = weights > 0
        if not known.any():
            return float(SPANS[-1])
        return float(np.median((weights * self.squares.mean(axis=0))[known]) ** -0.25)

    def estimated(self, heights: _Doubles, known: Known, weights: _Doubles) -> Roughness:
        """Variances from heights and how well they are known: Σ f c² / Σ (1 − var/σ²) (Förstner 1979).

        Differences are taken as far apart as the surface is smoothed (`smoothing`, from the `weights` of the heights):
        if curvatures are correlated, as those of terrain are, it is their sum over this length that a weight too
        large would take away, and that a standard deviation has to tell.
        """
        k = int(np.argmin(np.abs(np.log(SPANS) - np.log(max(self.smoothing(weights), 1e-9)))))
        span = SPANS[k]
        c, inside = curvatures(heights, span), _inside(self.factors.shape[1:], span)
        sums = np.array([(2 * span**3 + span) / 3] * 2 + [span**2])[:, None, None]
        normal = np.where(inside, c**2 / (sums * self.squares), 0.0)
        factors = np.where(inside, (_FREEDOM + 1) / (_FREEDOM + normal), 0.0)
        if span > 1:
            share = known.wide[k] / (sums[0, 0, 0] * self.squares[0].mean())
            redundancy = inside * np.clip(1 - share, 0.1, 1.0)
        else:
            redundancy = np.where(known.single > 0, np.clip(1 - factors * known.single / self.squares, 0.0, 1.0), 0.0)
            factors = np.where(known.single > 0, factors, 0.0)
        above, below = _means(factors * normal * self.squares), _means(redundancy)
        # Where the texture determines few curvatures, those of the whole block count with as many.
        found = np.log(np.maximum(above / np.maximum(below, 1e-30), 1e-12 * self.squares))
        total = np.maximum(below.sum(axis=(1, 2)), 1e-30)
        usual = ((below * found).sum(axis=(1, 2)) / total)[:, None, None]
        few = _ENOUGH / _PATCH**2
        squares = np.exp((below * found + few * usual) / (below + few))
        single = curvatures(heights) ** 2 / squares
        return Roughness(squares, np.where(self.factors > 0, (_FREEDOM + 1) / (_FREEDOM + single), 0.0))


def curvatures(heights: _Doubles, span: int = 1) -> _Doubles:
    """Second differences over `span` posts along columns, along rows and across, shape (3, rows, columns); 0 where they
    are not inside."""
    out, s = np.zeros((3, *heights.shape)), span
    if min(heights.shape) > 2 * s:
        out[0, :, s:-s] = heights[:, 2 * s :] - 2 * heights[:, s:-s] + heights[:, : -2 * s]
        out[1, s:-s] = heights[2 * s :] - 2 * heights[s:-s] + heights[: -2 * s]
        out[2, :-s, :-s] = heights[:-s, :-s] - heights[:-s, s:] - heights[s:, :-s] + heights[s:, s:]
    return out


def _inside(shape: tuple[int, int], span: int = 1) -> NDArray[np.bool_]:
    """Which of `curvatures` are inside."""
    out, s = np.zeros((3, *shape), bool), span
    if min(shape) > 2 * s:
        out[0, :, s:-s] = out[1, s:-s] = out[2, :-s, :-s] = True
    return out


def _means(values: _Doubles) -> _Doubles:
    """Means around each post over patches of about `_PATCH` posts, shape (3, rows, columns)."""
    out = values
    for axis in (1, 2):
        count, half = values.shape[axis], _PATCH // 2
        sums = np.insert(np.cumsum(out, axis=axis), 0, 0.0, axis=axis)
        at = np.arange(count)
        first, last = np.maximum(at - half, 0), np.minimum(at + half, count)
        width = (last - first).reshape([-1 if k == axis else 1 for k in range(3)])
        out = (sums.take(last, axis) - sums.take(first, axis)) / width
    return out

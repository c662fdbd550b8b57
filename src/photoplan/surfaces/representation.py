"""Representation error: variance of what a mesh of posts cannot follow between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Weights by which squares of second differences are averaged along rows and along columns.
_WINDOW = (0.25, 0.5, 0.25)
#: Ratio of the mean squares of second differences at one and at two mesh widths: of smooth ground, of ground whose
#: slopes are Brownian, of steps or Brownian ground, and of ground without any correlation.
_SMOOTH, _KINKED, _STEPS, _ROUGH = 1 / 16, 1 / 4, 1 / 2, 1.0
#: Part of a ratio's logarithm beside smooth ground that is left at half the distance: of waves, and from which part on
#: the ratio is that of a power law.
_WAVE, _LAW = 0.25, 0.79
#: Correlation of the errors along x and along y in the middle of a mesh, on Brownian ground.
_BROWNIAN = -0.44
#: A vertex this close to a grid line, in meshes, lies on it.
_ON_LINE = 1e-5


@dataclass(frozen=True, eq=False)
class Representation:
    """Variance between posts, m², is bx² · x + by² · y + 2 bx by · xy with b = (4 f (1 − f))^(power / 2).

    f is the position between two posts, 0 to 1. At posts the variance is zero. In a triangle the standard deviations of
    its three sides are added, with the products of two weights for f (1 − f) and the lengths of the side along x and y.
    """

    terms: NDArray[np.float32]
    """x, y and xy at each post, shape (3, n + 1, n + 1), m²; between posts they are bilinear."""
    power: float
    """2 for smooth ground, whose error is a parabola between posts; 1 for Brownian ground, whose error is a bridge."""


def representation(
    heights: NDArray[np.float32],
    vertices: NDArray[np.float64] | None = None,
    triangled: NDArray[np.bool_] | None = None,
) -> Representation:
    """Return the representation error of a grid of posts from their second differences.

    The error of linear interpolation in the middle between two posts is half the second difference at half the mesh
    width. Its mean square is extrapolated from those at one and at two mesh widths: by a power law of the distance if
    the ground has kinks at all scales, and towards the law of smooth ground if it has none.
    """
    Z = heights.astype(float)
    across, along = _uncut(vertices, Z.shape[0] - 1)
    if triangled is not None:
        around = np.pad(triangled, 1, constant_values=True)
        free = ~(around[1:, 1:] & around[1:, :-1] & around[:-1, 1:] & around[:-1, :-1])
        across &= free[:, 1:] & free[:, :-1]
        along &= free[1:] & free[:-1]
    x, y = _second(Z, across, 1), _second(Z.T, along.T, 1).T
    wide = np.append(_second(Z, across, 2).ravel(), _second(Z.T, along.T, 2).ravel())
    narrow = np.append(x.ravel(), y.ravel())
    ratio = _SMOOTH
    if np.isfinite(narrow).any() and np.isfinite(wide).any() and np.nanmax(np.abs(wide)) > 0:
        ratio = float(np.clip(np.nanmean(narrow**2) / np.nanmean(wide**2), _SMOOTH, _ROUGH))
        # A wave's ratio falls to that of smooth ground by the fourth part of its logarithm with each halving.
        part = min(1.0, np.log(ratio / _SMOOTH) / np.log(_KINKED / _SMOOTH))
        ratio = _SMOOTH * (ratio / _SMOOTH) ** (0.25 + 0.75 * part)
    power = _power(ratio)
    xx, yy, xy = _around(x**2), _around(y**2), _around(x * y)
    # Where nothing is known of a direction, lines are so close that they carry the surface.
    xx, yy, xy = (np.nan_to_num(values) for values in (xx, yy, xy))
    xy = (power - 1) * xy + (2 - power) * _BROWNIAN * np.sqrt(xx * yy)
    return Representation((np.stack([xx, yy, xy]) * (ratio / 4)).astype(np.float32), power)


def between_data(heights: NDArray[np.float64], step: int) -> tuple[NDArray[np.float64], float]:
    """Return the standard deviation of ground between data that are `step` posts apart, beside smooth ground, at posts.

    Posts between data are interpolated, smoothly in most models; how smooth the ground is, only second differences at
    the spacing of the data and its multiples say. Of a power law their ratio stays, of waves it falls to that of smooth
    ground by the fourth part of its logarithm with each halving of the distance. Also returned is the power, as in
    `Representation`. Zero where data are not further apart than posts.
    """
    Z, none = heights.astype(float), np.zeros(heights.shape)
    if step < 2:
        return none, 2.0
    free = np.ones((Z.shape[0], Z.shape[1] - 1), bool)
    both = [(_second(Z, free, k * step) ** 2, _second(Z.T, free, k * step).T ** 2) for k in (1, 2, 4)]
    means = np.array([np.nanmean(each) if np.isfinite(each).any() else np.nan for each in both])
    if not (means[:2] > 0).all():
        return none, 2.0
    seen, wide = np.log(np.clip(means[:2] / np.where(means[1:] > 0, means[1:], means[:2]), _SMOOTH, _ROUGH) / _SMOOTH)
    wave = _SMOOTH * np.exp(_WAVE * seen)
    ratio = _SMOOTH * np.exp(seen * np.interp(seen / max(wide, 1e-9), (_WAVE, _LAW), (_WAVE, 1.0)))
    # The best interpolation leaves nothing of the error of linear interpolation on waves, all on steps.
    left = np.clip(np.log(ratio / wave) / np.log(max(_STEPS / wave, 1.1)), 0.0, 1.0)
    around = sum(np.nan_to_num(_around(square)) for square in both[0])
    return np.sqrt(ratio * left / 4 * around), _power(ratio)


def _power(ratio: float) -> float:
    """The power by which variance grows between posts."""
    return float(np.clip(-np.log2(ratio), 1.0, 2.0))


def _uncut(vertices: NDArray[np.float64] | None, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether sides of meshes along x, shape (n + 1, n), and along y, shape (n, n + 1), have no vertex inside."""
    across, along = np.ones((n + 1, n), bool), np.ones((n, n + 1), bool)
    if vertices is not None and len(vertices):
        x, y = vertices.T
        on_x, on_y = np.abs(x - np.rint(x)) < _ON_LINE, np.abs(y - np.rint(y)) < _ON_LINE
        lower_x, lower_y = (np.clip(np.floor(v), 0, n - 1).astype(int) for v in (x, y))
        nearest_x, nearest_y = (np.clip(np.rint(v), 0, n).astype(int) for v in (x, y))
        some = on_y & ~on_x
        across[nearest_y[some], lower_x[some]] = False
        some = on_x & ~on_y
        along[lower_y[some], nearest_x[some]] = False
    return across, along


def _second(Z: NDArray[np.float64], uncut: NDArray[np.bool_], step: int) -> NDArray[np.float64]:
    """Second differences along rows at a distance of `step` posts; NaN at the ends and where a line crosses."""
    found = np.full(Z.shape, np.nan)
    n = Z.shape[1]
    if n > 2 * step:
        found[:, step:-step] = Z[:, 2 * step :] - 2 * Z[:, step:-step] + Z[:, : -2 * step]
        for shift in range(2 * step):
            found[:, step:-step][~uncut[:, shift : n - 2 * step + shift]] = np.nan
    return found


def _around(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means over a window; where none is known there, over the windows around."""
    mean = _mean(values)
    return np.where(np.isnan(mean), _mean(mean), mean)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means over a window; NaN where no value is known there."""
    known = np.isfinite(values)
    total, count = _weighted_sum(np.where(known, values, 0.0)), _weighted_sum(known.astype(float))
    return np.asarray(np.where(count > 0.01, total / np.maximum(count, 0.01), np.nan))


def _weighted_sum(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum over a window with `_WINDOW` along rows and columns, zeros around."""
    before, here, after = _WINDOW
    padded = np.pad(values, 1)
    rows = before * padded[:-2] + here * padded[1:-1] + after * padded[2:]
    return np.asarray(before * rows[:, :-2] + here * rows[:, 1:-1] + after * rows[:, 2:])

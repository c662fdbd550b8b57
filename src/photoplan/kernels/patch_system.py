"""The dense system of a patch: covariance matrix of its data, trend, and what it says of single data."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.collocation import correlation, factorise, solve_transposed
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.sides import clip_lines, sides_of

# Squared normalised differences count with their logarithm beyond this: no covariance function is to bend towards a
# blunder.
_KNEE = 16.0
# So many data of a patch at most take no part in what is said of the others.
_MOST_ASIDE = 8
JITTER = 1e-8
# A prior for the slope of the trend so weak that it only matters where all data lie on one line.
_SLOPE_WEIGHT = 1e-4
_MOST_PIECES = 40
_MOST_VERTICES = 4000


@kernel
def system(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaf: NDArray[Any],
    points: NDArray[Any],
    lines: NDArray[Any],
    start: NDArray[Any],
    model: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Factorised covariance matrix U of the data `ids`; coordinates (x, y, sides …) of data and of `points`; trend.

    Coordinates are in half-value distances from the leaf's middle, so that their squared differences go straight into
    the covariance function. The last result holds heights and trend columns, U⁻ᵀ applied. An empty U: not solvable.
    """
    n, m = len(ids), len(points)
    family, variance, length, gap = int(model[0]), model[1], model[2], model[3]
    xy = np.empty((n + m, 2))
    # Which parts of lines count depends on the patch alone, not on what is asked of it: units that share a post then
    # get the same height for it.
    reach = 1.5 * leaf[2]
    box = np.array([leaf[0] - reach, leaf[1] - reach, leaf[0] + reach, leaf[1] + reach])
    for i in range(n):
        for c in range(2):
            value = xyz[ids[i], c]
            xy[i, c] = value
            box[c], box[2 + c] = min(box[c], value), max(box[2 + c], value)
    for i in range(m):
        xy[n + i, 0], xy[n + i, 1] = points[i, 0], points[i, 1]
    pieces = 0
    vertices, piece_start = np.empty((0, 2)), np.zeros(1, np.int64)
    if len(start) > 1:
        vertices, piece_start = np.empty((_MOST_VERTICES, 2)), np.empty(_MOST_PIECES + 1, np.int64)
        pieces = clip_lines(lines, start, box, vertices, piece_start)
    at = np.empty((n + m, 2 + pieces))
    if pieces:
        sides_of(xy, vertices, piece_start, pieces, at[:, 2:])
    for i in range(n + m):
        at[i, 0], at[i, 1] = (xy[i, 0] - leaf[0]) / length, (xy[i, 1] - leaf[1]) / length
        for k in range(2, 2 + pieces):
            at[i, k] *= gap / 2.0
    u = np.empty((n, n))
    for i in range(n):
        u[i, i] = variance * (1.0 + JITTER) + noise[ids[i]]
        for j in range(i + 1, n):
            u[i, j] = variance * correlation(_distance(at, i, j), family)
    b = np.empty((n, 4))
    for i in range(n):
        b[i, 0], b[i, 1], b[i, 2], b[i, 3] = xyz[ids[i], 2], 1.0, at[i, 0], at[i, 1]
    if not factorise(u):
        return np.empty((0, 0)), at[:n], at[n:], b
    solve_transposed(u, b)
    return u, at[:n], at[n:], b


@inner
def _distance(at: NDArray[Any], i: int, j: int) -> float:
    """Squared distance of two rows of coordinates."""
    total = 0.0
    for k in range(at.shape[1]):
        d = at[i, k] - at[j, k]
        total += d * d
    return total


@kernel
def trend(b: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Coefficients of the trend and the inverse of their normal matrix, from heights and trend columns (n, 4)."""
    g, r = np.zeros((3, 3)), np.zeros(3)
    for i in range(b.shape[0]):
        for p in range(3):
            r[p] += b[i, p + 1] * b[i, 0]
            for q in range(3):
                g[p, q] += b[i, p + 1] * b[i, q + 1]
    g[1, 1] += _SLOPE_WEIGHT
    g[2, 2] += _SLOPE_WEIGHT
    inverse = np.linalg.inv(g)
    return inverse @ r, inverse


@kernel
def usable(ids: NDArray[Any], noise: NDArray[Any]) -> NDArray[Any]:
    """Entries of `ids` that name data to be used, each once, in ascending order."""
    kept = np.empty(len(ids), np.int64)
    count = 0
    for i in ids:
        if i >= 0 and noise[i] >= 0.0:
            kept[count] = i
            count += 1
    kept = np.sort(kept[:count])
    unique = 0
    for k in range(count):
        if k == 0 or kept[k] != kept[k - 1]:
            kept[unique] = kept[k]
            unique += 1
    return kept[:unique]


@kernel
def left_out(b: NDArray[Any], w: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """For right-hand sides w = U⁻ᵀe of single data: weight P and P·(height − trend) of each."""
    beta, inverse = trend(b)
    n, m = w.shape
    weight, alpha, cross = np.zeros(m), np.zeros(m), np.zeros((3, m))
    for i in range(n):
        rest = b[i, 0] - (b[i, 1] * beta[0] + b[i, 2] * beta[1] + b[i, 3] * beta[2])
        b1, b2, b3 = b[i, 1], b[i, 2], b[i, 3]
        for j in range(m):
            value = w[i, j]
            weight[j] += value * value
            alpha[j] += value * rest
            cross[0, j] += value * b1
            cross[1, j] += value * b2
            cross[2, j] += value * b3
    for j in range(m):
        for p in range(3):
            for q in range(3):
                weight[j] -= cross[p, j] * inverse[p, q] * cross[q, j]
    return weight, alpha


@kernel
def one_by_one(b: NDArray[Any], w: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """As `left_out`, but data far off their prediction take no part in those of the others, the worst first.

    A gross error spoils what is said of its neighbours: each of them contradicts it, and together they ask for a
    surface that is rough enough to meet it. `b` and `w` are changed.

    Notes
    -----
    A datum takes no part if its error is a further unknown of the trend: all columns are made orthogonal to its own.
    """
    weight, alpha = left_out(b, w)
    aside = np.zeros(len(weight), np.bool_)
    for _ in range(_MOST_ASIDE):
        worst, most = -1, _KNEE
        for j in range(len(weight)):
            if not aside[j] and weight[j] > 0.0 and alpha[j] * alpha[j] > most * weight[j]:
                worst, most = j, alpha[j] * alpha[j] / weight[j]
        if worst < 0:
            break
        aside[worst] = True
        unknown = w[:, worst].copy()
        _orthogonal(b, unknown)
        _orthogonal(w, unknown)
        now_weight, now_alpha = left_out(b, w)
        for j in range(len(weight)):
            if not aside[j]:
                weight[j], alpha[j] = now_weight[j], now_alpha[j]
    return weight, alpha


@kernel
def _orthogonal(columns: NDArray[Any], to: NDArray[Any]) -> None:
    """Take the part along a vector away from columns (n, m)."""
    n, m = columns.shape
    part, size = np.zeros(m), 0.0
    for i in range(n):
        size += to[i] * to[i]
        for j in range(m):
            part[j] += to[i] * columns[i, j]
    for i in range(n):
        for j in range(m):
            columns[i, j] -= to[i] * (part[j] / size)


@inner
def misfit(alpha: float, weight: float) -> float:
    """Twice the negative logarithm of the density of a datum, predicted from the others; see `left_out`.

    The difference from the prediction is alpha / weight, its variance 1 / weight. The density is normal up to four
    standard deviations; beyond, its logarithm falls slowly only.
    """
    square = alpha * alpha / weight
    if square > _KNEE:
        square = _KNEE * (1.0 + np.log(square / _KNEE))
    return square - np.log(weight)

"""Linear prediction in patches: one dense system for each neighbourhood, many right-hand sides."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.collocation import correlation, solve_transposed
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.patch_system import JITTER, system, trend, usable

# Models of a patch with less weight than this are left out.
_LEAST = 0.02
MOST_MISFIT = 16.0
"""Squared normalised residuals count up to this: one blunder does not make its surroundings rough."""
# Sides of a line are this many reaches apart where roughness is averaged.
_APART = 4.0


@inner
def _weight(d: float) -> float:
    """Weight of a patch at distance d from its middle in halves of its leaf: 1 up to ½, 0 from 1½, smooth between."""
    t = min(max(1.5 - abs(d), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@kernel
def predict(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaves: NDArray[Any],
    targets: NDArray[Any],
    wanted: NDArray[Any],
    wanted_start: NDArray[Any],
    lines: NDArray[Any],
    start: NDArray[Any],
    models: NDArray[Any],
    shares: NDArray[Any],
    squares: NDArray[Any],
    lost: NDArray[Any],
    usual: NDArray[Any],
    sums: NDArray[Any],
) -> int:
    """Add each patch's prediction of its targets to `sums`; returns the number of patches without a solution.

    Parameters
    ----------
    xyz : ndarray, shape (n, 3)
        Data.
    noise : ndarray, shape (n,)
        Their variances (filter values squared); negative: not to be used.
    ids : ndarray, shape (p, k), int
        Data of each patch; negative entries are no data.
    leaves : ndarray, shape (p, 3)
        Middle and half side of each patch's leaf.
    targets : ndarray, shape (t, 2)
        Where heights are wanted.
    wanted, wanted_start : ndarrays, int
        Targets of patch i are wanted[wanted_start[i]:wanted_start[i + 1]].
    lines, start : ndarrays
        Vertices of all breaklines near, and where each begins.
    models : ndarray, shape (p, m, 4)
        Family, variance, half-value distance, gap between the sides of a line in half-value distances.
    shares : ndarray, shape (p, m)
        Weights of a patch's models, which add up to 1.
    squares : ndarray, shape (n,)
        Squared normalised residuals of the data; NaN: not known.
    lost : ndarray, shape (n,)
        Variance at each datum of ground that the filter took for noise, m².
    usual : ndarray, shape (3,)
        Mean of these squares everywhere, how many data it counts as, and the distance at which data count a quarter
        for the roughness, metres.
    sums : ndarray, shape (t, 6)
        Sums of w·height, w, w·standard deviation; the shortest distance to a datum; sum of w·roughness, which is the
        mean square of the normalised residuals around, on the same side of lines; sum of w·`lost` around.

    Notes
    -----
    The weight of a patch falls smoothly to zero at three quarters of a leaf's side from its middle, so that the sum
    over patches is continuous; and with the predicted variance, so that the patch that knows more decides.
    """
    failed = 0
    for patch in range(len(leaves)):
        some = wanted[wanted_start[patch] : wanted_start[patch + 1]]
        if len(some) == 0:
            continue
        data = usable(ids[patch], noise)
        solved = False
        for k in range(models.shape[1]):
            if len(data) > 0 and shares[patch, k] > _LEAST:
                u, at, at_points, b = system(
                    xyz, noise, data, leaves[patch], targets[some], lines, start, models[patch, k]
                )
                if u.shape[0] > 0:
                    solved = True
                    rough, taken = _roughness(at, at_points, squares[data], lost[data], models[patch, k], usual)
                    w, near = _towards(at, at_points, models[patch, k])
                    solve_transposed(u, w)
                    about = np.stack((near, rough, taken))
                    _combine(
                        w, b, at_points, about, models[patch, k], leaves[patch], shares[patch, k], targets, some, sums
                    )
        failed += 0 if solved else 1
    return failed


@kernel
def _towards(at: NDArray[Any], at_points: NDArray[Any], model: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Covariances between data and targets (n, t), and the distance of each target to the nearest datum, metres."""
    family, variance, length = int(model[0]), model[1], model[2]
    n, m = len(at), len(at_points)
    w = np.empty((n, m))
    near = np.full(m, np.inf)
    for i in range(n):
        for j in range(m):
            apart = 0.0
            for k in range(2, at.shape[1]):
                d = at[i, k] - at_points[j, k]
                apart += d * d
            dx, dy = at[i, 0] - at_points[j, 0], at[i, 1] - at_points[j, 1]
            plain = dx * dx + dy * dy
            near[j] = min(near[j], plain)
            w[i, j] = variance * correlation(plain + apart, family)
    return w, np.sqrt(near) * length


@kernel
def _roughness(
    at: NDArray[Any],
    at_points: NDArray[Any],
    squares: NDArray[Any],
    lost: NDArray[Any],
    model: NDArray[Any],
    usual: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Means around each target (t,): of squared normalised residuals, drawn to the usual one, and of `lost`."""
    n, m = len(at), len(at_points)
    total, count = np.full(m, usual[0] * usual[1]), np.full(m, usual[1])
    taken, weights = np.zeros(m), np.full(m, 1e-30)
    plain, across = (model[2] / usual[2]) ** 2, (_APART / model[3]) ** 2
    for i in range(n):
        if not squares[i] >= 0.0:
            continue
        square = min(squares[i], MOST_MISFIT)
        for j in range(m):
            apart = 0.0
            for k in range(2, at.shape[1]):
                d = at[i, k] - at_points[j, k]
                apart += d * d
            dx, dy = at[i, 0] - at_points[j, 0], at[i, 1] - at_points[j, 1]
            near = 1.0 / (1.0 + (dx * dx + dy * dy) * plain + apart * across) ** 2
            total[j] += near * square
            count[j] += near
            taken[j] += near * near * lost[i]
            weights[j] += near * near
    return total / count, taken / weights


@kernel
def _combine(
    w: NDArray[Any],
    b: NDArray[Any],
    at_points: NDArray[Any],
    about: NDArray[Any],
    model: NDArray[Any],
    leaf: NDArray[Any],
    part: float,
    targets: NDArray[Any],
    some: NDArray[Any],
    sums: NDArray[Any],
) -> None:
    """Add heights, variances and `about` (nearest datum, roughness, lost; shape (3, t)) of one patch's targets."""
    n, m = w.shape
    beta, inverse = trend(b)
    height, explained = np.zeros(m), np.zeros(m)
    cross = np.zeros((3, m))
    for i in range(n):
        b1, b2, b3 = b[i, 1], b[i, 2], b[i, 3]
        rest = b[i, 0] - (b1 * beta[0] + b2 * beta[1] + b3 * beta[2])
        for j in range(m):
            value = w[i, j]
            height[j] += value * rest
            explained[j] += value * value
            cross[0, j] += value * b1
            cross[1, j] += value * b2
            cross[2, j] += value * b3
    for j in range(m):
        x, y = at_points[j, 0], at_points[j, 1]
        v0, v1, v2 = 1.0 - cross[0, j], x - cross[1, j], y - cross[2, j]
        i0 = inverse[0, 0] * v0 + inverse[0, 1] * v1 + inverse[0, 2] * v2
        i1 = inverse[1, 0] * v0 + inverse[1, 1] * v1 + inverse[1, 2] * v2
        i2 = inverse[2, 0] * v0 + inverse[2, 1] * v1 + inverse[2, 2] * v2
        spread = max(model[1] - explained[j] + v0 * i0 + v1 * i1 + v2 * i2, JITTER * model[1])
        t = some[j]
        share = _weight((targets[t, 0] - leaf[0]) / leaf[2]) * _weight((targets[t, 1] - leaf[1]) / leaf[2])
        weight = share * part / spread
        sums[t, 0] += weight * (height[j] + beta[0] + beta[1] * x + beta[2] * y)
        sums[t, 1] += weight
        sums[t, 2] += weight * np.sqrt(spread)
        sums[t, 3] = min(sums[t, 3], about[0, j])
        sums[t, 4] += weight * about[1, j]
        sums[t, 5] += weight * about[2, j]

"""What the data of a patch say of each other: scores of covariance functions, and tests for gross errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.collocation import solve_transposed
from photoplan.kernels.jit import kernel
from photoplan.kernels.patch_system import misfit, one_by_one, system, usable

# Points count with a normal weight of this many half sides of the leaf: far ones are other patches' matter.
_FOCUS = 1.5


@kernel
def score_models(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaves: NDArray[Any],
    points: int,
    lines: NDArray[Any],
    start: NDArray[Any],
    models: NDArray[Any],
    result: NDArray[Any],
) -> None:
    """How badly each model predicts every point of a patch from all others that it does not contradict,
    result[patch, model].

    The score is the sum of misfits over the points (numbers below `points`), e being the difference from the
    prediction and v its variance: twice the negative logarithm of the predictive density.
    """
    for patch in range(len(leaves)):
        data = usable(ids[patch], noise)
        n = len(data)
        m = np.searchsorted(data, points)
        for k in range(models.shape[1]):
            result[patch, k] = 0.0
            if m == 0:
                continue
            u, _, _, b = system(xyz, noise, data, leaves[patch], np.empty((0, 2)), lines, start, models[patch, k])
            if u.shape[0] == 0:
                result[patch, k] = np.inf
                continue
            w = np.zeros((n, m))
            for j in range(m):
                w[j, j] = 1.0
            solve_transposed(u, w)
            weight, alpha = one_by_one(b, w)
            total = 0.0
            for j in range(m):
                if weight[j] > 0.0:
                    dx, dy = xyz[data[j], 0] - leaves[patch, 0], xyz[data[j], 1] - leaves[patch, 1]
                    share = np.exp(-0.5 * (dx * dx + dy * dy) / (_FOCUS * leaves[patch, 2]) ** 2)
                    total += share * misfit(alpha[j], weight[j])
            result[patch, k] = total


@kernel
def test_points(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaves: NDArray[Any],
    own: NDArray[Any],
    own_start: NDArray[Any],
    lines: NDArray[Any],
    start: NDArray[Any],
    models: NDArray[Any],
    result: NDArray[Any],
) -> int:
    """Compare data with what their neighbours predict; returns the number of patches without a solution.

    Parameters are those of `predict`; `own` holds point numbers of each leaf. `result`, shape (points, 3), receives for
    each of them the difference from the prediction from all other data of the patch but those that are far off
    themselves (metres), the redundancy (share of it that is left as a residual against the filtered surface) and the
    difference in its standard deviations.
    """
    failed = 0
    for patch in range(len(leaves)):
        some = own[own_start[patch] : own_start[patch + 1]]
        if len(some) == 0:
            continue
        data = usable(ids[patch], noise)
        u, _, _, b = system(xyz, noise, data, leaves[patch], np.empty((0, 2)), lines, start, models[patch])
        if u.shape[0] == 0:
            failed += 1
            continue
        n, m = len(data), np.searchsorted(data, len(result))
        w = np.zeros((n, m))
        for j in range(m):
            w[j, j] = 1.0
        solve_transposed(u, w)
        weight, alpha = one_by_one(b, w)
        for t in some:
            j = np.searchsorted(data[:m], t)
            if j < m and data[j] == t and weight[j] > 0.0:
                result[t, 0] = alpha[j] / weight[j]
                result[t, 1] = noise[t] * weight[j]
                result[t, 2] = alpha[j] / np.sqrt(weight[j])
    return failed

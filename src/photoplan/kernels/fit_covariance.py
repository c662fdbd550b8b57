"""How well a covariance function predicts each point of some blocks from the others, and the best one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.collocation import correlation, factorise, solve_transposed
from photoplan.kernels.jit import kernel
from photoplan.kernels.patch_system import left_out, misfit

_JITTER = 1e-8


@kernel
def block_score(
    d2: NDArray[Any], sides: NDArray[Any], b: NDArray[Any], noise: NDArray[Any], parameters: NDArray[Any], family: int
) -> float:
    """Twice the negative logarithm of the predictive density of one block's points, each from all others.

    A likelihood would ask how probable all data are together, and dense points along lines would decide it; this asks
    what a terrain model is for.

    Parameters
    ----------
    d2 : ndarray, shape (n, n)
        Squared distances on the map.
    sides : ndarray, shape (n, n)
        Squared distances of the side coordinates, in units of the half-value distance squared.
    b : ndarray, shape (n, 4)
        Heights, and the columns of the trend 1, x, y.
    noise : ndarray, shape (n, 3)
        Variance of each height = noise[:, 0] + noise[:, 1] · (third parameter). The first rows, as long as the third
        column is not 0, are the ones predicted: whether their variance is known does not matter.
    parameters : ndarray, shape (3,)
        Variance of the signal, half-value distance, variance of mass points.
    family : int
        See `photoplan.kernels.collocation`.

    Returns
    -------
    float
        Infinity where the matrix is not positive definite.
    """
    n = d2.shape[0]
    variance, scale = parameters[0], 1.0 / parameters[1] ** 2
    u = np.empty((n, n))
    for i in range(n):
        u[i, i] = variance * (1.0 + _JITTER) + noise[i, 0] + noise[i, 1] * parameters[2]
        for j in range(i + 1, n):
            u[i, j] = variance * correlation(d2[i, j] * scale + sides[i, j], family)
    if not factorise(u):
        return np.inf
    scored = 0
    while scored < n and noise[scored, 2] != 0.0:
        scored += 1
    w = np.zeros((n, 4 + scored))
    for i in range(n):
        for k in range(4):
            w[i, k] = b[i, k]
    for i in range(scored):
        w[i, 4 + i] = 1.0
    solve_transposed(u, w)
    weight, alpha = left_out(w[:, :4], w[:, 4:])
    total = 0.0
    for j in range(scored):
        if not weight[j] > 0.0:
            return np.inf
        total += misfit(alpha[j], weight[j])
    return total


@kernel
def _objective(
    d2: NDArray[Any],
    sides: NDArray[Any],
    b: NDArray[Any],
    noise: NDArray[Any],
    prior: NDArray[Any],
    logs: NDArray[Any],
    family: int,
) -> float:
    """Sum over blocks plus the prior: (log − prior[0])² · prior[1] for each parameter, bounds in prior[2:4]."""
    total = 0.0
    for p in range(3):
        if logs[p] < prior[2, p] or logs[p] > prior[3, p]:
            return np.inf
        total += (logs[p] - prior[0, p]) ** 2 * prior[1, p]
    parameters = np.exp(logs)
    for k in range(d2.shape[0]):
        total += block_score(d2[k], sides[k], b[k], noise[k], parameters, family)
        if not total < np.inf:
            return np.inf
    return total


def minimise(
    d2: NDArray[Any],
    sides: NDArray[Any],
    b: NDArray[Any],
    noise: NDArray[Any],
    prior: NDArray[Any],
    first: NDArray[Any],
    family: int,
) -> tuple[NDArray[Any], float]:
    """Logarithms of the parameters of the best prediction, by the simplex of Nelder and Mead; and the objective.

    Not compiled: its time is that of the objective, and numba would take 10 s for this little of NumPy.

    Parameters
    ----------
    d2, sides, b, noise : ndarrays, shapes (k, n, n), (k, n, n), (k, n, 4), (k, n, 3)
        As in `block_score`, for k blocks.
    prior : ndarray, shape (4, 3)
        Mean, weight, lowest and highest value of the logarithms. Equal bounds hold a parameter fixed.
    first : ndarray, shape (3,)
        Where to start.
    """
    # A simplex of the free parameters only: one with a corner too many in a plane collapses onto a line.
    free = np.flatnonzero(prior[3] > prior[2])
    last = len(free)
    simplex, values = np.empty((last + 1, 3)), np.empty(last + 1)
    for i in range(last + 1):
        simplex[i] = first
        if i > 0:
            p = free[i - 1]
            step = min(0.7, prior[3, p] - prior[2, p])
            simplex[i, p] += step if first[p] + step <= prior[3, p] else -step
        values[i] = _objective(d2, sides, b, noise, prior, simplex[i], family)
    for _ in range(120):
        order = np.argsort(values)
        simplex, values = simplex[order], values[order]
        if last == 0 or (values[last] - values[0] < 0.02 and values[last] < np.inf):
            break
        middle = simplex[:last].sum(axis=0) / last
        reflected = middle + (middle - simplex[last])
        at = _objective(d2, sides, b, noise, prior, reflected, family)
        if at < values[0]:
            further = middle + 2.0 * (middle - simplex[last])
            there = _objective(d2, sides, b, noise, prior, further, family)
            if there < at:
                simplex[last], values[last] = further, there
            else:
                simplex[last], values[last] = reflected, at
            continue
        if at < values[max(last - 1, 0)]:
            simplex[last], values[last] = reflected, at
            continue
        nearer = middle + 0.5 * ((reflected if at < values[last] else simplex[last]) - middle)
        there = _objective(d2, sides, b, noise, prior, nearer, family)
        if there < min(at, values[last]):
            simplex[last], values[last] = nearer, there
            continue
        for i in range(1, last + 1):
            simplex[i] = simplex[0] + 0.5 * (simplex[i] - simplex[0])
            values[i] = _objective(d2, sides, b, noise, prior, simplex[i], family)
    best = np.argmin(values)
    return simplex[best], float(values[best])

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
    noise : ndarray, shape (n, 2)
        Variance of each height = noise[:, 0] + noise[:, 1] · (third parameter). The first rows, as long as the second
        column is exactly 1, are mass points: they are the ones predicted.
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
    while scored < n and noise[scored, 1] == 1.0:
        scored += 1
    w = np.zeros((n, 4 + scored))
    w[:, :4] = b
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


@kernel
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

    Parameters
    ----------
    d2, sides, b, noise : ndarrays, shapes (k, n, n), (k, n, n), (k, n, 4), (k, n, 2)
        As in `block_score`, for k blocks.
    prior : ndarray, shape (4, 3)
        Mean, weight, lowest and highest value of the logarithms. Equal bounds hold a parameter fixed.
    first : ndarray, shape (3,)
        Where to start.
    """
    simplex, values = np.empty((4, 3)), np.empty(4)
    for i in range(4):
        for p in range(3):
            simplex[i, p] = first[p]
        if i > 0:
            step = min(0.7, prior[3, i - 1] - prior[2, i - 1])
            up = first[i - 1] + step <= prior[3, i - 1]
            simplex[i, i - 1] += step if up else -step
        values[i] = _objective(d2, sides, b, noise, prior, simplex[i], family)
    for _ in range(120):
        order = np.argsort(values)
        simplex, values = simplex[order], values[order]
        if values[3] - values[0] < 0.02 and values[3] < np.inf:
            break
        middle = (simplex[0] + simplex[1] + simplex[2]) / 3.0
        reflected = middle + (middle - simplex[3])
        at = _objective(d2, sides, b, noise, prior, reflected, family)
        if at < values[0]:
            further = middle + 2.0 * (middle - simplex[3])
            there = _objective(d2, sides, b, noise, prior, further, family)
            if there < at:
                simplex[3], values[3] = further, there
            else:
                simplex[3], values[3] = reflected, at
            continue
        if at < values[2]:
            simplex[3], values[3] = reflected, at
            continue
        nearer = middle + 0.5 * ((reflected if at < values[3] else simplex[3]) - middle)
        there = _objective(d2, sides, b, noise, prior, nearer, family)
        if there < min(at, values[3]):
            simplex[3], values[3] = nearer, there
            continue
        for i in range(1, 4):
            simplex[i] = simplex[0] + 0.5 * (simplex[i] - simplex[0])
            values[i] = _objective(d2, sides, b, noise, prior, simplex[i], family)
    best = np.argmin(values)
    return simplex[best], values[best]

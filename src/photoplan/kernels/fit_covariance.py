"""Scores of covariance functions: how well they predict each point of some blocks from the others."""

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
def score(
    d2: NDArray[Any],
    sides: NDArray[Any],
    b: NDArray[Any],
    noise: NDArray[Any],
    prior: NDArray[Any],
    logs: NDArray[Any],
    family: int,
) -> float:
    """Sum `block_score` over blocks, and add the prior.

    The prior of each logarithm is (log − prior[0])² · prior[1]; beyond the bounds prior[2:4] the score is infinite.
    """
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

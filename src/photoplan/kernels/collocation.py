"""Linear algebra and covariance functions of linear prediction, on small dense systems.

Own routines instead of a library's: the systems are small, thousands of them are solved at once by threads, and
libraries start threads of their own there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

GAUSSIAN, MATERN, EXPONENTIAL = 0, 1, 2
"""Families of covariance functions, from the smoothest surface to the roughest."""

_LN2 = 0.6931471805599453
_MATERN_HALF = 1.6783469900166605
"""Argument at which (1 + t) exp(−t) is one half."""


@inner
def correlation(d2: float, family: int) -> float:
    """Correlation at squared distance `d2`, in units of the half-value distance: ½ at 1 for every family.

    Gaussian exp(−t²), Matérn 3/2 (1 + t) exp(−t), exponential exp(−t).
    """
    if family == GAUSSIAN:
        return np.exp(-_LN2 * d2)
    d = np.sqrt(d2)
    if family == MATERN:
        return (1.0 + _MATERN_HALF * d) * np.exp(-_MATERN_HALF * d)
    return np.exp(-_LN2 * d)


@kernel
def factorise(a: NDArray[Any]) -> bool:
    """Replace the upper triangle of a symmetric matrix by U with UᵀU = a; False if it is not positive definite.

    Rows are eliminated four at a time, so that each number of the rest is loaded once for four of them.
    """
    n = a.shape[0]
    k = 0
    while k < n:
        stop = min(k + 4, n)
        for p in range(k, stop):
            for q in range(k, p):
                f = a[q, p]
                for j in range(p, n):
                    a[p, j] -= f * a[q, j]
            pivot = a[p, p]
            if not pivot > 0.0:
                return False
            scale = 1.0 / np.sqrt(pivot)
            for j in range(p, n):
                a[p, j] *= scale
        if stop - k == 4:
            for i in range(stop, n):
                f0, f1, f2, f3 = a[k, i], a[k + 1, i], a[k + 2, i], a[k + 3, i]
                for j in range(i, n):
                    a[i, j] -= f0 * a[k, j] + f1 * a[k + 1, j] + f2 * a[k + 2, j] + f3 * a[k + 3, j]
        k = stop
    return True


@kernel
def solve_transposed(u: NDArray[Any], b: NDArray[Any]) -> None:
    """Replace b, shape (n, m), by U⁻ᵀ b; all right-hand sides at once, so that the inner loop is long."""
    n, m = b.shape
    k = 0
    while k < n:
        stop = min(k + 4, n)
        for p in range(k, stop):
            for q in range(k, p):
                f = u[q, p]
                for j in range(m):
                    b[p, j] -= f * b[q, j]
            scale = 1.0 / u[p, p]
            for j in range(m):
                b[p, j] *= scale
        if stop - k == 4:
            for i in range(stop, n):
                f0, f1, f2, f3 = u[k, i], u[k + 1, i], u[k + 2, i], u[k + 3, i]
                for j in range(m):
                    b[i, j] -= f0 * b[k, j] + f1 * b[k + 1, j] + f2 * b[k + 2, j] + f3 * b[k + 3, j]
        k = stop

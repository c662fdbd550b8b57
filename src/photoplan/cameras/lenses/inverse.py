"""Newton's method for lenses whose inverse has no closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

#: What is left of the residual at a point that counts as solved, relative to 1 + |t|.
PRECISION = 1e-12
_ITERATIONS = 60

_Map = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def determinant(J: NDArray[np.float64]) -> NDArray[np.float64]:
    """Determinant of matrices (..., 2, 2)."""
    return J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]


def upright(J: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where a lens's derivative (..., 2, 2) neither mirrors nor turns round; False for NaN.

    On the axis it is close to the unit matrix; on its way to a fold the determinant vanishes, and beyond the fold at
    least one of determinant and trace is negative.
    """
    return np.asarray((determinant(J) > 0) & (J[..., 0, 0] + J[..., 1, 1] > 0))


def solve2(J: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """x of J x = b for matrices (..., 2, 2) and vectors (..., 2); inf or NaN where J is singular."""
    det = determinant(J)
    x = np.empty_like(b)
    x[..., 0] = (J[..., 1, 1] * b[..., 0] - J[..., 0, 1] * b[..., 1]) / det
    x[..., 1] = (J[..., 0, 0] * b[..., 1] - J[..., 1, 0] * b[..., 0]) / det
    return x


def newton_inverse(
    distort: _Map, jacobian: _Map, target: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """t with distort(t) = target, to 1e-12.

    Parameters
    ----------
    distort, jacobian : callable
        The mapping (..., 2) → (..., 2) and its derivative (..., 2, 2).
    target, start : ndarray, shape (..., 2)
        What is to be reached, and where the search begins.

    Returns
    -------
    ndarray, shape (..., 2)
        NaN where the search did not converge, or ended on a sheet that is folded over.
    """
    t = np.array(start, float)
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            step = solve2(jacobian(t), distort(t) - target)
            t -= step
            # A comparison with NaN is false: hopeless points do not keep the others waiting.
            if not (np.abs(step) > 4e-16 + 2e-15 * np.abs(t)).any():
                break
        miss = np.abs(distort(t) - target).max(axis=-1, initial=0.0)
        good = (miss <= PRECISION * (1.0 + np.abs(target).max(axis=-1, initial=0.0))) & upright(jacobian(t))
    t[~good] = np.nan
    return t

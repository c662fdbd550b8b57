"""Newton's method for lenses whose inverse has no closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def decentred(t: NDArray[np.float64], factor: NDArray[np.float64], p1: float, p2: float) -> NDArray[np.float64]:
    """x·g + p1 (r² + 2x²) + 2 p2 x y and y·g + p2 (r² + 2y²) + 2 p1 x y, g = `factor` at t; shapes (..., 2)."""
    out = t * factor[..., None]
    if p1 or p2:
        x, y = t[..., 0], t[..., 1]
        # p1 (r² + 2x²) + 2 p2 x y = p1 r² + 2 x (p1 x + p2 y), and likewise for y.
        r2 = x * x + y * y
        s = 2.0 * (p1 * x + p2 * y)
        out[..., 0] += p1 * r2 + s * x
        out[..., 1] += p2 * r2 + s * y
    return out


def decentred_jacobian(
    t: NDArray[np.float64], factor: NDArray[np.float64], slope: NDArray[np.float64], p1: float, p2: float
) -> NDArray[np.float64]:
    """Derivative of `decentred`, shape (..., 2, 2); `slope` = dg / d(r²)."""
    x, y = t[..., 0], t[..., 1]
    J = np.empty((*t.shape, 2))
    J[..., 0, 0] = factor + 2.0 * x * x * slope + 6.0 * p1 * x + 2.0 * p2 * y
    J[..., 1, 1] = factor + 2.0 * y * y * slope + 6.0 * p2 * y + 2.0 * p1 * x
    J[..., 0, 1] = J[..., 1, 0] = 2.0 * (x * y * slope + p1 * y + p2 * x)
    return J


def radial_jacobian(
    t: NDArray[np.float64], r: NDArray[np.float64], across: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivative of a radial mapping at t (..., 2) of radius r: r'/r across and dr'/dr along the radius."""
    e = t / np.where(r > 0, r, 1.0)[..., None]
    excess = along - across
    J = np.empty((*t.shape, 2))
    J[..., 0, 0] = across + excess * e[..., 0] * e[..., 0]
    J[..., 1, 1] = across + excess * e[..., 1] * e[..., 1]
    J[..., 0, 1] = J[..., 1, 0] = excess * e[..., 0] * e[..., 1]
    return J


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
    """t with distort(t) = target, to 1e-12."""
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

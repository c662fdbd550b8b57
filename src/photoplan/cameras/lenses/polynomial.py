"""The form that Brown's and OpenCV's lenses share: a radial factor and two decentring terms."""

from __future__ import annotations

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

"""What lenses without decentring share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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

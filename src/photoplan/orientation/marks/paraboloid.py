"""Sub-pixel place of the highest correlation: an adjusted paraboloid (Behr 1989, §4.1.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_HALF = 2
_Y, _X = (a.ravel().astype(float) for a in np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1])
_DESIGN = np.column_stack([_X**2, _X, _Y**2, _Y, np.ones_like(_X)])
_INVERSE = np.linalg.inv(_DESIGN.T @ _DESIGN)


@dataclass(frozen=True)
class Peak:
    """Place of the highest correlation."""

    x: float
    """Column in the array of coefficients."""
    y: float
    """Row in the array of coefficients."""
    sigma_x: float
    sigma_y: float
    """Standard deviations, from how well the paraboloid fits; pixels."""
    height: float
    """Value of the paraboloid at its top."""


def paraboloid_peak(correlation: NDArray[np.floating], row: int, column: int) -> Peak | None:
    """Top of the paraboloid through the 5 × 5 neighbourhood of a maximum (Behr 1989, eq. 4.2–4.4).

    Parameters
    ----------
    correlation : ndarray, shape (h, w)
        Correlation coefficients; NaN: none.
    row, column : int
        Place of their maximum.

    Returns
    -------
    Peak or None
        None where the neighbourhood leaves the array or holds NaN, or the paraboloid has no top within two pixels.
    """
    top, left = row - _HALF, column - _HALF
    if top < 0 or left < 0:
        return None
    part = np.asarray(correlation[top : row + _HALF + 1, left : column + _HALF + 1], float)
    if part.shape != (2 * _HALF + 1,) * 2 or not np.isfinite(part).all():
        return None
    z = part.ravel()
    a, b, c, d, e = _INVERSE @ (_DESIGN.T @ z)
    if a >= 0.0 or c >= 0.0:
        return None
    x, y = -b / (2.0 * a), -d / (2.0 * c)
    if max(abs(x), abs(y)) > _HALF:
        return None
    residuals = _DESIGN @ np.array([a, b, c, d, e]) - z
    variance = float(residuals @ residuals) / (len(z) - 5)
    # ∂x/∂(a, b) and ∂y/∂(c, d)
    fx, fy = np.array([-x / a, -0.5 / a]), np.array([-y / c, -0.5 / c])
    sx = math.sqrt(variance * float(fx @ _INVERSE[:2, :2] @ fx))
    sy = math.sqrt(variance * float(fy @ _INVERSE[2:4, 2:4] @ fy))
    return Peak(column + x, row + y, sx, sy, float(e + 0.5 * (b * x + d * y)))

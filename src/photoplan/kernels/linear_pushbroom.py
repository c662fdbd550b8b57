"""Projection by a pushbroom camera that flies straight and evenly without turning, by Newton's method."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

#: Steps below this end the search, columns and rows; and steps at most.
_CLOSE, _STEPS = 1e-9, 16


@inner
def _chebyshev(coefficients: NDArray[np.float64], t: float, c: int) -> tuple[float, float]:
    """Value and derivative at t of a sum of Chebyshev polynomials (Clenshaw's recurrence and its derivative)."""
    b1, b2, d1, d2 = 0.0, 0.0, 0.0, 0.0
    for k in range(coefficients.shape[0] - 1, 0, -1):
        d1, d2 = 2.0 * b1 + 2.0 * t * d1 - d2, d1
        b1, b2 = coefficients[k, c] + 2.0 * t * b1 - b2, b1
    return coefficients[0, c] + t * b1 - b2, b1 + t * d1 - d2


@kernel
def project_linear_pushbroom(
    d: NDArray[np.float64], speed: NDArray[np.float64], look: tuple[Any, ...], found: NDArray[np.float64]
) -> None:
    """Columns and rows at which points are seen.

    Parameters
    ----------
    d : (n, 3) float64
        Points in the axes of the camera, from where it was at row 0.
    speed : (3,) float64
        How it moves on from row to row, in the same axes.
    look : tuple
        Chebyshev coefficients (degree + 1, 2) of the tangents; first and last column of their span: beyond it the
        line goes straight on; column to begin at.
    found : (n, 2) float64
        Filled; NaN for points behind the camera, and where nothing is found.
    """
    coefficients, low, high, start = look
    per_column = 2.0 / (high - low)
    middle_x, along_x = _chebyshev(coefficients, (2.0 * start - (low + high)) / (high - low), 0)
    middle_y, along_y = _chebyshev(coefficients, (2.0 * start - (low + high)) / (high - low), 1)
    for i in range(d.shape[0]):
        found[i, 0], found[i, 1] = np.nan, np.nan
        # The moment at which it lies in the plane of the line, as if that were straight.
        ahead = along_x * (d[i, 1] - middle_y * d[i, 2]) - along_y * (d[i, 0] - middle_x * d[i, 2])
        pace = along_x * (speed[1] - middle_y * speed[2]) - along_y * (speed[0] - middle_x * speed[2])
        row, column = ahead / pace, start
        for _ in range(_STEPS):
            z = d[i, 2] - row * speed[2]
            if not z > 0.0:
                break
            x, y = (d[i, 0] - row * speed[0]) / z, (d[i, 1] - row * speed[1]) / z
            back_x, back_y = (x * speed[2] - speed[0]) / z, (y * speed[2] - speed[1]) / z
            inside = min(max(column, low), high)
            at_x, slope_x = _chebyshev(coefficients, (2.0 * inside - (low + high)) / (high - low), 0)
            at_y, slope_y = _chebyshev(coefficients, (2.0 * inside - (low + high)) / (high - low), 1)
            slope_x, slope_y = slope_x * per_column, slope_y * per_column
            miss_x = at_x + slope_x * (column - inside) - x
            miss_y = at_y + slope_y * (column - inside) - y
            turn = slope_y * back_x - slope_x * back_y
            step_column = (back_y * miss_x - back_x * miss_y) / turn
            step_row = (slope_y * miss_x - slope_x * miss_y) / turn
            column, row = column + step_column, row + step_row
            if abs(step_column) < _CLOSE and abs(step_row) < _CLOSE:
                found[i, 0], found[i, 1] = column, row
                break

"""Paraboloids through the heights around places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def paraboloids(step: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Design matrices of z = a + b x + c y + d x²/2 + e x y + f y²/2, with x and y in units of the widest step.

    The coefficients are the height, the slopes and the second derivatives at the place: divide slopes by the unit and
    second derivatives by its square.
    """
    unit = np.abs(step).max(axis=(1, 2))
    unit = np.where(unit > 0, unit, 1.0)
    x, y = np.moveaxis(step / unit[:, None, None], 2, 0)
    return np.stack([np.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2], axis=2), unit

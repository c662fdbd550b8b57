"""Grey values after the trend over an image and a table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel

_Floats = NDArray[np.float64]


@kernel
def tone_pixels(
    values: _Floats,
    corner: tuple[int, int],
    size: tuple[int, int],
    trend: _Floats,
    least: float,
    grey: _Floats,
    becomes: _Floats,
) -> None:
    """Divide pixels by the trend and look them up, between entries linearly; NaN stays NaN.

    Parameters
    ----------
    values : ndarray, shape (height, width)
        Changed.
    corner, size : (int, int)
        Column and row of their upper-left pixel in the image, and its width and height.
    trend : ndarray, shape (n, m)
        Factors of uⁱ vʲ, columns and rows from the image's middle in half diagonals; and what the trend is at `least`.
    grey, becomes : ndarray
        The table; beyond it the first or last interval goes on.
    """
    half = np.hypot(size[0], size[1]) / 2
    powers, last = np.empty(trend.shape[0]), len(grey) - 2
    slopes, steps = np.empty(last + 1), (last + 1) / (grey[-1] - grey[0])
    for k in range(last + 1):
        slopes[k] = (becomes[k + 1] - becomes[k]) / (grey[k + 1] - grey[k])
    for row in range(values.shape[0]):
        v = (corner[1] + row - (size[1] - 1) / 2) / half
        for i in range(trend.shape[0]):
            total = 0.0
            for j in range(trend.shape[1] - 1, -1, -1):
                total = total * v + trend[i, j]
            powers[i] = total
        for col in range(values.shape[1]):
            u = (corner[0] + col - (size[0] - 1) / 2) / half
            total = 0.0
            for i in range(trend.shape[0] - 1, -1, -1):
                total = total * u + powers[i]
            x = values[row, col] / max(total, least)
            if np.isnan(x):
                continue
            # Most tables have equal steps: there the first guess is the entry.
            k = int(min(max((x - grey[0]) * steps, 0.0), last))
            while k < last and x >= grey[k + 1]:
                k += 1
            while k > 0 and x < grey[k]:
                k -= 1
            values[row, col] = becomes[k] + slopes[k] * (x - grey[k])

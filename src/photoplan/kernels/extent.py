"""Height ranges of many rectangles of one relief."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def height_ranges(relief: NDArray[np.float32], rects: NDArray[np.int32]) -> NDArray[np.float64]:
    """Lowest and highest finite relief of each rectangle.

    Parameters
    ----------
    relief : ndarray, shape (rows, cols), float32
        NaN where there is no surface.
    rects : ndarray, shape (n, 4), int32
        First column, first row, end column, end row; half-open.

    Returns
    -------
    ndarray, shape (n, 2), float64
        Lowest and highest; +inf, −inf where the rectangle holds no finite value.
    """
    n = rects.shape[0]
    ranges = np.empty((n, 2), np.float64)
    for i in range(n):
        low, high = np.float32(np.inf), np.float32(-np.inf)
        for row in range(rects[i, 1], rects[i, 3]):
            for col in range(rects[i, 0], rects[i, 2]):
                h = relief[row, col]
                # Both comparisons are false for NaN, and selecting (not branching) lets the loop use vectors.
                low = h if h < low else low
                high = h if h > high else high
        ranges[i, 0] = low
        ranges[i, 1] = high
    return ranges

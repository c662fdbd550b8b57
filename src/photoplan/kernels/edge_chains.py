"""Edge pixels: where the gradient has its ridge, to parts of a pixel, and which of them form one line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def ridge(gx: NDArray[np.float32], gy: NDArray[np.float32], least: float, offset: NDArray[np.float32]) -> int:
    """Find pixels whose gradient is the largest across the edge.

    Each is compared with its two neighbours in the column or row direction in which the gradient is steeper, and a
    parabola through the three gives the place of the ridge.

    Parameters
    ----------
    gx, gy
        Gradient, shape (h, w); NaN or 0 where it must not be used.
    least
        Smallest magnitude of an edge pixel.
    offset
        Filled, shape (h, w): by what the ridge lies right of (|gx| >= |gy|) or below the pixel, -0.5 to 0.5; NaN
        where there is none.

    Returns
    -------
    int
        Number of edge pixels.
    """
    h, w = gx.shape
    count = 0
    for i in range(h):
        for j in range(w):
            offset[i, j] = np.nan
            if i == 0 or j == 0 or i == h - 1 or j == w - 1:
                continue
            x, y = np.float64(gx[i, j]), np.float64(gy[i, j])
            middle = np.hypot(x, y)
            if not middle >= least:
                continue
            di, dj = (0, 1) if abs(x) >= abs(y) else (1, 0)
            # Only the part along this pixel's own gradient counts, so that another edge nearby does not hide it.
            before = (gx[i - di, j - dj] * x + gy[i - di, j - dj] * y) / middle
            after = (gx[i + di, j + dj] * x + gy[i + di, j + dj] * y) / middle
            if not (middle >= before and middle > after):
                continue
            bend = before - 2.0 * middle + after
            offset[i, j] = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
            count += 1
    return count


@kernel
def grow(
    index: NDArray[np.int32],
    place: NDArray[np.int32],
    direction: NDArray[np.float64],
    cosine: float,
    label: NDArray[np.int32],
) -> int:
    """Join edge pixels, neighbours or with one pixel between them, whose gradient agrees with that of the chain so far.

    Parameters
    ----------
    index
        Number of the edge pixel at each place, shape (h, w); -1: none.
    place
        Row and column of the edge pixels, shape (n, 2), those with the steepest gradient first: they begin chains.
    direction
        Their unit gradients (x, y), shape (n, 2).
    cosine
        Smallest cosine of the angle between a pixel's gradient and the mean of its chain.
    label
        Filled, shape (n,): number of the chain.

    Returns
    -------
    int
        Number of chains.
    """
    h, w = index.shape
    n = place.shape[0]
    stack = np.empty(n, np.int32)
    for k in range(n):
        label[k] = -1
    chains = 0
    for seed in range(n):
        if label[seed] >= 0:
            continue
        label[seed] = chains
        stack[0] = seed
        top = 1
        sx, sy = direction[seed, 0], direction[seed, 1]
        while top > 0:
            top -= 1
            k = stack[top]
            # Near 45 degrees noise decides between rows and columns, and single pixels are missing.
            for i in range(max(place[k, 0] - 2, 0), min(place[k, 0] + 3, h)):
                for j in range(max(place[k, 1] - 2, 0), min(place[k, 1] + 3, w)):
                    m = index[i, j]
                    if m < 0 or label[m] >= 0:
                        continue
                    ux, uy = direction[m, 0], direction[m, 1]
                    if ux * sx + uy * sy < cosine * np.sqrt(sx * sx + sy * sy):
                        continue
                    label[m] = chains
                    sx += ux
                    sy += uy
                    stack[top] = m
                    top += 1
        chains += 1
    return chains

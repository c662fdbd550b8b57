"""One band resampled at places that are displaced by a little from its own pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def shift_band(source, valid, offset, moved, rule, out, out_valid):
    """Values of a band at (column + dx, row + dy), by a separable kernel whose weights are polynomials.

    Beyond the border of the image the pixels at the border stand in; a value is valid where every pixel that carries
    weight is valid, and where its place lies at most half a pixel outside the source.

    Parameters
    ----------
    source : (H, W)
        Pixels of the band around the window.
    valid : (H, W) bool, or (0, 0) where all are valid
    offset : (int, int)
        Column and row of the window's first pixel in `source`.
    moved : (2, h, w) float64
        dx and dy of every pixel of the window.
    rule : (coefficients, limits)
        Coefficients (degree + 1, taps) float64 as `photoplan.kernels.weights.Kernel` holds them; smallest and largest
        value of whole-number types, the first above the second for floats: no rounding.
    out : (h, w), same type as the source
    out_valid : (h, w) bool
        Only ever set to False.
    """
    coefficients, limits = rule
    height, width = source.shape
    taps = coefficients.shape[1]
    degree = coefficients.shape[0] - 1
    first = taps // 2 - 1
    wx, wy = np.empty(taps), np.empty(taps)
    masked = valid.shape[0] > 0
    rounds = limits[0] < limits[1]
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            x = offset[0] + c + moved[0, r, c]
            y = offset[1] + r + moved[1, r, c]
            if not (x >= -0.5 and y >= -0.5 and x <= width - 0.5 and y <= height - 0.5):
                out_valid[r, c] = False
                out[r, c] = 0
                continue
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            gx, gy = x - x0 - 0.5, y - y0 - 0.5
            for t in range(taps):
                a, b = coefficients[degree, t], coefficients[degree, t]
                for k in range(degree - 1, -1, -1):
                    a = a * gx + coefficients[k, t]
                    b = b * gy + coefficients[k, t]
                wx[t], wy[t] = a, b
            total = 0.0
            good = True
            for j in range(taps):
                row = min(max(y0 + j - first, 0), height - 1)
                part = 0.0
                for i in range(taps):
                    column = min(max(x0 + i - first, 0), width - 1)
                    part += wx[i] * source[row, column]
                    if masked and not valid[row, column] and abs(wx[i] * wy[j]) > 1e-6:
                        good = False
                total += wy[j] * part
            if not good:
                out_valid[r, c] = False
                out[r, c] = 0
                continue
            if rounds:
                total = min(max(np.floor(total + 0.5), limits[0]), limits[1])
            out[r, c] = total


def limits_of(dtype: np.dtype[Any]) -> tuple[float, float]:
    """The limits in the `rule` of `shift_band` for a type of pixels."""
    if dtype.kind not in "iu":
        return 1.0, 0.0
    info = np.iinfo(dtype)
    return float(info.min), float(info.max)


def no_mask() -> NDArray[np.bool_]:
    """The `valid` of `shift_band` where every pixel is valid."""
    return np.empty((0, 0), np.bool_)

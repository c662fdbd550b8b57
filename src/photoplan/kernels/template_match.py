"""A template sampled at the pixels of an image, with its derivatives: the core of least-squares template matching."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel


@inner
def _cubic(t, w, d):
    """Weights of the four neighbours in cubic convolution (a = −1/2) at 0 ≤ t < 1, and their derivatives."""
    t2 = t * t
    t3 = t2 * t
    w[0] = -0.5 * t + t2 - 0.5 * t3
    w[1] = 1.0 - 2.5 * t2 + 1.5 * t3
    w[2] = 0.5 * t + 2.0 * t2 - 1.5 * t3
    w[3] = -0.5 * t2 + 0.5 * t3
    d[0] = -0.5 + 2.0 * t - 1.5 * t2
    d[1] = -5.0 * t + 4.5 * t2
    d[2] = 0.5 + 4.0 * t - 4.5 * t2
    d[3] = -t + 1.5 * t2


@kernel
def sample_template(values: NDArray[Any], weights: NDArray[Any], to_template: NDArray[Any], out: NDArray[Any]):
    """Template values, derivatives and weights at every pixel of a window.

    Parameters
    ----------
    values, weights : ndarrays, shape (a, b)
        The template; finite everywhere.
    to_template : ndarray, shape (2, 3)
        From (column, row) of the window to those of the template: A p + t.
    out : ndarray, shape (4, h, w)
        Receives value, derivatives by the window's column and row, and weight; the weight is 0 outside the template.
    """
    height, width = values.shape
    wx, wy, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for r in range(out.shape[1]):
        for c in range(out.shape[2]):
            x = to_template[0, 0] * c + to_template[0, 1] * r + to_template[0, 2]
            y = to_template[1, 0] * c + to_template[1, 1] * r + to_template[1, 2]
            i, j = int(np.floor(y)), int(np.floor(x))
            if i < 1 or j < 1 or i + 2 >= height or j + 2 >= width:
                out[0, r, c], out[1, r, c], out[2, r, c], out[3, r, c] = 0.0, 0.0, 0.0, 0.0
                continue
            _cubic(x - j, wx, dx)
            _cubic(y - i, wy, dy)
            value, along, down = 0.0, 0.0, 0.0
            for k in range(4):
                v, d = 0.0, 0.0
                for m in range(4):
                    t = values[i - 1 + k, j - 1 + m]
                    v += wx[m] * t
                    d += dx[m] * t
                value += wy[k] * v
                along += wy[k] * d
                down += dy[k] * v
            out[0, r, c] = value
            out[1, r, c] = along * to_template[0, 0] + down * to_template[1, 0]
            out[2, r, c] = along * to_template[0, 1] + down * to_template[1, 1]
            out[3, r, c] = weights[int(np.round(y)), int(np.round(x))]

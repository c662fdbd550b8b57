"""Residuals of grey values gathered at the places of a surface."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_grey import grey_at
from photoplan.kernels.jit import kernel


@kernel
def add_residuals(places, residuals, finer, sums):
    """Add an image's standardised residuals to the cells that its pixels lie in.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `facets_transfer.transfer`.
    residuals : ndarray, shape (h, w), float32
        Grey value of the surface less that of the pixel, standard deviations; NaN: not used.
    finer : int
        Cells along the side of a height facet; those of 1 lie around the posts.
    sums : ndarray, shape (rows · finer, columns · finer, 3)
        Added: pixels, sum, and sum of squares.
    """
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            v = residuals[r, c]
            if np.isnan(v):
                continue
            i = min(int((places[r, c, 0] + 0.5) * finer), sums.shape[1] - 1)
            j = min(int((places[r, c, 1] + 0.5) * finer), sums.shape[0] - 1)
            sums[j, i, 0] += 1.0
            sums[j, i, 1] += v
            sums[j, i, 2] += v * v


@kernel
def sample_slopes(values, ratio, at, out):
    """Change of the grey value per post along columns and rows, at places (n, 2) of the posts inside them; out has
    shape (n, 2)."""
    x, y, dx, dy, found = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    for k in range(len(at)):
        grey_at(values, at[k, 0] * ratio, at[k, 1] * ratio, x, y, dx, dy, found)
        out[k, 0], out[k, 1] = found[1] * ratio, found[2] * ratio

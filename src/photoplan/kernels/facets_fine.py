"""What cubic grey facets do not hold of waves little longer than they are."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_grey import spline
from photoplan.kernels.facets_sums import PAD
from photoplan.kernels.jit import kernel


@kernel
def add_missed(values, ratio, places, weights, table, grey):
    """Add to the grey values of an image's pixels what the facets have there more than waves have that go on between
    their coefficients.

    Parameters
    ----------
    values, ratio
        Coefficients of the grey facets, and how many lie along a side of a height facet.
    places, weights
        See `facets_sums.add_grey`.
    table : ndarray, shape (n + 1, taps)
        Shares of `taps` coefficients, the middle two of which are those beside a place, for its parts k / n of a facet.
    grey : ndarray, shape (h, w), float32
        Added; nothing near the border, nor where a weight is 0.
    """
    parts, taps = table.shape[0] - 1, table.shape[1]
    x, y, right, down = np.empty(4), np.empty(4), np.empty(taps), np.empty(taps)
    before = taps // 2 - 1
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            if not weights[r, c] > 0.0:
                continue
            s, t = places[r, c, 0] * ratio, places[r, c, 1] * ratio
            i, j = int(s), int(t)
            left, top = i + PAD - before, j + PAD - before
            if left < 0 or top < 0 or left + taps > values.shape[1] or top + taps > values.shape[0]:
                continue
            spline(s - i, x)
            spline(t - j, y)
            k, m = min(int((s - i) * parts), parts - 1), min(int((t - j) * parts), parts - 1)
            f, g = (s - i) * parts - k, (t - j) * parts - m
            for a in range(taps):
                right[a] = (1.0 - f) * table[k, a] + f * table[k + 1, a]
                down[a] = (1.0 - g) * table[m, a] + g * table[m + 1, a]
            missed = 0.0
            for b in range(taps):
                row, cubic = 0.0, 0.0
                for a in range(taps):
                    row += right[a] * values[top + b, left + a]
                if before - 1 <= b < before + 3:
                    for a in range(4):
                        cubic += x[a] * values[top + b, left + before - 1 + a]
                    missed += y[b - before + 1] * cubic
                missed -= down[b] * row
            grey[r, c] += missed

"""The edge between sky and ground in a photograph: in every column one row, found for all columns together.

Sky is even, so that the edge is the first strong change of grey values from above; and the edge of a column lies near
that of the next one. Both together are a cost for each pixel and one for each step between columns, of which the least
sum is found by dynamic programming (Bellman 1957).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

_Floats = NDArray[np.float64]

#: Width of the derivative that finds edges, pixels.
SIGMA = 1.5
#: What a change of grey values is full evidence of an edge, in parts of the strong ones (99th percentile).
_FULL = 0.5
#: Least change that is an edge at all, in the same unit: columns without it have none.
_LEAST = 0.15
#: Costs: evidence above the edge against that at the edge; a pixel of a step between columns, and the dearest step.
_ABOVE, _STEP, _DEAREST = 0.15, 0.02, 0.6
_NEVER = 1e6
#: From where a change is evident to its middle, pixels at most.
_SHOULDER = 4


def edge_strength(grey: NDArray[np.floating]) -> _Floats:
    """How much grey values (height, width) change downwards in each pixel, same shape; 0 near pixels without value."""
    known = np.isfinite(grey)
    even = np.where(known, grey, 0.0).astype(float)
    change = np.abs(gaussian_filter1d(even, SIGMA, axis=0, order=1, mode="nearest"))
    # Where part of the derivative has met no value.
    hidden = gaussian_filter1d((~known).astype(float), SIGMA, axis=0, mode="nearest") > 1e-6
    change[hidden] = 0.0
    return np.asarray(gaussian_filter1d(change, SIGMA / 2, axis=1, mode="nearest"))


def sky_edge(strength: NDArray[np.floating], low: NDArray[np.integer], high: NDArray[np.integer]) -> _Floats:
    """Rows of the edge in every column, to a part of a pixel, shape (width,); NaN: there is none."""
    height, width = strength.shape
    row = np.arange(height)[:, None]
    allowed = (row >= low) & (row <= high)
    out = np.full(width, np.nan)
    columns = np.flatnonzero(allowed.any(axis=0))
    if not len(columns) or not (scale := float(np.percentile(strength[allowed], 99))) > 0:
        return out
    part = np.where(allowed, strength, 0.0) / scale
    evidence = np.minimum(part / _FULL, 1.0)
    above = np.cumsum(evidence, axis=0) - evidence
    cost = np.where(allowed, _ABOVE * above - evidence, _NEVER)
    rows = _cheapest(cost[:, columns])
    # From the shoulder of the change, where it is evident, to its middle.
    around = np.clip(rows[None] + np.arange(-_SHOULDER, _SHOULDER + 1)[:, None], 0, height - 1)
    rows = around[np.argmax(part[around, columns], axis=0), np.arange(len(columns))]
    near = np.clip(rows[None] + np.array([[-1], [0], [1]]), 0, height - 1)
    before, here, after = part[near, columns]
    bent = before - 2 * here + after
    top = (before < here) & (here >= after)
    shift = np.where(top, (before - after) / np.where(top, 2 * bent, 1.0), 0.0)
    out[columns] = np.where(here > _LEAST, rows + np.clip(shift, -0.5, 0.5), np.nan)
    return out


def _cheapest(cost: _Floats) -> NDArray[np.int64]:
    """The row of each column of (height, width) with the least sum of costs, steps between them included."""
    height, width = cost.shape
    slope = _STEP * np.arange(height)
    sums = np.empty_like(cost)
    sums[:, 0] = cost[:, 0]
    for k in range(1, width):
        last = sums[:, k - 1]
        down = np.minimum.accumulate(last - slope) + slope
        up = (np.minimum.accumulate((last + slope)[::-1]))[::-1] - slope
        sums[:, k] = cost[:, k] + np.minimum(np.minimum(down, up), last.min() + _DEAREST)
    rows = np.empty(width, np.int64)
    rows[-1] = np.argmin(sums[:, -1])
    for k in range(width - 2, -1, -1):
        step = np.minimum(_STEP * np.abs(np.arange(height) - rows[k + 1]), _DEAREST)
        rows[k] = np.argmin(sums[:, k] + step)
    return rows

"""Means over squares of neighbouring values, from sums that slide along."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import kernel

#: Rows that slide at once: the sum of each waits for that of the column before.
_TOGETHER = 4


@kernel
def box_means(values, before, after, out):
    """Means of values (rows, columns) over the rows and columns k − before … k + after − 1 that there are.

    `out` has the same shape, float64. None is below the least value: sums that slide past large ones may end beside 0.
    """
    rows, columns = values.shape
    least = np.inf
    for j in range(rows):
        for i in range(columns):
            least = min(least, values[j, i])
    down = np.zeros((_TOGETHER, columns))
    sums, along = np.zeros(columns), np.zeros(_TOGETHER)
    for j in range(-after + 1, 0):
        # What the window of the first row has but the last of its rows.
        if j + after - 1 < rows:
            for i in range(columns):
                sums[i] += values[j + after - 1, i]
    for first in range(0, rows, _TOGETHER):
        several = min(_TOGETHER, rows - first)
        for n in range(several):
            j = first + n
            if j + after - 1 < rows:
                for i in range(columns):
                    sums[i] += values[j + after - 1, i]
            if j - before - 1 >= 0:
                for i in range(columns):
                    sums[i] -= values[j - before - 1, i]
            count = min(j + after, rows) - max(j - before, 0)
            for i in range(columns):
                down[n, i] = sums[i] / count
        along[:] = 0.0
        for i in range(min(after - 1, columns)):
            for n in range(_TOGETHER):
                along[n] += down[n, i]
        for i in range(columns):
            count = min(i + after, columns) - max(i - before, 0)
            for n in range(several):
                if i + after - 1 < columns:
                    along[n] += down[n, i + after - 1]
                if i - before - 1 >= 0:
                    along[n] -= down[n, i - before - 1]
                out[first + n, i] = max(along[n] / count, least)

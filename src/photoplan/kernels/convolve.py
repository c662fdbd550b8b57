"""Two-dimensional convolution of one band, line by line, and rounding with a count of what is clipped.

A pixel's result depends on its neighbours alone, to the last bit: the order of the sums is that of the kernel's rows
and columns wherever a tile begins, and all columns go through the same vectorised code, because lines are padded to
multiples of `CHUNK`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel

__all__ = ["CHUNK", "EVEN_TAPS", "GENERAL_TAPS", "convolve_even", "convolve_general", "round_clipped"]

#: Columns are computed in multiples of this number: sixteen lanes, four at once.
CHUNK = 64
#: Columns of weights that are unrolled together; a tag of that length selects the compiled code.
GENERAL_TAPS = (5, 11)
#: The same for one half of an even kernel, without its middle.
EVEN_TAPS = (4, 5)


@kernel
def convolve_general(
    source: NDArray[np.float32],
    start: tuple[int, int],
    weights: NDArray[np.float32],
    taps_tag: tuple[Any, ...],
    out: NDArray[np.float32],
) -> None:
    """Sum of weights times pixels: out[y, x] = Σ weights[i, k] · source[row + y + i, column + x + k].

    Parameters
    ----------
    source : (height, width) float32, contiguous
        Finite values; reaches `CHUNK` columns beyond the last one that is needed.
    start : (row, column)
        Pixel of `source` under the first weight of the first result.
    weights : (rows, columns) float32
        The columns are a multiple of the tag's length, filled up with zeros.
    taps_tag : tuple
        Its length is how many columns of weights are summed in one pass.
    out : (height, width) float32
    """
    height, width = out.shape
    taps = len(taps_tag)
    rows, columns = weights.shape
    span = (width + CHUNK - 1) // CHUNK * CHUNK
    total = np.empty(span, np.float32)
    for y in range(height):
        for x in range(span):
            total[x] = np.float32(0.0)
        for i in range(rows):
            line = source[start[0] + y + i]
            for first in range(0, columns, taps):
                part = line[start[1] + first :]
                for x in range(span):
                    value = total[x]
                    for k in range(taps):
                        # Unsigned: a negative index would count from the end, and that test would forbid vectors.
                        value += weights[i, first + k] * part[np.uintp(x) + np.uintp(k)]
                    total[x] = value
        for x in range(width):
            out[y, x] = total[x]


@kernel
def convolve_even(
    source: NDArray[np.float32],
    start: tuple[int, int],
    weights: NDArray[np.float32],
    taps_tag: tuple[Any, ...],
    out: NDArray[np.float32],
) -> None:
    """The same for kernels that are even in both directions: equal rows are added first, then equal columns.

    Parameters
    ----------
    source, taps_tag, out
        As in `convolve_general`.
    start : (row, column)
        Pixel of `source` under the upper left corner of the whole kernel, zeros included, for the first result.
    weights : (m + 1, n + 1) float32
        Middle row and column first; n is a multiple of the tag's length.
    """
    height, width = out.shape
    taps = len(taps_tag)
    m, n = weights.shape[0] - 1, weights.shape[1] - 1
    span = (width + CHUNK - 1) // CHUNK * CHUNK
    total = np.empty(span, np.float32)
    folded = np.empty(span + 2 * n, np.float32)
    for y in range(height):
        for x in range(span):
            total[x] = np.float32(0.0)
        for i in range(m + 1):
            above, below = source[start[0] + y + m - i, start[1] :], source[start[0] + y + m + i, start[1] :]
            if i == 0:
                for x in range(span + 2 * n):
                    folded[x] = above[x]
            else:
                for x in range(span + 2 * n):
                    folded[x] = above[x] + below[x]
            for x in range(span):
                total[x] += weights[i, 0] * folded[np.uintp(x) + np.uintp(n)]
            for first in range(1, n + 1, taps):
                left, right = folded[n - first - taps + 1 :], folded[n + first :]
                for x in range(span):
                    value = total[x]
                    for k in range(taps):
                        both = left[np.uintp(x) + np.uintp(taps - 1 - k)] + right[np.uintp(x) + np.uintp(k)]
                        value += weights[i, first + k] * both
                    total[x] = value
        for x in range(width):
            out[y, x] = total[x]


@kernel
def round_clipped(
    values: NDArray[np.float32], valid: NDArray[np.bool_], limits: tuple[float, float], out: NDArray[Any]
) -> tuple[int, int]:
    """Round to whole numbers, halves away from zero, and clip to what the type holds.

    Parameters
    ----------
    values : (height, width) float32
    valid : (height, width) bool, or (0, 0): all are
        Only valid pixels are counted.
    limits : (low, high)
        Least and largest value of the type of `out`.
    out : (height, width), a type of whole numbers

    Returns
    -------
    below, above : int
        Pixels whose rounded value was below `low` and above `high`.
    """
    low, high = np.float32(limits[0]), np.float32(limits[1])
    everywhere = valid.shape[0] == 0
    below, above = 0, 0
    for y in range(values.shape[0]):
        for x in range(values.shape[1]):
            size = abs(values[y, x])
            whole = np.floor(size)
            # The difference is exact, whereas size + 0.5 may be rounded up to the next whole number.
            whole += np.float32(1.0) if size - whole >= np.float32(0.5) else np.float32(0.0)
            value = -whole if values[y, x] < 0 else whole
            counts = everywhere or valid[y, x]
            below += value < low and counts
            above += value > high and counts
            out[y, x] = np.int32(min(max(value, low), high))
    return below, above

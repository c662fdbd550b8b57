"""Two-dimensional convolution of one band, line by line, and rounding with a count of what is clipped.

A pixel's result depends on its neighbours alone, to the last bit: the order of the sums is that of the kernel's rows
and columns wherever a tile begins, and all columns go through the same vectorised code, because lines are padded to
multiples of `CHUNK`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

#: Columns are computed in multiples of this number: sixteen lanes, four at once.
CHUNK = 64
#: Columns of weights that are unrolled together; a tag of that length selects the compiled code.
GENERAL_TAPS = (5, 11)
#: The same for one half of an even kernel, without its middle.
EVEN_TAPS = (5,)


@inner
def _finish(
    total: NDArray[np.float32], valid: NDArray[np.bool_], limits: tuple[Any, ...], y: int, out: NDArray[Any]
) -> tuple[int, int]:
    """Round a line of sums, clip it, and write it to row y of `out`; see `round_clipped` for what is counted."""
    low, high = np.float32(limits[0]), np.float32(limits[1])
    below, above = 0, 0
    if low > high:
        for x in range(out.shape[1]):
            out[y, x] = total[x]
        return below, above
    everywhere = valid.shape[0] == 0
    for x in range(out.shape[1]):
        size = abs(total[x])
        whole = np.floor(size)
        # The difference is exact, whereas size + 0.5 may be rounded up to the next whole number.
        whole += np.float32(1.0) if size - whole >= np.float32(0.5) else np.float32(0.0)
        value = -whole if total[x] < 0 else whole
        counts = everywhere or valid[y, x]
        below += value < low and counts
        above += value > high and counts
        out[y, x] = np.int32(min(max(value, low), high))
    return below, above


@kernel
def convolve_general(
    source: NDArray[np.float32],
    start: tuple[int, int],
    weights: NDArray[np.float32],
    taps_tag: tuple[Any, ...],
    valid: NDArray[np.bool_],
    limits: tuple[float, float],
    out: NDArray[Any],
) -> tuple[int, int]:
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
    valid, limits
        As in `round_clipped`; limits with low > high: sums are written as they are, and `out` is float32.
    out : (height, width)

    Returns
    -------
    below, above : int
        Clipped pixels, see `round_clipped`.
    """
    height, width = out.shape
    taps = len(taps_tag)
    rows, columns = weights.shape
    span = (width + CHUNK - 1) // CHUNK * CHUNK
    total = np.empty(span, np.float32)
    below, above = 0, 0
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
        counted = _finish(total, valid, limits, y, out)
        below += counted[0]
        above += counted[1]
    return below, above


@kernel
def convolve_even(
    source: NDArray[np.float32],
    start: tuple[int, int],
    weights: NDArray[np.float32],
    taps_tag: tuple[Any, ...],
    valid: NDArray[np.bool_],
    limits: tuple[float, float],
    out: NDArray[Any],
) -> tuple[int, int]:
    """The same for kernels that are even in both directions: equal rows are added first, then equal columns.

    Parameters
    ----------
    source, taps_tag, valid, limits, out
        As in `convolve_general`, which also says what is returned.
    start : (row, column)
        Pixel of `source` under the upper left corner of the whole kernel, zeros included, for the first result.
    weights : (m + 1, n + 1) float32
        Middle row and column first; n is a multiple of the tag's length, and not 0.
    """
    height, width = out.shape
    taps = len(taps_tag)
    m, n = weights.shape[0] - 1, weights.shape[1] - 1
    span = (width + CHUNK - 1) // CHUNK * CHUNK
    total = np.empty(span, np.float32)
    below, above = 0, 0
    folded = np.empty(span + 2 * n, np.float32)
    middle = folded[n:]
    for y in range(height):
        for x in range(span):
            total[x] = np.float32(0.0)
        for i in range(m + 1):
            first_line, second_line = source[start[0] + y + m - i, start[1] :], source[start[0] + y + m + i, start[1] :]
            if i == 0:
                for x in range(span + 2 * n):
                    folded[x] = first_line[x]
            else:
                for x in range(span + 2 * n):
                    folded[x] = first_line[x] + second_line[x]
            for first in range(1, n + 1, taps):
                left, right = folded[n - first - taps + 1 :], folded[n + first :]
                if first == 1:
                    for x in range(span):
                        value = total[x] + weights[i, 0] * middle[x]
                        for k in range(taps):
                            both = left[np.uintp(x) + np.uintp(taps - 1 - k)] + right[np.uintp(x) + np.uintp(k)]
                            value += weights[i, 1 + k] * both
                        total[x] = value
                else:
                    for x in range(span):
                        value = total[x]
                        for k in range(taps):
                            both = left[np.uintp(x) + np.uintp(taps - 1 - k)] + right[np.uintp(x) + np.uintp(k)]
                            value += weights[i, first + k] * both
                        total[x] = value
        counted = _finish(total, valid, limits, y, out)
        below += counted[0]
        above += counted[1]
    return below, above


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
    below, above = 0, 0
    for y in range(values.shape[0]):
        counted = _finish(values[y], valid, limits, y, out)
        below += counted[0]
        above += counted[1]
    return below, above

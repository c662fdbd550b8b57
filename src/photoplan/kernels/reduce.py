"""Images reduced by means of square blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def reduce_means(
    source: NDArray[Any],
    valid: NDArray[np.bool_],
    side: int,
    whole: bool,
    out: NDArray[Any],
    out_valid: NDArray[np.bool_],
) -> None:
    """Mean of the valid pixels of each block of side × side pixels; blocks at the right and lower edge may be smaller.

    Parameters
    ----------
    source : (bands, height, width)
    valid : (height, width) bool, or (0, 0): all are valid
    whole : bool
        Whether means are rounded, half up, as integers want it.
    out : (bands, ceil(height / side), ceil(width / side)), type of `source`
        Filled; 0 where invalid.
    out_valid : (ceil(height / side), ceil(width / side)) bool
        Filled: whether at least half of the block's pixels are valid.
    """
    height, width = source.shape[1:]
    for row in range(out.shape[1]):
        top, bottom = row * side, min((row + 1) * side, height)
        for col in range(out.shape[2]):
            left, right = col * side, min((col + 1) * side, width)
            count = 0
            if valid.size > 0:
                for y in range(top, bottom):
                    for x in range(left, right):
                        count += valid[y, x]
            else:
                count = (bottom - top) * (right - left)
            good = 2 * count >= (bottom - top) * (right - left)
            out_valid[row, col] = good
            for band in range(source.shape[0]):
                total = 0.0
                if good:
                    for y in range(top, bottom):
                        for x in range(left, right):
                            if valid.size == 0 or valid[y, x]:
                                total += np.float64(source[band, y, x])
                    total /= count
                out[band, row, col] = np.floor(total + 0.5) if whole else total

"""Pixels beyond the edge of an image or of its valid part, mirrored in the nearest valid pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def extend_oddly(
    source: NDArray[np.float32],
    valid: NDArray[np.bool_],
    wanted: NDArray[np.bool_],
    offsets: NDArray[np.int32],
    place: tuple[Any, ...],
    out: NDArray[np.float32],
) -> None:
    """Fill invalid pixels so that constants and linear ramps go on.

    An invalid pixel q gets ``2 v(p) - v(2 p - q)`` from the nearest valid pixel p: the image reflected in p, grey value
    included. Where the pixel beyond p is invalid it gets v(p); where the pixel opposite of p is valid too, both are
    averaged; so are all valid pixels at the same distance.

    Parameters
    ----------
    source : (bands, height, width) float32
    valid : (height, width) bool
    wanted : (rows, columns) bool
        Pixels of `out` to be filled: invalid, with a valid one within the offsets.
    offsets : (n, 3) int32
        Squared distance, rows, columns: neighbours in the order of their distance, without (0, 0).
    place : (row, column, column in out)
        Pixel of `source` that is the first of `wanted`, and its column in `out`.
    out : (bands, rows, at least columns) float32
    """
    height, width = valid.shape
    for row in range(wanted.shape[0]):
        for col in range(wanted.shape[1]):
            if not wanted[row, col]:
                continue
            y, x = place[0] + row, place[1] + col
            nearest, count = -1, 0
            for k in range(offsets.shape[0]):
                if nearest >= 0 and offsets[k, 0] > nearest:
                    break
                dy, dx = offsets[k, 1], offsets[k, 2]
                py, px = y + dy, x + dx
                if not (0 <= py < height and 0 <= px < width and valid[py, px]):
                    continue
                nearest = offsets[k, 0]
                count += 1
                oy, ox = y - dy, x - dx
                between = 0 <= oy < height and 0 <= ox < width and valid[oy, ox]
                my, mx = py + dy, px + dx
                mirrored = not between and 0 <= my < height and 0 <= mx < width and valid[my, mx]
                for band in range(source.shape[0]):
                    value = source[band, py, px]
                    if mirrored:
                        value = np.float32(2.0) * value - source[band, my, mx]
                    before = out[band, row, place[2] + col] if count > 1 else np.float32(0.0)
                    out[band, row, place[2] + col] = before + value
            for band in range(source.shape[0]):
                if count > 0:
                    out[band, row, place[2] + col] /= np.float32(count)

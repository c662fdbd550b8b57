"""Second step of a tile: the pixels whose taps are all inside and valid. Nearly all of the time is spent here."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.place import ALL, INTERIOR
from photoplan.kernels.position import RUN
from photoplan.kernels.sampling import gather


@inner
def _write(
    buffer: NDArray[Any], lanes_tag: tuple[Any, ...], first_band: int, place: tuple[Any, ...], out: NDArray[Any]
) -> None:
    """Bands side by side to planes, at place = (row, column, count)."""
    row, col, count = place
    lanes = len(lanes_tag)
    for lane in range(min(lanes, out.shape[0] - first_band)):
        target = out[first_band + lane, row, col : col + count]
        for i in range(count):
            target[i] = buffer[i * lanes + lane]


@kernel
def gather_runs(
    source: NDArray[Any],
    runs: NDArray[np.int32],
    offset: tuple[int, int],
    block: tuple[Any, ...],
    coefficients: NDArray[Any],
    tags: tuple[Any, ...],
    out: NDArray[Any],
) -> None:
    """Resample the INTERIOR pixels of runs, write 0 to all others.

    Parameters
    ----------
    source : (groups, height, width, lanes)
        See `pack`.
    runs : (k, 5) int32
    offset : (col, row)
        First pixel of `out` in the tile's pixels.
    block : tuple
        See `empty_block`, filled by `place_runs`.
    coefficients : (degree + 1, 2·W) float32
    tags : tuple
        Tags for taps and lanes; see `gather`.
    out : (bands, rows, cols)
    """
    corner, taps, part, kind, fill, _ = block
    taps_tag, lanes_tag = tags
    lanes = len(lanes_tag)
    groups, height, width, _ = source.shape
    stride = np.int64(width) * lanes
    buffer = np.zeros(RUN * lanes, source.dtype)
    for k in range(runs.shape[0]):
        n = runs[k, 4] - runs[k, 3]
        columns, rows, across, down = taps[k, 0], taps[k, 1], part[k, 0], part[k, 1]
        for group in range(groups):
            start = ((group * height + corner[k, 1]) * width + corner[k, 0]) * lanes
            for i in range(n):
                if fill[k] == ALL or kind[k, i] == INTERIOR:
                    first = start + rows[i] * stride + columns[i] * np.int64(lanes)
                    gather(source, first, stride, across[i], down[i], coefficients, taps_tag, lanes_tag, buffer, i)
                else:
                    for lane in range(lanes):
                        buffer[i * lanes + lane] = 0
            _write(buffer, lanes_tag, group * lanes, (runs[k, 1] - offset[1], runs[k, 3] - offset[0], n), out)

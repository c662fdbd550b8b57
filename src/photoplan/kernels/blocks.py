"""Tiles into the blocks of a file: bands side by side, invalid pixels filled, valid ones kept off nodata."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


@kernel
def fill_block(
    pixels: NDArray[Any],
    valid: NDArray[np.bool_],
    nodata: Any,
    neighbour: Any,
    fill: NDArray[Any],
    block: NDArray[Any],
) -> int:
    """Write a tile into the upper left of a block.

    Parameters
    ----------
    pixels : ndarray, shape (bands, height, width)
    valid : ndarray of bool, shape (height, width), or (0, 0): all are
    nodata, neighbour : scalars of the pixels' type
        Valid values that equal `nodata` become `neighbour`; with two equal scalars, or NaN, none is changed.
    fill : ndarray, shape (bands,), type of the pixels
        What invalid pixels hold.
    block : ndarray, shape (side, side, bands), type of the pixels
        The rest of it is left as it is.

    Returns
    -------
    int
        Number of valid values that became `neighbour`.
    """
    bands, height, width = pixels.shape
    everywhere = valid.shape[0] == 0
    apart = nodata != neighbour
    moved = 0
    for row in range(height):
        for band in range(bands):
            blank = fill[band]
            if everywhere:
                for col in range(width):
                    value = pixels[band, row, col]
                    hit = apart and value == nodata
                    moved += hit
                    block[row, col, band] = neighbour if hit else value
            else:
                for col in range(width):
                    value = pixels[band, row, col]
                    hit = apart and value == nodata and valid[row, col]
                    moved += hit
                    kept = neighbour if hit else value
                    block[row, col, band] = kept if valid[row, col] else blank
    return moved

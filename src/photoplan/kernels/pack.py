"""Pixels with their bands side by side: the source as the kernels want it, and tiles as the blocks of a file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel


def pack(source: NDArray[Any], valid: NDArray[Any] | None = None) -> NDArray[Any]:
    """Planar pixels as groups of bands.

    Parameters
    ----------
    source : ndarray, shape (bands, height, width)
        uint8, uint16, int16 or float32.
    valid : ndarray, shape (height, width), or None
        Bool or uint8; pixels where it is 0 become 0, so that what they hold (nodata, NaN) cannot reach a product.

    Returns
    -------
    ndarray, shape (groups, height, width, lanes)
        One band: one group of one lane. More: groups of four bands side by side, the last filled up with 0.
    """
    bands, height, width = source.shape
    if bands == 1 and valid is None:
        return np.ascontiguousarray(source).reshape(1, height, width, 1)
    lanes = 1 if bands == 1 else 4
    packed = np.empty((-(-bands // lanes), height, width, lanes), source.dtype)
    if valid is None:
        _interleave(np.ascontiguousarray(source), packed)
    else:
        _interleave_valid(np.ascontiguousarray(source), as_bytes(valid), packed)
    return packed


def as_bytes(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """A mask as contiguous bytes, without a copy where it is one already."""
    return np.ascontiguousarray(mask).view(np.uint8)


@kernel
def _interleave(source: NDArray[Any], packed: NDArray[Any]) -> None:
    """Two bands or more. Four named lanes, not a loop over them: the compiler then writes whole pixels."""
    bands, height, width = source.shape
    groups = packed.shape[0]
    nothing = np.zeros(width, source.dtype)
    for group in range(groups):
        first = 4 * group
        for row in range(height):
            a = source[first, row]
            b = source[first + 1, row] if first + 1 < bands else nothing
            c = source[first + 2, row] if first + 2 < bands else nothing
            d = source[first + 3, row] if first + 3 < bands else nothing
            target = packed[group, row]
            for i in range(width):
                target[i, 0] = a[i]
                target[i, 1] = b[i]
                target[i, 2] = c[i]
                target[i, 3] = d[i]


@kernel
def _interleave_valid(source: NDArray[Any], valid: NDArray[np.uint8], packed: NDArray[Any]) -> None:
    bands, height, width = source.shape
    groups, lanes = packed.shape[0], packed.shape[3]
    zero = source.dtype.type(0)
    for group in range(groups):
        for row in range(height):
            target = packed[group, row]
            usable = valid[row]
            for lane in range(lanes):
                band = group * lanes + lane
                if band < bands:
                    line = source[band, row]
                    for i in range(width):
                        target[i, lane] = line[i] if usable[i] != 0 else zero
                else:
                    for i in range(width):
                        target[i, lane] = zero


@kernel
def solid_patches(valid: NDArray[np.uint8], taps: int) -> NDArray[np.uint8]:
    """1 where the taps × taps pixels from (row, column) on to the lower right are all inside and valid; uint8."""
    height, width = valid.shape
    solid = np.zeros((height, width), np.uint8)
    along = np.zeros((height, width), np.uint8)
    for row in range(height):
        for col in range(width - taps + 1):
            every = valid[row, col]
            for k in range(1, taps):
                every = min(every, valid[row, col + k])
            along[row, col] = 1 if every != 0 else 0
    for row in range(height - taps + 1):
        for k in range(taps):
            for col in range(width):
                solid[row, col] = along[row, col] if k == 0 else solid[row, col] & along[row + k, col]
    return solid


@kernel
def fill_block(
    pixels: NDArray[Any], valid: NDArray[np.bool_], nodata: Any, neighbour: Any, fill: NDArray[Any], block: NDArray[Any]
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

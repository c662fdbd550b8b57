"""One pixel gathered from a packed source, and a block of pixels added up: the innermost steps.

The loops below say what is computed; they run as plain Python, and compiled where numba's inside is not known. Else the
same is computed by the vectors of `numba_parts`: equal to the rounding of 32-bit sums, one grey level where that
decides, 2e-6 of the largest value for float data.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from photoplan.kernels import numba_parts
from photoplan.kernels.jit import inner, maker


def _limits(pixels: NDArray[Any]) -> tuple[np.float32, np.float32, np.float32]:
    """Smallest and largest value of the pixels' type, and what is added before it is cut; three zeros for floats."""
    if pixels.dtype.kind == "f":
        return np.float32(0.0), np.float32(0.0), np.float32(0.0)
    info = np.iinfo(pixels.dtype)
    return np.float32(info.min), np.float32(info.max), np.float32(0.5)


@overload(_limits)
def _limits_of_type(pixels: Any) -> Any:
    """The same, known when the kernel is compiled."""
    low, high, half = (float(each) for each in _limits(np.empty(0, str(pixels.dtype))))

    def limits(pixels: Any) -> Any:
        return np.float32(low), np.float32(high), np.float32(half)

    return limits


@inner
def _weight(coefficients: NDArray[np.float32], column: int, g: Any) -> Any:
    """Horner's rule."""
    value = coefficients[coefficients.shape[0] - 1, column]
    for power in range(coefficients.shape[0] - 2, -1, -1):
        value = value * g + coefficients[power, column]
    return value


@maker
def gather_loops(
    source: NDArray[Any],
    first: Any,
    stride: Any,
    gx: float,
    gy: float,
    coefficients: NDArray[Any],
    taps_tag: tuple[Any, ...],
    lanes_tag: tuple[Any, ...],
    out: NDArray[Any],
    at: int,
) -> None:
    """Weighted sum of taps × taps pixels of `lanes` interleaved bands, rounded into out[at·lanes : …].

    Parameters
    ----------
    source : array of any shape, C order
        Packed pixels (see `pack`); indices below count its elements.
    first, stride : int
        Element of the first tap, and elements from one row of taps to the next.
    gx, gy : float
        x − floor(x) − 1/2 and y − floor(y) − 1/2.
    coefficients : (degree + 1, 2·W) float32
        Powers of g down, taps of x then taps of y across, W = taps rounded up to a power of two.
    taps_tag, lanes_tag : tuple of int
        Only their lengths count: number of taps, number of bands side by side. They are part of the types, so each
        combination is compiled on its own.
    out : one-dimensional, same type as the source
    at : int
        Pixel of `out` to be written.
    """
    taps, lanes, width = len(taps_tag), len(lanes_tag), coefficients.shape[1] // 2
    low, high, half = _limits(source)
    flat = source.ravel()
    middle = max(taps // 2 - 1, 0)
    x, y = np.float32(gx), np.float32(gy)
    for lane in range(lanes):
        # Float data are taken relative to one of the taps, so that a constant image stays constant to the last bit.
        base = np.float32(0.0) if half > 0 else np.float32(flat[first + middle * (stride + lanes) + lane])
        value = base
        for i in range(taps):
            column = np.float32(0.0)
            for r in range(taps):
                pixel = np.float32(flat[first + r * stride + i * lanes + lane])
                column += _weight(coefficients, width + r, y) * (pixel - base)
            value += _weight(coefficients, i, x) * column
        if half > 0:
            value = min(max(np.trunc(value + np.copysign(half, value)), low), high)
        out[at * lanes + lane] = value


@maker
def gather_apart_loops(
    source: NDArray[Any],
    rows: NDArray[np.int64],
    gx: NDArray[np.float32],
    gy: float,
    coefficients: NDArray[Any],
    taps_tag: tuple[Any, ...],
    lanes_tag: tuple[Any, ...],
    out: NDArray[Any],
    at: int,
) -> None:
    """As `gather`, of rows that lie apart: each has a first element and a fraction of its own.

    Parameters
    ----------
    rows : (taps,) int64
        Element of the first tap of each row.
    gx : (taps,) float32
        x − floor(x) − 1/2 in each row.
    """
    taps, lanes, width = len(taps_tag), len(lanes_tag), coefficients.shape[1] // 2
    low, high, half = _limits(source)
    flat, middle, y = source.ravel(), max(taps // 2 - 1, 0), np.float32(gy)
    for lane in range(lanes):
        base = np.float32(0.0) if half > 0 else np.float32(flat[rows[middle] + middle * lanes + lane])
        value = base
        for r in range(taps):
            line = np.float32(0.0)
            for i in range(taps):
                line += _weight(coefficients, i, gx[r]) * (np.float32(flat[rows[r] + i * lanes + lane]) - base)
            value += _weight(coefficients, width + r, y) * line
        if half > 0:
            value = min(max(np.trunc(value + np.copysign(half, value)), low), high)
        out[at * lanes + lane] = value


@maker
def add_block_loops(
    source: NDArray[Any],
    place: tuple[Any, ...],
    wx: NDArray[np.float32],
    wy: NDArray[np.float32],
    base: NDArray[np.float32],
    lanes_tag: tuple[Any, ...],
    sums: NDArray[np.float32],
) -> None:
    """Add the weighted sum of a block of pixels, some columns wide and any number of rows high.

    sums[lane] += Σ wx[at_x + i] · wy[at_y + r] · (source[first + r · stride + i · lanes + lane] − base[lane]) over the
    `block_pixels` columns i and the rows r; integers are summed without base.

    Parameters
    ----------
    source : array of any shape, C order
    place : (first, stride, rows, at_x, at_y)
        Element of the first pixel, elements from row to row, number of rows, first weight of x and of y.
    wx, wy, base, sums : one-dimensional float32
    lanes_tag : tuple of int
        Its length counts: bands side by side.
    """
    first, stride, rows, at_x, at_y = place
    lanes, half = len(lanes_tag), _limits(source)[2]
    flat = source.ravel()
    for lane in range(lanes):
        level = np.float32(0.0) if half > 0 else base[lane]
        total = np.float32(0.0)
        for i in range(block_pixels(lanes_tag)):
            column = np.float32(0.0)
            for r in range(rows):
                column += wy[at_y + r] * (np.float32(flat[first + r * stride + i * lanes + lane]) - level)
            total += wx[at_x + i] * column
        sums[lane] += total


@inner
def block_pixels(lanes_tag: tuple[Any, ...]) -> int:
    """Columns of a block of `add_block`."""
    return 8 if len(lanes_tag) == 1 else 4


gather = numba_parts.gather if numba_parts.USABLE else gather_loops
gather_apart = numba_parts.gather_apart if numba_parts.USABLE else gather_apart_loops
add_block = numba_parts.add_block if numba_parts.USABLE else add_block_loops

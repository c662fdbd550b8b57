"""Resampling: weighted sums of source pixels under a kernel, means where an output pixel covers many, validity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from photoplan.kernels import numba_internals
from photoplan.kernels.jit import inner, kernel, maker
from photoplan.kernels.positions import (
    ALL,
    AVERAGE,
    BORDER,
    EMPTY,
    INTERIOR,
    RUN,
    line_offset,
    line_offset_at,
    offset_column,
)
from photoplan.kernels.weights import TABLE_STEPS

# One pixel gathered from an interleaved source, and a block of pixels summed: the innermost steps.
#
# The loops below say what is computed; they run as plain Python, and compiled where numba's inside is not known. Else
# the same is computed by the vectors of `numba_internals`: equal to the rounding of 32-bit sums, one grey level where
# that decides, 2e-6 of the largest value for float data.


def _pixel_limits(pixels: NDArray[Any]) -> tuple[np.float32, np.float32, np.float32]:
    """Smallest and largest value of the pixels' type, and what is added before it is cut; three zeros for floats."""
    if pixels.dtype.kind == "f":
        return np.float32(0.0), np.float32(0.0), np.float32(0.0)
    info = np.iinfo(pixels.dtype)
    return np.float32(info.min), np.float32(info.max), np.float32(0.5)


@overload(_pixel_limits)
def _pixel_limits_of_type(pixels: Any) -> Any:
    """The same, known when the kernel is compiled."""
    low, high, half = (float(each) for each in _pixel_limits(np.empty(0, str(pixels.dtype))))

    def limits(pixels: Any) -> Any:
        return np.float32(low), np.float32(high), np.float32(half)

    return limits


@inner
def _horner(coefficients: NDArray[np.float32], column: int, g: Any) -> Any:
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
        Packed pixels (see `raster.interleave`); indices below count its elements.
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
    low, high, half = _pixel_limits(source)
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
                column += _horner(coefficients, width + r, y) * (pixel - base)
            value += _horner(coefficients, i, x) * column
        if half > 0:
            value = min(max(np.trunc(value + np.copysign(half, value)), low), high)
        out[at * lanes + lane] = value


@maker
def gather_lines_loops(
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
    low, high, half = _pixel_limits(source)
    flat, middle, y = source.ravel(), max(taps // 2 - 1, 0), np.float32(gy)
    for lane in range(lanes):
        base = np.float32(0.0) if half > 0 else np.float32(flat[rows[middle] + middle * lanes + lane])
        value = base
        for r in range(taps):
            line = np.float32(0.0)
            for i in range(taps):
                line += _horner(coefficients, i, gx[r]) * (np.float32(flat[rows[r] + i * lanes + lane]) - base)
            value += _horner(coefficients, width + r, y) * line
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
    lanes, half = len(lanes_tag), _pixel_limits(source)[2]
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


gather = numba_internals.gather if numba_internals.USABLE else gather_loops
gather_lines = numba_internals.gather_lines if numba_internals.USABLE else gather_lines_loops
add_block = numba_internals.add_block if numba_internals.USABLE else add_block_loops


# Interior: pixels whose taps are all inside and valid. Nearly all of the time is spent here.


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
        See `raster.interleave`.
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


# Border: pixels at the edge of the valid part of the source.


LEAST_WEIGHT = 0.5 - 1e-6
"""A pixel is valid if the weights of its valid taps add up to this: a half, up to rounding."""


@inner
def store_rounded(value: float, limits: tuple[Any, ...], out: NDArray[Any], place: tuple[Any, ...]) -> None:
    """Round half away from zero, clip and write; limits = (low, high, rounding), rounding 0 for float data."""
    low, high, rounding = limits
    if rounding > 0.0:
        value = np.floor(value + rounding) if value >= 0.0 else np.ceil(value - rounding)
        value = min(max(value, low), high)
    out[place[0], place[1], place[2]] = value


@inner
def tap_weight(coefficients: NDArray[Any], column: int, g: float) -> float:
    """Weight of a tap, by Horner's rule."""
    value = 0.0
    for power in range(coefficients.shape[0] - 1, -1, -1):
        value = value * g + np.float64(coefficients[power, column])
    return value


@inner
def _tap_weights(
    coefficients: NDArray[Any],
    taps: int,
    valid: NDArray[np.uint8],
    size: tuple[Any, ...],
    place: tuple[Any, ...],
    weights: NDArray[Any],
) -> float:
    """Weights of the taps that are inside and valid, 0 for the others; returns their sum.

    place = (column, row of the first tap, gx, gy); size = (width, height).
    """
    col, row, gx, gy = place[0], place[1], np.float64(place[2]), np.float64(place[3])
    half = coefficients.shape[1] // 2
    total = 0.0
    for j in range(taps):
        y = row + j
        wy = tap_weight(coefficients, half + j, gy) if 0 <= y < size[1] else 0.0
        for i in range(taps):
            x = col + i
            weight = 0.0
            if 0 <= y < size[1] and 0 <= x < size[0] and (valid.size == 0 or valid[y, x] != 0):
                weight = wy * tap_weight(coefficients, i, gx)
            weights[j, i] = weight
            total += weight
    return total


@inner
def _weighted_sum(
    source: NDArray[Any], group: int, lane: int, place: tuple[Any, ...], taps: int, weights: NDArray[np.float64]
) -> float:
    value = 0.0
    for j in range(taps):
        for i in range(taps):
            if weights[j, i] != 0.0:
                value += weights[j, i] * np.float64(source[group, place[1] + j, place[0] + i, lane])
    return value


@kernel
def border_runs(
    source: NDArray[Any],
    valid: NDArray[np.uint8],
    runs: NDArray[np.int32],
    offset: tuple[int, int],
    block: tuple[Any, ...],
    rule: tuple[Any, ...],
    result: tuple[Any, ...],
) -> None:
    """Resample the BORDER pixels of runs: taps outside or invalid carry no weight, the rest is renormalised.

    Parameters
    ----------
    source : (groups, height, width, lanes)
    valid : (height, width) uint8, or empty if every pixel is valid
    runs, offset, block
        See `gather_runs`.
    rule : tuple
        Coefficients (degree + 1, 2·W) float32; number of taps; limits (low, high, rounding).
    result : tuple
        out (bands, rows, cols), out_valid (rows, cols).
    """
    corner, first, part, kind, fill, _ = block
    coefficients, taps, limits = rule
    out, out_valid = result
    size, lanes = (source.shape[2], source.shape[1]), source.shape[3]
    weights = np.empty((6, 6))
    for k in range(runs.shape[0]):
        if fill[k] == ALL:
            continue
        row, col = runs[k, 1] - offset[1], runs[k, 3] - offset[0]
        for i in range(runs[k, 4] - runs[k, 3]):
            if kind[k, i] != BORDER:
                continue
            place = (corner[k, 0] + first[k, 0, i], corner[k, 1] + first[k, 1, i], part[k, 0, i], part[k, 1, i])
            total = _tap_weights(coefficients, taps, valid, size, place, weights)
            if total < LEAST_WEIGHT:
                continue
            out_valid[row, col + i] = True
            for band in range(out.shape[0]):
                value = _weighted_sum(source, band // lanes, band % lanes, place, taps, weights)
                store_rounded(value / total, limits, out, (band, row, col + i))


# Averages: tiles coarser than the source, with kernels widened so that every source pixel counts.


# Weights stand in the middle of zeros, so that blocks of pixels may reach beyond them.
BEFORE = 8


@inner
def table_weight(table: NDArray[np.float32], distance: float) -> np.float32:
    """Weight at a distance in steps of the table, linear between them."""
    step = np.int32(distance)
    lower = table[step]
    return lower + (distance - np.float32(step)) * (table[step + 1] - lower)


@inner
def axis_weights(
    table: NDArray[np.float32], place: tuple[Any, ...], stretch: float, size: int, weights: NDArray[Any]
) -> tuple[int, int, float, float]:
    """Weights of the pixels of one axis under the widened kernel.

    Parameters
    ----------
    table : (reach · TABLE_STEPS + 2,) float32
        See `weight_table`.
    place : (whole, fraction)
        Position.
    stretch : float
        Widening.
    size : int
        Pixels of the source along this axis.
    weights : float32
        Filled from BEFORE on with the weights of the pixels start … stop − 1 that are inside, zeros after them.

    Returns
    -------
    start, stop, inside, total
        Pixels; sum of their weights; sum of all weights, also of pixels outside.
    """
    whole, fraction = place
    reach = ((table.shape[0] - 2) // TABLE_STEPS) * stretch
    first = np.int64(np.ceil(fraction - reach))
    last = np.int64(np.floor(fraction + reach))
    start, stop = max(whole + first, 0), min(whole + last + 1, size)
    rate, middle = np.float32(TABLE_STEPS / stretch), np.float32(fraction)
    sum_inside = np.float32(0.0)
    for i in range(stop - start):
        weight = table_weight(table, abs(np.float32(start - whole + i) - middle) * rate)
        weights[BEFORE + i] = weight
        sum_inside += weight
    for i in range(max(stop - start, 0), max(stop - start, 0) + BEFORE):
        weights[BEFORE + i] = np.float32(0.0)
    total = np.float64(sum_inside)
    for i in range(first, min(start - whole, last + 1)):
        total += np.float64(table_weight(table, abs(np.float32(i) - middle) * rate))
    for i in range(max(stop - whole, first), last + 1):
        total += np.float64(table_weight(table, abs(np.float32(i) - middle) * rate))
    return start, stop, np.float64(sum_inside), total


@inner
def _usable_weight(valid: NDArray[np.uint8], ranges: tuple[Any, ...], weights: tuple[Any, ...]) -> tuple[float, bool]:
    """Sum of the weights of the valid pixels among columns left … right − 1, rows top … bottom − 1; are all valid?"""
    left, right, top, bottom = ranges
    wx, wy = weights
    total, missing = 0.0, 0
    for row in range(top, bottom):
        along = 0.0
        for col in range(left, right):
            if valid[row, col] != 0:
                along += np.float64(wx[BEFORE + col - left])
            else:
                missing += 1
        total += along * np.float64(wy[BEFORE + row - top])
    return total, missing == 0


@inner
def _sum_each(
    source: NDArray[Any],
    valid: NDArray[np.uint8],
    group: int,
    ranges: tuple[Any, ...],
    weights: tuple[Any, ...],
    patch: tuple[Any, ...],
) -> None:
    """What `_sum_blocks` computes, pixel by pixel: for invalid pixels among float data, and very narrow sources."""
    left, right, top, bottom = ranges
    wx, wy = weights
    base, _, totals = patch
    for lane in range(source.shape[3]):
        total = 0.0
        for row in range(top, bottom):
            for col in range(left, right):
                if valid.size == 0 or valid[row, col] != 0:
                    weight = np.float64(wx[BEFORE + col - left]) * np.float64(wy[BEFORE + row - top])
                    total += weight * (np.float64(source[group, row, col, lane]) - np.float64(base[lane]))
        totals[lane] = total


@inner
def _sum_blocks(
    source: NDArray[Any],
    group: int,
    ranges: tuple[Any, ...],
    weights: tuple[Any, ...],
    patch: tuple[Any, ...],
    lanes_tag: tuple[Any, ...],
) -> bool:
    """totals[lane] = Σ wx · wy · (pixel − base) of one group of bands; False if the source is too narrow for blocks.

    patch = (base, sums, totals). For float pixels, base is one of those summed, so that a constant image stays constant
    to the last bit; integers are summed without it.
    """
    left, right, top, bottom = ranges
    wx, wy = weights
    base, sums, totals = patch
    height, width, lanes = source.shape[1], source.shape[2], len(lanes_tag)
    many = block_pixels(lanes_tag)
    blocks = (right - left + many - 1) // many
    if blocks * many > width:
        return False
    start = min(left, width - blocks * many)
    for lane in range(lanes):
        sums[lane] = 0.0
    first = ((group * height + top) * width + start) * lanes
    for block in range(blocks):
        at = BEFORE + start - left + block * many
        place = (first + block * many * lanes, width * lanes, bottom - top, at, BEFORE)
        add_block(source, place, wx, wy, base, lanes_tag, sums)
    for lane in range(lanes):
        totals[lane] = sums[lane]
    return True


@inner
def weighted_mean(
    source: NDArray[Any], valid: NDArray[np.uint8], spot: tuple[Any, ...], rule: tuple[Any, ...], work: tuple[Any, ...]
) -> tuple[float, float]:
    """Mean under the widened kernel at spot; the weight of the pixels that are usable, and of all.

    spot = (whole x, fraction, widening, whole y, fraction, widening). The mean of each band is in the last of `work`,
    if there is any usable weight.
    """
    table, lanes_tag, limits = rule
    wx, wy, patch, means = work
    base, _, totals = patch
    groups, height, width, lanes = source.shape
    left, right, in_x, all_x = axis_weights(table, (spot[0], spot[1]), spot[2], width, wx)
    top, bottom, in_y, all_y = axis_weights(table, (spot[3], spot[4]), spot[5], height, wy)
    if left >= right or top >= bottom:
        return 0.0, all_x * all_y
    ranges = (left, right, top, bottom)
    usable, complete = in_x * in_y, True
    if valid.size > 0:
        usable, complete = _usable_weight(valid, ranges, (wx, wy))
    if usable <= 0.0:
        return 0.0, all_x * all_y
    is_float = limits[2] == 0.0
    for group in range(groups):
        for lane in range(lanes):
            base[lane] = source[group, top, left, lane] if is_float and complete else 0.0
        # Invalid integers are 0 and add nothing; among floats the base would have to be taken from them as well.
        done = (complete or not is_float) and _sum_blocks(source, group, ranges, (wx, wy), patch, lanes_tag)
        if not done:
            _sum_each(source, valid, group, ranges, (wx, wy), patch)
        for lane in range(min(lanes, means.shape[0] - group * lanes)):
            means[group * lanes + lane] = np.float64(base[lane]) + totals[lane] / usable
    return usable, all_x * all_y


@inner
def taps_before(rule: tuple[Any, ...]) -> int:
    """Pixels between the first tap of the kernel as it is and the one before the position."""
    return (rule[0].shape[0] - 2) // TABLE_STEPS - 1


@maker
def mean_space(source: NDArray[Any], bands: int) -> tuple[Any, ...]:
    """Working space of `weighted_mean`."""
    wx, wy = np.zeros(source.shape[2] + 3 * BEFORE, np.float32), np.zeros(source.shape[1] + 3 * BEFORE, np.float32)
    sums = (np.zeros(4, np.float32), np.zeros(4, np.float32), np.zeros(4))
    return wx, wy, sums, np.zeros(bands)


@inner
def kernel_position(
    block: tuple[Any, ...], scales: NDArray[np.float32], before: int, k: int, i: int
) -> tuple[Any, ...]:
    """Where the kernel of pixel i of run k stands, as `weighted_mean` wants it."""
    corner, first, part = block[0], block[1], block[2]
    return (
        corner[k, 0] + first[k, 0, i] + before,
        np.float64(part[k, 0, i]) + 0.5,
        np.float64(scales[k, 0, i]),
        corner[k, 1] + first[k, 1, i] + before,
        np.float64(part[k, 1, i]) + 0.5,
        np.float64(scales[k, 1, i]),
    )


@inner
def store_means(
    means: NDArray[np.float64],
    weights: tuple[float, float],
    limits: tuple[Any, ...],
    result: tuple[Any, ...],
    place: tuple[int, int],
) -> None:
    """Write the means at place = (row, column) if enough of the weights = (usable, all) is usable."""
    out, out_valid = result
    good = weights[0] > 0.0 and weights[0] >= LEAST_WEIGHT * weights[1]
    out_valid[place[0], place[1]] = good
    if good:
        for band in range(out.shape[0]):
            store_rounded(means[band], limits, out, (band, place[0], place[1]))


@kernel
def average_runs(
    source: NDArray[Any],
    valid: NDArray[np.uint8],
    runs: NDArray[np.int32],
    offset: tuple[int, int],
    block: tuple[Any, ...],
    scales: NDArray[np.float32],
    rule: tuple[Any, ...],
    result: tuple[Any, ...],
) -> None:
    """Resample the AVERAGE pixels of runs.

    Parameters
    ----------
    scales : (k, 2, RUN) float32
        See `stretch_runs`.
    rule : tuple
        `weight_table` of the kernel; tag for lanes; limits (low, high, rounding).

    See `border_runs` for the others.
    """
    kind, fill = block[3], block[4]
    before, work = taps_before(rule), mean_space(source, result[0].shape[0])
    for k in range(runs.shape[0]):
        if fill[k] == ALL:
            continue
        row, col = runs[k, 1] - offset[1], runs[k, 3] - offset[0]
        for i in range(runs[k, 4] - runs[k, 3]):
            if kind[k, i] == AVERAGE:
                spot = kernel_position(block, scales, before, k, i)
                usable, total = weighted_mean(source, valid, spot, rule, work)
                store_means(work[3], (usable, total), rule[2], result, (row, col + i))


# Line scans of a turbulent flight: neighbouring lines are displaced, so each is sampled at its own position across.
#
# A ground point is seen at some moment between two rows. The detector that lies abreast of it is another one in each
# row around, by as much as the flight has rolled in between: along each row it is interpolated there, then between the
# rows.


MAX_TILT = 0.8
"""Rows that are left beside a place are balanced by weights that change by this part from row to row at most."""


@inner
def _line_weights(
    rule: tuple[Any, ...], half: int, place: tuple[float, float], size: int, weights: NDArray[np.float32]
) -> tuple[int, int, float, float]:
    """Weights of the pixels of one axis; see `axis_weights`. place = (position, widening); half: see `resample`."""
    coefficients, taps, table, _ = rule
    position, widening = place
    if widening > 1.0:
        whole = np.int64(np.floor(position))
        return axis_weights(table, (whole, position - whole), widening, size, weights)
    whole = np.int64(np.floor(position + (0.5 if taps == 1 else 0.0)))
    first, inside = whole - max(taps // 2 - 1, 0), 0.0
    start, stop = max(first, 0), min(first + taps, size)
    for i in range(start, stop):
        weights[BEFORE + i - start] = tap_weight(coefficients, half + i - first, position - whole - 0.5)
        inside += np.float64(weights[BEFORE + i - start])
    return start, stop, inside, 1.0


@inner
def _mean_of_lines(
    source: NDArray[Any],
    valid: NDArray[np.uint8],
    lines: tuple[Any, ...],
    spot: tuple[Any, ...],
    rule: tuple[Any, ...],
    work: tuple[Any, ...],
) -> tuple[float, float]:
    """Mean of the rows around a place, each at its own x; the weight of the pixels that are usable, and of all.

    Where rows end before the place (at ragged borders) the others still show a ramp where it is. Where one of the two
    rows beside the place does, nothing tells how the flight moved there: no weight is usable.

    lines = (frame, cells, place in the cells); spot = (ideal x, y, widening along x, along y). The mean of each band is
    in the last of `work`, if there is any usable weight.
    """
    frame, cells, place = lines
    wx, wy, base, steep, means = work
    _, height, width, lanes = source.shape
    half, bands = rule[0].shape[1] // 2, means.shape[0]
    top, bottom, in_y, all_y = _line_weights(rule, half, (spot[1], spot[3]), height, wy)
    usable, total, last, first, s1, s2 = 0.0, 0.0, 1.0, True, 0.0, 0.0
    for row in range(top, bottom):
        x = spot[0] + line_offset_at(frame, cells, np.float64(row), place)
        if not abs(x) < 1e9:
            continue
        down = np.float64(wy[BEFORE + row - top])
        away = row - spot[1]
        if abs(away) < 1.0 and not -0.5 <= x <= width - 0.5:
            return 0.0, 1.0
        left, right, in_x, last = _line_weights(rule, 0, (x, spot[2]), width, wx)
        total += down * last
        if valid.size > 0:
            in_x = 0.0
            for col in range(left, right):
                if valid[row, col] == 0:
                    wx[BEFORE + col - left] = np.float32(0.0)
                in_x += np.float64(wx[BEFORE + col - left])
        share = down * in_x
        usable, s1, s2 = usable + share, s1 + share * away, s2 + share * away * away
        for band in range(bands if in_x != 0.0 else 0):
            line, lane = source[band // lanes, row], band % lanes
            # Relative to one of the pixels, so that a constant image stays constant to the last bit.
            if first:
                base[band], means[band], steep[band] = 0.0, 0.0, 0.0
                for col in range(left, right):
                    if wx[BEFORE + col - left] != 0.0:
                        base[band] = np.float64(line[col, lane])
            level, value = base[band], 0.0
            for col in range(left, right):
                # Invalid pixels may hold anything, but 0 has been put there: see `raster.interleave`.
                value += np.float64(wx[BEFORE + col - left]) * (np.float64(line[col, lane]) - level)
            means[band] += down * value
            steep[band] += down * away * value
        first = first and in_x == 0.0
    total += (all_y - in_y) * last
    # Factors 1 and (row − y) · tilt of the weights, so that they are balanced about the place.
    uneven = abs(s1) > 1e-5 * usable and abs(s1) < MAX_TILT * s2 and spot[3] <= 1.0
    tilt = -s1 / s2 if uneven else 0.0
    if usable > 0.0:
        for band in range(bands):
            means[band] = base[band] + (means[band] + tilt * steep[band]) / (usable + tilt * s1)
    return usable, total


@inner
def _line_weight_sum(rule: tuple[Any, ...], at: Any, wide: float, weights: NDArray[np.float32]) -> tuple[Any, Any, Any]:
    """First pixel relative to a run, number, and sum of the weights around a place along a row, wherever it ends."""
    coefficients, taps, table, _ = rule
    half, total = np.float32(0.5), np.float32(0.0)
    if not wide > 1.0:
        whole = np.floor(at + (half if taps == 1 else np.float32(0.0)))
        g = at - whole - half
        for i in range(taps):
            weight = coefficients[coefficients.shape[0] - 1, i]
            for power in range(coefficients.shape[0] - 2, -1, -1):
                weight = weight * g + coefficients[power, i]
            weights[i] = weight
            total += weight
        return np.int64(whole) - max(taps // 2 - 1, 0), taps, total
    reach, rate = np.float32(((table.shape[0] - 2) // TABLE_STEPS) * wide), np.float32(TABLE_STEPS / wide)
    begin, end = np.int64(np.ceil(at - reach)), np.int64(np.floor(at + reach))
    for i in range(end - begin + 1):
        weights[i] = table_weight(table, abs(np.float32(begin + i) - at) * rate)
        total += weights[i]
    return begin, end - begin + 1, total


@inner
def _mean_of_whole_lines(
    image: tuple[Any, ...], lines: tuple[Any, ...], spot: tuple[Any, ...], rule: tuple[Any, ...], work: tuple[Any, ...]
) -> bool:
    """Mean as of `_mean_of_lines`, where all pixels are inside and usable; False where that is not so.

    spot = (first column of the run, x from there on, whole y, fraction, widening along x, along y).
    """
    (source, solid), (frame, cells, place) = image, lines
    left, x, y, part, wide_x, wide_y = spot
    wx, wy, base, _, means = work
    _, height, width, lanes = source.shape
    taps = rule[1]
    top, many, in_y = _line_weight_sum(rule, part, wide_y, wy)
    top += y
    first = np.int64(top - frame[1])
    if top < 0 or top + many > height:
        return False
    same = frame[3] == 1.0 and first >= 0 and first + many <= cells.shape[0]
    for row in range(top, top + many):
        if same:
            at = x + line_offset(cells, first + row - top, place)
        else:
            at = x + line_offset_at(frame, cells, np.float64(row), place)
        if not abs(at) < np.float32(1e7):
            return False
        begin, count, total = _line_weight_sum(rule, at, wide_x, wx)
        begin += left
        if begin < 0 or begin + count > width:
            return False
        if solid.size > 0:
            # Patches of taps × taps pixels; at the lower end those above.
            for col in range(begin, begin + count, taps):
                if solid[min(row, top + many - taps), min(col, begin + count - taps)] == 0:
                    return False
        share = wy[row - top] / total
        for band in range(means.shape[0]):
            line, lane = source[band // lanes, row], np.uint64(band % lanes)
            # Relative to one of the pixels, so that a constant image stays constant to the last bit.
            if row == top:
                base[band], means[band] = np.float64(line[begin, lane]), 0.0
            level, value = np.float32(base[band]), np.float32(0.0)
            for i in range(np.uint64(count)):
                value += wx[i] * (np.float32(line[np.uint64(begin) + i, lane]) - level)
            means[band] += np.float64(share * value)
    for band in range(means.shape[0]):
        means[band] = base[band] + means[band] / np.float64(in_y)
    return True


@inner
def _find_line_taps(
    lines: tuple[Any, ...], spot: tuple[Any, ...], image: tuple[Any, ...], taps: int, found: tuple[Any, ...]
) -> bool:
    """First element and fraction of the taps in each row; False if some may be outside or invalid.

    lines: see `_mean_of_lines`; spot = (first column of the run, x from there on, first row); image = (width, height,
    lanes, `solid_patches`).
    """
    frame, cells, place = lines
    left, x, top = spot
    width, height, lanes, solid = image
    places, across = found
    if top < 0 or top + taps > height:
        return False
    before, half = max(taps // 2 - 1, 0), np.float32(0.5)
    shift = half if taps == 1 else np.float32(0.0)
    first = np.int64(top - frame[1])
    # Rows of the image are those of the cells, but for reduced images.
    same = frame[3] == 1.0 and first >= 0 and first + taps <= cells.shape[0]
    good = True
    for r in range(taps):
        if same:
            at = x + line_offset(cells, first + r, place)
        else:
            at = x + line_offset_at(frame, cells, np.float64(top + r), place)
        if not abs(at) < np.float32(1e7):
            return False
        whole = np.floor(at + shift)
        col = left + np.int64(whole) - before
        good = good and col >= 0 and col + taps <= width
        if solid.size > 0 and good:
            good = solid[top, col] != 0
        places[r] = ((top + r) * width + col) * lanes
        across[r] = at - whole - half
    return good


@kernel
def line_scan_runs(
    image: tuple[Any, ...],
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    ground: tuple[Any, ...],
    block: tuple[Any, ...],
    scales: NDArray[np.float32],
    rule: tuple[Any, ...],
    tags: tuple[Any, ...],
    result: tuple[Any, ...],
) -> None:
    """Resample the pixels of runs, whatever their kind; 0 where they are EMPTY.

    Parameters
    ----------
    image : tuple
        source (groups, height, width, lanes); its mask and `solid_patches` of it, or empty arrays.
    ground : tuple
        relief (rows, cols) float32; offset (col, row): its first pixel in the tile's pixels.
    scales : (k, 2, RUN) float32
        See `stretch_runs`; (0, 2, RUN): nothing is AVERAGE.
    rule : tuple
        Coefficients (degree + 1, 2·W) float32; number of taps; `weight_table`; limits (low, high, rounding).
    tags, result : tuple
        See `gather_runs`, `border_runs`.
    """
    source, mask, solid = image
    relief, offset = ground
    corner, first, part, kind, fill, ideal = block
    out, out_valid = result
    frame, cells = anchors[4], anchors[5]
    coefficients, taps = rule[0], rule[1]
    groups, height, width, lanes = source.shape
    wx, wy = np.zeros(width + 3 * BEFORE, np.float32), np.zeros(height + 3 * BEFORE, np.float32)
    work = (wx, wy, np.zeros(out.shape[0]), np.zeros(out.shape[0]), np.zeros(out.shape[0]))
    across, places, moved = np.zeros(6, np.float32), np.zeros(6, np.int64), np.zeros(6, np.int64)
    buffer, before = np.zeros(4, source.dtype), max(taps // 2 - 1, 0)
    level, size = np.float32(frame[5]), (width, height, lanes, solid)
    for k in range(runs.shape[0]):
        row, col = runs[k, 1] - offset[1], runs[k, 3] - offset[0]
        for i in range(runs[k, 4] - runs[k, 3]):
            mine = INTERIOR if fill[k] == ALL else kind[k, i]
            if mine == EMPTY:
                for band in range(out.shape[0]):
                    out[band, row, col + i] = 0
                continue
            x, down = corner[k, 0] + np.float64(ideal[k, i]), corner[k, 1] + first[k, 1, i]
            at, along = offset_column(frame, cells, x)
            lines = (frame, cells, (at, along, relief[row, col + i] - level))
            spot = (corner[k, 0], ideal[k, i], down)
            if mine != AVERAGE and _find_line_taps(lines, spot, size, taps, (places, across)):
                for group in range(groups):
                    for r in range(taps):
                        moved[r] = places[r] + group * height * width * lanes
                    gather_lines(source, moved, across, part[k, 1, i], coefficients, tags[0], tags[1], buffer, 0)
                    for lane in range(min(lanes, out.shape[0] - group * lanes)):
                        out[group * lanes + lane, row, col + i] = buffer[lane]
                out_valid[row, col + i] = True
                continue
            y = np.float64(down + before) + np.float64(part[k, 1, i]) + 0.5
            wide = (1.0, 1.0)
            good = False
            if mine == AVERAGE:
                wide = (np.float64(scales[k, 0, i]), np.float64(scales[k, 1, i]))
                around = (corner[k, 0], ideal[k, i], down + before, part[k, 1, i] + np.float32(0.5), wide[0], wide[1])
                good = _mean_of_whole_lines((source, solid), lines, around, rule, work)
            if not good:
                usable, total = _mean_of_lines(source, mask, lines, (x, y, wide[0], wide[1]), rule, work)
                good = usable > 0.0 and usable >= LEAST_WEIGHT * total
            out_valid[row, col + i] = good
            for band in range(out.shape[0]):
                if good:
                    store_rounded(work[4][band], rule[3], out, (band, row, col + i))
                else:
                    out[band, row, col + i] = 0

"""Tiles coarser than the source: kernels widened so that every source pixel counts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.border import LEAST_WEIGHT, store
from photoplan.kernels.jit import inner, kernel, maker
from photoplan.kernels.place import ALL, AVERAGE
from photoplan.kernels.sampling import add_block, block_pixels
from photoplan.kernels.weights import TABLE_STEPS

# Weights stand in the middle of zeros, so that blocks of pixels may reach beyond them.
BEFORE = 8


@inner
def look_up(table: NDArray[np.float32], distance: float) -> np.float32:
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
        weight = look_up(table, abs(np.float32(start - whole + i) - middle) * rate)
        weights[BEFORE + i] = weight
        sum_inside += weight
    for i in range(max(stop - start, 0), max(stop - start, 0) + BEFORE):
        weights[BEFORE + i] = np.float32(0.0)
    total = np.float64(sum_inside)
    for i in range(first, min(start - whole, last + 1)):
        total += np.float64(look_up(table, abs(np.float32(i) - middle) * rate))
    for i in range(max(stop - whole, first), last + 1):
        total += np.float64(look_up(table, abs(np.float32(i) - middle) * rate))
    return start, stop, np.float64(sum_inside), total


@inner
def _usable(valid: NDArray[np.uint8], ranges: tuple[Any, ...], weights: tuple[Any, ...]) -> tuple[float, bool]:
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
def mean_at(
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
        usable, complete = _usable(valid, ranges, (wx, wy))
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
    """Working space of `mean_at`."""
    wx, wy = np.zeros(source.shape[2] + 3 * BEFORE, np.float32), np.zeros(source.shape[1] + 3 * BEFORE, np.float32)
    sums = (np.zeros(4, np.float32), np.zeros(4, np.float32), np.zeros(4))
    return wx, wy, sums, np.zeros(bands)


@inner
def spot_of(block: tuple[Any, ...], scales: NDArray[np.float32], before: int, k: int, i: int) -> tuple[Any, ...]:
    """Where the kernel of pixel i of run k stands, as `mean_at` wants it."""
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
def settle(
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
            store(means[band], limits, out, (band, place[0], place[1]))


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
                spot = spot_of(block, scales, before, k, i)
                usable, total = mean_at(source, valid, spot, rule, work)
                settle(work[3], (usable, total), rule[2], result, (row, col + i))

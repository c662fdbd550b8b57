"""Pixels of a turbulent flight: neighbouring rows lie apart, so each is sampled at its own place across.

A ground point is seen at some moment between two rows. The detector that lies abreast of it is another one in each row
around, by as much as the flight has rolled in between: along each row it is interpolated there, then between the rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.area import BEFORE, axis_weights, look_up
from photoplan.kernels.border import LEAST_WEIGHT, store, weight_of
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.place import ALL, AVERAGE, EMPTY, INTERIOR
from photoplan.kernels.rows import column_of, shift_across, shift_of_row
from photoplan.kernels.sampling import gather_apart
from photoplan.kernels.weights import TABLE_STEPS

MOST_TILT = 0.8
"""Rows that are left beside a place are balanced by weights that change by this part from row to row at most."""


@inner
def _weights(
    rule: tuple[Any, ...], half: int, place: tuple[float, float], size: int, weights: NDArray[np.float32]
) -> tuple[int, int, float, float]:
    """Weights of the pixels of one axis; see `area.axis_weights`. place = (position, widening); half: see `border`."""
    coefficients, taps, table, _ = rule
    position, widening = place
    if widening > 1.0:
        whole = np.int64(np.floor(position))
        return axis_weights(table, (whole, position - whole), widening, size, weights)
    whole = np.int64(np.floor(position + (0.5 if taps == 1 else 0.0)))
    first, inside = whole - max(taps // 2 - 1, 0), 0.0
    start, stop = max(first, 0), min(first + taps, size)
    for i in range(start, stop):
        weights[BEFORE + i - start] = weight_of(coefficients, half + i - first, position - whole - 0.5)
        inside += np.float64(weights[BEFORE + i - start])
    return start, stop, inside, 1.0


@inner
def _mean_of_rows(
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
    top, bottom, in_y, all_y = _weights(rule, half, (spot[1], spot[3]), height, wy)
    usable, total, last, first, s1, s2 = 0.0, 0.0, 1.0, True, 0.0, 0.0
    for row in range(top, bottom):
        x = spot[0] + shift_across(frame, cells, np.float64(row), place)
        if not abs(x) < 1e9:
            continue
        down = np.float64(wy[BEFORE + row - top])
        away = row - spot[1]
        if abs(away) < 1.0 and not -0.5 <= x <= width - 0.5:
            return 0.0, 1.0
        left, right, in_x, last = _weights(rule, 0, (x, spot[2]), width, wx)
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
                # Invalid pixels may hold anything, but 0 has been put there: see `pack`.
                value += np.float64(wx[BEFORE + col - left]) * (np.float64(line[col, lane]) - level)
            means[band] += down * value
            steep[band] += down * away * value
        first = first and in_x == 0.0
    total += (all_y - in_y) * last
    # Factors 1 and (row − y) · tilt of the weights, so that they are balanced about the place.
    uneven = abs(s1) > 1e-5 * usable and abs(s1) < MOST_TILT * s2 and spot[3] <= 1.0
    tilt = -s1 / s2 if uneven else 0.0
    if usable > 0.0:
        for band in range(bands):
            means[band] = base[band] + (means[band] + tilt * steep[band]) / (usable + tilt * s1)
    return usable, total


@inner
def _row_weights(rule: tuple[Any, ...], at: Any, wide: float, weights: NDArray[np.float32]) -> tuple[Any, Any, Any]:
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
        weights[i] = look_up(table, abs(np.float32(begin + i) - at) * rate)
        total += weights[i]
    return begin, end - begin + 1, total


@inner
def _whole_mean(
    image: tuple[Any, ...], lines: tuple[Any, ...], spot: tuple[Any, ...], rule: tuple[Any, ...], work: tuple[Any, ...]
) -> bool:
    """Mean as of `_mean_of_rows`, where all pixels are inside and usable; False where that is not so.

    spot = (first column of the run, x from there on, whole y, fraction, widening along x, along y).
    """
    (source, solid), (frame, cells, place) = image, lines
    left, x, y, part, wide_x, wide_y = spot
    wx, wy, base, _, means = work
    _, height, width, lanes = source.shape
    taps = rule[1]
    top, many, in_y = _row_weights(rule, part, wide_y, wy)
    top += y
    first = np.int64(top - frame[1])
    if top < 0 or top + many > height:
        return False
    same = frame[3] == 1.0 and first >= 0 and first + many <= cells.shape[0]
    for row in range(top, top + many):
        if same:
            at = x + shift_of_row(cells, first + row - top, place)
        else:
            at = x + shift_across(frame, cells, np.float64(row), place)
        if not abs(at) < np.float32(1e7):
            return False
        begin, count, total = _row_weights(rule, at, wide_x, wx)
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
def _find_taps(
    lines: tuple[Any, ...], spot: tuple[Any, ...], image: tuple[Any, ...], taps: int, found: tuple[Any, ...]
) -> bool:
    """First element and fraction of the taps in each row; False if some may be outside or invalid.

    lines: see `_mean_of_rows`; spot = (first column of the run, x from there on, first row); image = (width, height,
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
            at = x + shift_of_row(cells, first + r, place)
        else:
            at = x + shift_across(frame, cells, np.float64(top + r), place)
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
def apart_runs(
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
            at, along = column_of(frame, cells, x)
            lines = (frame, cells, (at, along, relief[row, col + i] - level))
            spot = (corner[k, 0], ideal[k, i], down)
            if mine != AVERAGE and _find_taps(lines, spot, size, taps, (places, across)):
                for group in range(groups):
                    for r in range(taps):
                        moved[r] = places[r] + group * height * width * lanes
                    gather_apart(source, moved, across, part[k, 1, i], coefficients, tags[0], tags[1], buffer, 0)
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
                good = _whole_mean((source, solid), lines, around, rule, work)
            if not good:
                usable, total = _mean_of_rows(source, mask, lines, (x, y, wide[0], wide[1]), rule, work)
                good = usable > 0.0 and usable >= LEAST_WEIGHT * total
            out_valid[row, col + i] = good
            for band in range(out.shape[0]):
                if good:
                    store(work[4][band], rule[3], out, (band, row, col + i))
                else:
                    out[band, row, col + i] = 0

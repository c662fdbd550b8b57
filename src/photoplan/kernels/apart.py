"""Pixels of a turbulent flight: neighbouring rows lie apart, so each is sampled at its own place across.

A ground point is seen at some moment between two rows. The detector that lies abreast of it is another one in each row
around, by as much as the flight has rolled in between: along each row it is interpolated there, then between the rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.area import BEFORE, axis_weights
from photoplan.kernels.border import LEAST_WEIGHT, store, weight_of
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.place import ALL, AVERAGE, EMPTY, INTERIOR
from photoplan.kernels.rows import column_of, shift_across
from photoplan.kernels.sampling import gather_apart

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

    Where rows end before the place (at ragged borders) the others still show a ramp where it is.

    lines = (frame, nodes, place in the nodes); spot = (ideal x, y, widening along x, along y). The mean of each band is
    in the last of `work`, if there is any usable weight.
    """
    frame, nodes, place = lines
    wx, wy, base, steep, means = work
    _, height, width, lanes = source.shape
    half, bands = rule[0].shape[1] // 2, means.shape[0]
    top, bottom, in_y, all_y = _weights(rule, half, (spot[1], spot[3]), height, wy)
    usable, total, last, first, s1, s2 = 0.0, 0.0, 1.0, True, 0.0, 0.0
    for row in range(top, bottom):
        x = spot[0] + shift_across(frame, nodes, np.float64(row), place)
        if not abs(x) < 1e9:
            continue
        down = np.float64(wy[BEFORE + row - top])
        left, right, in_x, last = _weights(rule, 0, (x, spot[2]), width, wx)
        total += down * last
        away = row - spot[1]
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
def _find_taps(
    lines: tuple[Any, ...],
    spot: tuple[float, int],
    image: tuple[Any, ...],
    taps: int,
    found: tuple[Any, ...],
) -> bool:
    """First column and fraction of the taps in each row from spot[1] on; False if some may be outside or invalid."""
    frame, nodes, place = lines
    width, height, solid = image
    columns, across = found
    before, shift = max(taps // 2 - 1, 0), 0.5 if taps == 1 else 0.0
    good = spot[1] >= 0 and spot[1] + taps <= height
    for r in range(taps):
        x = spot[0] + shift_across(frame, nodes, np.float64(spot[1] + r), place)
        whole = np.floor(x + shift)
        col = whole - before
        inside = col >= 0 and col + taps <= width
        columns[r] = np.int64(col) if inside else 0
        across[r] = x - whole - 0.5
        good = good and inside
        if good and solid.size > 0:
            good = solid[spot[1], columns[r]] != 0
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
    frame, nodes = anchors[4], anchors[5]
    coefficients, taps = rule[0], rule[1]
    groups, height, width, lanes = source.shape
    wx, wy = np.zeros(width + 3 * BEFORE, np.float32), np.zeros(height + 3 * BEFORE, np.float32)
    work = (wx, wy, np.zeros(out.shape[0]), np.zeros(out.shape[0]), np.zeros(out.shape[0]))
    columns, across, places = np.zeros(6, np.int64), np.zeros(6, np.float32), np.zeros(6, np.int64)
    buffer, before = np.zeros(4, source.dtype), max(taps // 2 - 1, 0)
    for k in range(runs.shape[0]):
        row, col = runs[k, 1] - offset[1], runs[k, 3] - offset[0]
        for i in range(runs[k, 4] - runs[k, 3]):
            mine = INTERIOR if fill[k] == ALL else kind[k, i]
            if mine == EMPTY:
                for band in range(out.shape[0]):
                    out[band, row, col + i] = 0
                continue
            x, down = corner[k, 0] + np.float64(ideal[k, i]), corner[k, 1] + first[k, 1, i]
            at, along = column_of(frame, nodes, x)
            lines = (frame, nodes, (at, along, np.float64(relief[row, col + i]) - frame[5]))
            if mine != AVERAGE and _find_taps(lines, (x, down), (width, height, solid), taps, (columns, across)):
                for group in range(groups):
                    for r in range(taps):
                        places[r] = (((group * height + down + r) * width) + columns[r]) * lanes
                    gather_apart(source, places, across, part[k, 1, i], coefficients, tags[0], tags[1], buffer, 0)
                    for lane in range(min(lanes, out.shape[0] - group * lanes)):
                        out[group * lanes + lane, row, col + i] = buffer[lane]
                out_valid[row, col + i] = True
                continue
            y = np.float64(down + before) + np.float64(part[k, 1, i]) + 0.5
            wide = (1.0, 1.0)
            if mine == AVERAGE:
                wide = (np.float64(scales[k, 0, i]), np.float64(scales[k, 1, i]))
            usable, total = _mean_of_rows(source, mask, lines, (x, y, wide[0], wide[1]), rule, work)
            good = usable > 0.0 and usable >= LEAST_WEIGHT * total
            out_valid[row, col + i] = good
            for band in range(out.shape[0]):
                if good:
                    store(work[4][band], rule[3], out, (band, row, col + i))
                else:
                    out[band, row, col + i] = 0

"""Tiles coarser than the source: kernels widened so that every source pixel counts."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.border import LEAST_WEIGHT, store
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.place import ALL, AVERAGE, EMPTY, INTERIOR, NOTHING, SOME
from photoplan.kernels.weights import STRETCH_FROM, STRETCH_FULL

__all__ = ["average_runs", "largest_scales", "stretch_runs"]


@kernel
def largest_scales(rects, box_start, corners):
    """Largest scale of each rectangle along image x or y, source pixels per target pixel, at its boxes' corners.

    Parameters
    ----------
    rects, box_start, corners : ndarrays
        As in `rectify_tile`.

    Returns
    -------
    ndarray, shape (m,)
        NaN where a corner is not in front of the camera.
    """
    result = np.zeros(rects.shape[0])
    for index in range(rects.shape[0]):
        width, height = float(rects[index, 2] - rects[index, 0]), float(rects[index, 3] - rects[index, 1])
        for box in range(box_start[index], box_start[index + 1]):
            for corner in range(8):
                p, p_u, p_v = corners[box, corner], corners[box, corner ^ 1], corners[box, corner ^ 2]
                for c in range(2):
                    # Signs do not matter: the derivatives are squared.
                    along_u = ((p_u[c] - p[c]) - p[c] / p[2] * (p_u[2] - p[2])) / (width * p[2])
                    along_v = ((p_v[c] - p[c]) - p[c] / p[2] * (p_v[2] - p[2])) / (height * p[2])
                    scale = np.sqrt(along_u * along_u + along_v * along_v)
                    result[index] = scale if not scale <= result[index] else result[index]
    return result


@inner
def _stretch(scale):
    """See `weights.stretch`."""
    if scale >= STRETCH_FULL:
        return scale
    part = max(0.0, (scale - STRETCH_FROM) / (STRETCH_FULL - STRETCH_FROM))
    return 1.0 + part * (STRETCH_FULL - 1.0)


@inner
def _lerp(corners, c, iv_step, s, t):
    """Value and derivatives along s and t of component c on the face whose first corner is `iv_step`."""
    p00, p01 = corners[iv_step, c], corners[iv_step + 1, c]
    p10, p11 = corners[iv_step + 2, c], corners[iv_step + 3, c]
    lower, upper = p00 + s * (p01 - p00), p10 + s * (p11 - p10)
    along_s = (p01 - p00) + t * ((p11 - p10) - (p01 - p00))
    return lower + t * (upper - lower), along_s, upper - lower


@inner
def _pixel_stretch(anchors, index, u, v, h):
    """Widening of the kernel along image x and y at one pixel, from the derivatives at constant h."""
    rects, box_start, box_heights, corners = anchors
    box = box_start[index]
    while box + 1 < box_start[index + 1] and h >= box_heights[box + 1, 0]:
        box += 1
    width, height = float(rects[index, 2] - rects[index, 0]), float(rects[index, 3] - rects[index, 1])
    s, t = (u - rects[index, 0] + 0.5) / width, (v - rects[index, 1] + 0.5) / height
    low, rise = box_heights[box, 0], box_heights[box, 1] - box_heights[box, 0]
    q = (h - low) / rise if rise > 0.0 else 0.0
    value, du, dv = np.empty(3), np.empty(3), np.empty(3)
    for c in range(3):
        a, a_s, a_t = _lerp(corners[box], c, 0, s, t)
        b, b_s, b_t = _lerp(corners[box], c, 4, s, t)
        value[c] = a + q * (b - a)
        du[c] = (a_s + q * (b_s - a_s)) / width
        dv[c] = (a_t + q * (b_t - a_t)) / height
    w = value[2]
    x, y = value[0] / w, value[1] / w
    sx = np.sqrt((du[0] - x * du[2]) ** 2 + (dv[0] - x * dv[2]) ** 2) / w
    sy = np.sqrt((du[1] - y * du[2]) ** 2 + (dv[1] - y * dv[2]) ** 2) / w
    return _stretch(sx), _stretch(sy)


@inner
def _wide_weights(coefficients, taps, position, stretch, size, weights):
    """Weights of the pixels of one axis under the widened kernel.

    Fills weights[0 : stop − start] for the pixels start … stop − 1 inside 0 … size − 1. Returns start, stop, the sum of
    those weights and the sum of all, also of the pixels outside.
    """
    reach = taps // 2
    first = np.int64(np.ceil(position - reach * stretch))
    last = np.int64(np.floor(position + reach * stretch))
    start, stop = max(first, 0), min(last + 1, size)
    inside, total = 0.0, 0.0
    for i in range(first, last + 1):
        t = (i - position) / stretch
        upper = np.ceil(t)
        tap = np.int64(upper) + reach - 1
        if tap < 0 or tap >= taps:
            weight = 0.0
        else:
            g = upper - t - 0.5
            weight = 0.0
            for power in range(coefficients.shape[0] - 1, -1, -1):
                weight = weight * g + float(coefficients[power, tap])
        total += weight
        if start <= i < stop:
            weights[i - start] = weight
            inside += weight
    return start, stop, inside, total


@inner
def _sum_rows(lines, ranges, wy, sums):
    """Weighted sum of the rows: sums[k] = Σ wy · lines[row, first + k]."""
    first, count, top, bottom = ranges
    for k in range(count):
        sums[k] = 0
    for row in range(top, bottom):
        weight = sums.dtype.type(wy[row - top])
        line = lines[row, first : first + count]
        for k in range(count):
            sums[k] += weight * sums.dtype.type(line[k])


@inner
def _usable(valid, ranges, weights, sums):
    """Sum of the weights of the valid pixels among columns left … right − 1, rows top … bottom − 1."""
    left, right, top, bottom = ranges
    wx, wy = weights
    _sum_rows(valid, (left, right - left, top, bottom), wy, sums)
    total = 0.0
    for k in range(right - left):
        total += wx[k] * sums[k]
    return total


@inner
def _average_one(source, valid, spot, rule, work, result, place):
    """Average over the widened kernel at spot = (x, y, stretch along x, along y); written at place = (row, column)."""
    x, y, stretch_x, stretch_y = spot
    coefficients, taps, limits = rule
    wx, wy, sums, mask_sums = work
    out, out_valid = result
    groups, height, width, lanes = source.shape
    left, right, in_x, all_x = _wide_weights(coefficients, taps, x, stretch_x, width, wx)
    top, bottom, in_y, all_y = _wide_weights(coefficients, taps, y, stretch_y, height, wy)
    if left >= right or top >= bottom:
        return
    usable = in_x * in_y
    if valid.size > 0:
        usable = _usable(valid, (left, right, top, bottom), (wx, wy), mask_sums)
    if usable < LEAST_WEIGHT * all_x * all_y:
        return
    out_valid[place[0], place[1]] = True
    lines = source.reshape(groups * height, width * lanes)
    for group in range(groups):
        rows = (left * lanes, (right - left) * lanes, group * height + top, group * height + bottom)
        _sum_rows(lines, rows, wy, sums)
        for lane in range(min(lanes, out.shape[0] - group * lanes)):
            value = 0.0
            for k in range(right - left):
                value += wx[k] * float(sums[k * lanes + lane])
            store(value / usable, limits, out, (group * lanes + lane, place[0], place[1]))


@kernel
def stretch_runs(anchors, runs, relief, offset, block, scales):
    """Find the pixels whose kernel is to be widened and make them AVERAGE; returns their number.

    Parameters
    ----------
    scales : (k, 2, RUN) float64
        Filled where AVERAGE: widening along image x and y.

    See `place_runs` for the others.
    """
    kind, fill = block[3], block[4]
    count = 0
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        if fill[k] == ALL:
            kind[k, :n] = INTERIOR
        interior = 0
        for i in range(n):
            if kind[k, i] == EMPTY:
                continue
            sx, sy = _pixel_stretch(anchors, runs[k, 0], runs[k, 3] + i, runs[k, 1], relief[row, col + i])
            if sx > 1.0 or sy > 1.0:
                kind[k, i] = AVERAGE
                scales[k, 0, i], scales[k, 1, i] = sx, sy
                count += 1
            elif kind[k, i] == INTERIOR:
                interior += 1
        fill[k] = ALL if interior == n else (SOME if interior > 0 else NOTHING)
    return count


@kernel
def average_runs(source, valid, runs, offset, block, scales, rule, result, sums):
    """Resample the AVERAGE pixels of runs.

    Parameters
    ----------
    scales : (k, 2, RUN) float64
        See `stretch_runs`.
    sums : (width of the source · lanes,) float32 or float64
        Working space; float64 for float32 pixels, so that a constant image stays constant to the last bit.

    See `border_runs` for the others.
    """
    corner, first, part, kind, fill = block
    before = rule[1] // 2 - 1
    _, height, width, _ = source.shape
    work = (np.empty(width), np.empty(height), sums, np.empty(width))
    for k in range(runs.shape[0]):
        if fill[k] == ALL:
            continue
        row, col = runs[k, 1] - offset[1], runs[k, 3] - offset[0]
        for i in range(runs[k, 4] - runs[k, 3]):
            if kind[k, i] == AVERAGE:
                result[1][row, col + i] = False
                x = corner[k, 0] + first[k, 0, i] + before + (float(part[k, 0, i]) + 0.5)
                y = corner[k, 1] + first[k, 1, i] + before + (float(part[k, 1, i]) + 0.5)
                spot = (x, y, scales[k, 0, i], scales[k, 1, i])
                _average_one(source, valid, spot, rule, work, result, (row, col + i))

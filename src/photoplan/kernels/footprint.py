"""Footprints of pixels in the source: scales, ellipses, and means over them where a pixel covers many of its pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel, maker
from photoplan.kernels.positions import (
    ALL,
    AVERAGE,
    EMPTY,
    INTERIOR,
    NOTHING,
    RUN,
    SOME,
    cell_space,
    find_cells,
    middle_of_run,
    row_weights,
    run_coefficients,
    run_origin,
    shift_origin,
    to_single,
)
from photoplan.kernels.resample import kernel_position, mean_space, store_means, taps_before, weighted_mean
from photoplan.kernels.weights import STRETCH_FROM, STRETCH_FULL

# Scales: how many source pixels a target pixel spans, and by how much its kernel is widened.


# Scales are measured at the corners of boxes and the ends of runs; between them a perspective is hardly larger. What
# comes this near to averaging is looked at pixel by pixel.
STRETCH_CHECK = 0.97 * STRETCH_FROM


@kernel
def largest_scales(
    rects: NDArray[np.int32], box_start: NDArray[np.int32], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
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
def _position_derivatives(
    coef: NDArray[np.float64],
    slope: NDArray[np.float64],
    u_first: float,
    heights: NDArray[np.float32],
    h_ref: float,
    tilt: NDArray[np.float32],
    slopes: NDArray[np.float32],
) -> None:
    """Position and derivatives of the pixels of a run: fills slopes (6, n) with x, ∂x/∂u, ∂x/∂v, y, ∂y/∂u, ∂y/∂v.

    coef and slope are the coefficients of the run and of its derivative along v, shifted to its origin. At constant h
    x = X / w has the derivatives ∂x/∂u = (∂X/∂u − x ∂w/∂u) / w, and so along v; jumps of the relief do not enter. With
    a tilt (2, n), the change of h along u and v, that of ∂x/∂h is added.
    """
    w0, w1, w2, w3 = to_single(coef, 2)
    b0, b1, b2, b3 = to_single(slope, 2)
    h0, first, one = np.float32(h_ref), np.float32(u_first), np.float32(1.0)
    for c in range(2):
        x0, x1, x2, x3 = to_single(coef, c)
        a0, a1, a2, a3 = to_single(slope, c)
        at, along_u, along_v = slopes[3 * c], slopes[3 * c + 1], slopes[3 * c + 2]
        for i in range(heights.shape[0]):
            u, h = first + np.float32(np.int32(i)), heights[i] - h0
            inverse = one / ((w0 + w1 * u) + h * (w2 + w3 * u))
            x = ((x0 + x1 * u) + h * (x2 + x3 * u)) * inverse
            at[i] = x
            along_u[i] = ((x1 + x3 * h) - x * (w1 + w3 * h)) * inverse
            along_v[i] = (((a0 + a1 * u) + h * (a2 + a3 * u)) - x * ((b0 + b1 * u) + h * (b2 + b3 * u))) * inverse
        for i in range(tilt.shape[1]):
            u, h = first + np.float32(np.int32(i)), heights[i] - h0
            inverse = one / ((w0 + w1 * u) + h * (w2 + w3 * u))
            along_h = ((x2 + x3 * u) - at[i] * (w2 + w3 * u)) * inverse
            along_u[i] += along_h * tilt[0, i]
            along_v[i] += along_h * tilt[1, i]


@inner
def _add_field_derivatives(
    frame: NDArray[np.float64], nodes: NDArray[np.float32], work: tuple[Any, ...], slopes: NDArray[np.float32]
) -> None:
    """Derivatives of positions with the field instead of without; beyond the nodes any."""
    cell, along_x, along_y = work
    table = nodes.reshape(-1)
    below = np.uint64(2 * nodes.shape[1])
    two = np.uint64(2)
    per_x, per_y = np.float32(frame[2]), np.float32(frame[3])
    xu, xv, yu, yv = slopes[1], slopes[2], slopes[4], slopes[5]
    for i in range(cell.shape[0]):
        a = np.uint64(np.uint32(max(cell[i], np.int32(0))))
        b = a + below
        fx, fy = along_x[i], along_y[i]
        upper, lower = table[a + two] - table[a], table[b + two] - table[b]
        left, right = table[b] - table[a], table[b + two] - table[a + two]
        x_x, x_y = (upper + fy * (lower - upper)) * per_x, (left + fx * (right - left)) * per_y
        a, b = a + np.uint64(1), b + np.uint64(1)
        upper, lower = table[a + two] - table[a], table[b + two] - table[b]
        left, right = table[b] - table[a], table[b + two] - table[a + two]
        y_x, y_y = (upper + fy * (lower - upper)) * per_x, (left + fx * (right - left)) * per_y
        u_x, v_x, u_y, v_y = xu[i], xv[i], yu[i], yv[i]
        xu[i], xv[i] = u_x + (x_x * u_x + x_y * u_y), v_x + (x_x * v_x + x_y * v_y)
        yu[i], yv[i] = u_y + (y_x * u_x + y_y * u_y), v_y + (y_x * v_x + y_y * v_y)


@inner
def _largest_squared_scale(
    coef: NDArray[np.float64], slope: NDArray[np.float64], ends: tuple[Any, ...], heights: NDArray[np.float64]
) -> float:
    """Largest squared scale at the ends of a run and of its box; ends: first and last column, and reference height."""
    largest = 0.0
    for c in range(2):
        for k in range(4):
            u, h = (ends[0] if k & 1 else ends[1]), heights[k >> 1] - ends[2]
            inverse = 1.0 / ((coef[0, 2] + coef[1, 2] * u) + h * (coef[2, 2] + coef[3, 2] * u))
            x = ((coef[0, c] + coef[1, c] * u) + h * (coef[2, c] + coef[3, c] * u)) * inverse
            along_u = ((coef[1, c] + coef[3, c] * h) - x * (coef[1, 2] + coef[3, 2] * h)) * inverse
            rise = (slope[0, c] + slope[1, c] * u) + h * (slope[2, c] + slope[3, c] * u)
            fall = (slope[0, 2] + slope[1, 2] * u) + h * (slope[2, 2] + slope[3, 2] * u)
            along_v = (rise - x * fall) * inverse
            squared = along_u * along_u + along_v * along_v
            largest = squared if not squared <= largest else largest
    return largest


@inner
def _stretch_factor(along_u: NDArray[np.float32], along_v: NDArray[np.float32], stretch: NDArray[np.float32]) -> None:
    """Widening of the kernel along one axis of the image for the pixels of a run; see `weights.stretch`."""
    begin, full, one = np.float32(STRETCH_FROM), np.float32(STRETCH_FULL), np.float32(1.0)
    rate = np.float32((STRETCH_FULL - 1.0) / (STRETCH_FULL - STRETCH_FROM))
    for i in range(along_u.shape[0]):
        scale = np.sqrt(along_u[i] * along_u[i] + along_v[i] * along_v[i])
        partly = one + rate * (scale - begin)
        widened = partly if scale > begin else one
        stretch[i] = scale if scale >= full else widened


@maker
def derivative_space() -> tuple[Any, ...]:
    """Working space of `run_derivatives`."""
    slopes, higher = np.empty((6, RUN), np.float32), np.empty((6, RUN), np.float32)
    return np.empty((4, 3)), np.empty((4, 3)), slopes, higher, cell_space()


@inner
def run_derivatives(
    anchors: tuple[Any, ...],
    run: NDArray[np.int32],
    heights: NDArray[np.float32],
    tilt: NDArray[np.float32],
    origin: NDArray[np.float64],
    work: tuple[Any, ...],
) -> bool:
    """Fill work[2], see `_position_derivatives`, relative to `origin`; False if nothing in the run is widened.

    tilt: see `_position_derivatives`; (2, 0): none.
    """
    rects, box_start, box_heights, corners, frame, field = anchors
    coef, slope, slopes, higher, cells = work
    rect, lowest = rects[run[0]], box_start[run[0]]
    u_ref, edges = middle_of_run(rect, run), row_weights(rect, run[1])
    # The run as the rectangle has it: crops must decide the same.
    first, last = float(run[2] - u_ref), float(min(run[2] + RUN, rect[2]) - 1 - u_ref)
    per_row = 1.0 / (rect[3] - rect[1])
    n = heights.shape[0]
    longer = frame[4] if field.size > 0 else 1.0
    for box in range(lowest, box_start[run[0] + 1]):
        h_ref = run_coefficients(rect, box_heights[box], corners[box], u_ref, edges, coef)
        run_coefficients(rect, box_heights[box], corners[box], u_ref, (-per_row, per_row), slope)
        shift_origin(origin, coef)
        shift_origin(origin, slope)
        largest = longer * longer * _largest_squared_scale(coef, slope, (first, last, h_ref), box_heights[box])
        alone = box == lowest and box + 1 == box_start[run[0] + 1]
        if alone and tilt.shape[1] == 0 and largest <= STRETCH_CHECK * STRETCH_CHECK:
            return False
        if box == lowest:
            _position_derivatives(coef, slope, run[3] - u_ref, heights, h_ref, tilt, slopes)
        else:
            _position_derivatives(coef, slope, run[3] - u_ref, heights, h_ref, tilt, higher)
            low = np.float32(box_heights[box, 0])
            for i in range(n):
                if heights[i] >= low:
                    for k in range(6):
                        slopes[k, i] = higher[k, i]
    # What a pixel covers is that of the smooth part of a flight; from line to line it changes at random.
    if field.size > 0 and field.shape[2] == 2:
        find_cells(frame, field, origin, slopes[0, :n], slopes[3, :n], cells)
        _add_field_derivatives(frame, field, (cells[0][:n], cells[1], cells[2]), slopes)
    return True


@inner
def mark_averaged(wider: NDArray[np.bool_], fill: NDArray[np.uint8], kind: NDArray[np.uint8], k: int) -> int:
    """Make the pixels of run k AVERAGE whose kernel is wider and that are not EMPTY; returns their number."""
    whole, count, interior = fill[k] == ALL, 0, 0
    for i in range(wider.shape[0]):
        if whole:
            kind[k, i] = INTERIOR
        if kind[k, i] != EMPTY and wider[i]:
            kind[k, i] = AVERAGE
            count += 1
        elif kind[k, i] == INTERIOR:
            interior += 1
    fill[k] = ALL if interior == wider.shape[0] else (SOME if interior > 0 else NOTHING)
    return count


@kernel
def stretch_runs(
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    relief: NDArray[np.float32],
    offset: tuple[int, int],
    block: tuple[Any, ...],
    scales: NDArray[np.float32],
) -> int:
    """Find the pixels whose kernel is to be widened and make them AVERAGE; returns their number.

    Parameters
    ----------
    scales : (k, 2, RUN) float32
        Filled: widening along image x and y.

    See `place_runs` for the others.
    """
    corner, _, _, kind, fill, _ = block
    work, no_tilt, wider = derivative_space(), np.empty((2, 0), np.float32), np.empty(RUN, np.bool_)
    slopes, origin = work[2], np.empty(2)
    count = 0
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        origin[0], origin[1] = float(corner[k, 0]), float(corner[k, 1])
        if not run_derivatives(anchors, runs[k], relief[row, col : col + n], no_tilt, origin, work):
            continue
        _stretch_factor(slopes[1, :n], slopes[2, :n], scales[k, 0])
        _stretch_factor(slopes[4, :n], slopes[5, :n], scales[k, 1])
        for i in range(n):
            wider[i] = scales[k, 0, i] > 1.0 or scales[k, 1, i] > 1.0
        count += mark_averaged(wider[:n], fill, kind, k)
    return count


# Ellipses: what a pixel of a view covers where its depth changes from pixel to pixel.
#
# At constant depth a pixel of a view is a small square; on ground that is seen at a grazing angle it is an ellipse, ten
# or a hundred times as long as wide, in any direction of the source. It is averaged by widened kernels (as wide as the
# ellipse) at several places along it.


LONGEST = 16.0
"""An ellipse that is longer than this many times its width is averaged over a wider one: at most 5° off grazing."""


@inner
def _depth_step(before: float, at: float, after: float) -> np.float32:
    """Change of depth to the next pixel on the surface that the pixel shows: the smaller one. 0 where it is alone."""
    back, on = at - before, after - at
    if np.isnan(back):
        back = on
    if np.isnan(on):
        on = back
    step = back if abs(back) < abs(on) else on
    return np.float32(0.0) if np.isnan(step) else np.float32(step)


@kernel
def depth_tilt(depth: NDArray[np.float32], margin: tuple[int, int, int, int]) -> NDArray[np.float32]:
    """Change of depth per column and per row.

    Of the differences to both neighbours the smaller counts, so that a silhouette does not belong to the ground on
    either side.

    Parameters
    ----------
    depth : ndarray, shape (rows, cols), float32
        Depth of the pixels and of those around them; NaN where there is no surface.
    margin : (left, top, right, bottom)
        Pixels of `depth` around those that are wanted.

    Returns
    -------
    ndarray, shape (2, rows − top − bottom, cols − left − right), float32
        Without NaN.
    """
    left, top, right, bottom = margin
    rows, cols = depth.shape
    result = np.empty((2, rows - top - bottom, cols - left - right), np.float32)
    nothing = np.float32(np.nan)
    for row in range(top, rows - bottom):
        for col in range(left, cols - right):
            at = depth[row, col]
            west = depth[row, col - 1] if col > 0 else nothing
            east = depth[row, col + 1] if col + 1 < cols else nothing
            north = depth[row - 1, col] if row > 0 else nothing
            south = depth[row + 1, col] if row + 1 < rows else nothing
            result[0, row - top, col - left] = _depth_step(west, at, east)
            result[1, row - top, col - left] = _depth_step(north, at, south)
    return result


@inner
def _ellipse(xu: float, xv: float, yu: float, yv: float) -> tuple[float, float, float, float]:
    """Half axes of what a pixel covers, source pixels, and the direction of the longer one."""
    p, q, r = xu * xu + xv * xv, xu * yu + xv * yv, yu * yu + yv * yv
    half = 0.5 * (p - r)
    root = np.sqrt(half * half + q * q)
    square = 0.5 * (p + r) + root
    long = np.sqrt(square)
    short = abs(xu * yv - xv * yu) / long if long > 0.0 else 0.0
    # The longer of the two forms of the eigenvector.
    x, y = (root + half, q) if half > 0.0 else (q, root - half)
    size = np.sqrt(x * x + y * y)
    x, y = (x / size, y / size) if size > 0.0 else (1.0, 0.0)
    return long, max(short, long / LONGEST), x, y


@kernel
def footprint_runs(
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    ground: tuple[NDArray[np.float32], NDArray[np.float32]],
    offset: tuple[int, int],
    block: tuple[Any, ...],
    scales: NDArray[np.float32],
) -> int:
    """Find the pixels that are to be averaged and make them AVERAGE; returns their number.

    Parameters
    ----------
    ground : (relief (rows, cols), tilt (2, rows, cols)), float32
        See `depth_tilt`.
    scales : (k, 4, RUN) float32
        Filled: widening along image x and y, and half the way x, y along which the kernel is repeated.

    See `place_runs` for the others.
    """
    relief, tilt = ground
    corner, _, _, kind, fill, _ = block
    work, origin, wider = derivative_space(), np.empty(2), np.empty(RUN, np.bool_)
    slopes = work[2]
    rate = (STRETCH_FULL - 1.0) / (STRETCH_FULL - STRETCH_FROM)
    count = 0
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        origin[0], origin[1] = float(corner[k, 0]), float(corner[k, 1])
        run_derivatives(anchors, runs[k], relief[row, col : col + n], tilt[:, row, col : col + n], origin, work)
        for i in range(n):
            long, short, x, y = _ellipse(slopes[1, i], slopes[2, i], slopes[4, i], slopes[5, i])
            # As `weights.stretch`.
            wide = 1.0 if short <= STRETCH_FROM else min(short, 1.0 + rate * (short - STRETCH_FROM))
            wide = short if short >= STRETCH_FULL else wide
            reach = np.sqrt(max(0.0, long * long - max(wide, STRETCH_FROM) ** 2))
            scales[k, 0, i] = scales[k, 1, i] = np.float32(wide)
            scales[k, 2, i], scales[k, 3, i] = np.float32(reach * x), np.float32(reach * y)
            wider[i] = wide > 1.0 or reach > 0.0
        count += mark_averaged(wider[:n], fill, kind, k)
    return count


@kernel
def footprint_levels(
    anchors: tuple[Any, ...],
    runs: NDArray[np.int32],
    ground: tuple[NDArray[np.float32], NDArray[np.float32]],
    finest: float,
    levels: NDArray[np.uint8],
    longest: NDArray[np.float64],
) -> None:
    """How often the source is halved for each pixel: at least `finest` pixels stay over the width of what it covers.

    Parameters
    ----------
    anchors, runs, ground
        As `footprint_runs`; the runs of a whole tile.
    levels : (rows, cols) uint8
        Filled along the runs.
    longest : (256,) float64
        Filled: the longest half axis, source pixels at full size, of the pixels of each level.
    """
    rects, box_start, box_heights, corners, _, _ = anchors
    relief, tilt = ground
    work, origin = derivative_space(), np.empty(2)
    coef, slopes = work[0], work[2]
    for k in range(runs.shape[0]):
        rect, row, col, n = rects[runs[k, 0]], runs[k, 1], runs[k, 3], runs[k, 4] - runs[k, 3]
        box = box_start[runs[k, 0]]
        run_coefficients(
            rect, box_heights[box], corners[box], middle_of_run(rect, runs[k]), row_weights(rect, row), coef
        )
        run_origin(coef, origin)
        run_derivatives(anchors, runs[k], relief[row, col : col + n], tilt[:, row, col : col + n], origin, work)
        for i in range(n):
            long, short, _, _ = _ellipse(slopes[1, i], slopes[2, i], slopes[4, i], slopes[5, i])
            level = 0
            while level < 30 and short >= 2.0 * finest:
                short, level = 0.5 * short, level + 1
            levels[row, col + i] = level
            if long > longest[level]:
                longest[level] = long


@inner
def _mean_along(
    source: NDArray[Any],
    valid: NDArray[np.uint8],
    spot: tuple[Any, ...],
    reach: tuple[float, float],
    rule: tuple[Any, ...],
    work: tuple[Any, ...],
    along: NDArray[np.float64],
) -> tuple[float, float]:
    """As `mean_at`, repeated along `reach` to both sides with weights that fall evenly; the means are in `along`.

    n places on each side at a distance d have the variance d² n (n + 2) / 6; a kernel that falls evenly over the reach
    r has r² / 6. The places are no further apart than the widened kernel reaches.
    """
    far = (reach[0] * reach[0] + reach[1] * reach[1]) / (spot[2] * spot[2])
    n = int(np.ceil(np.sqrt(1.0 + far) - 1.0))
    rate = 1.0 / np.sqrt(float(max(n * (n + 2), 1)))
    usable, total = 0.0, 0.0
    along[:] = 0.0
    for place in range(-n, n + 1):
        x, y = place * rate * reach[0], place * rate * reach[1]
        weight = 1.0 - abs(place) / (n + 1.0)
        moved = (spot[0], spot[1] + x, spot[2], spot[3], spot[4] + y, spot[5])
        found, every = weighted_mean(source, valid, moved, rule, work)
        total += weight * every
        if found > 0.0:
            usable += weight * found
            for band in range(along.shape[0]):
                along[band] += weight * found * work[3][band]
    for band in range(along.shape[0]):
        along[band] = along[band] / usable if usable > 0.0 else 0.0
    return usable, total


@kernel
def average_along_runs(
    source: NDArray[Any],
    valid: NDArray[np.uint8],
    runs: NDArray[np.int32],
    offset: tuple[int, int],
    block: tuple[Any, ...],
    scales: NDArray[np.float32],
    rule: tuple[Any, ...],
    result: tuple[Any, ...],
) -> None:
    """As `average_runs`, with `scales` of `footprint_runs`."""
    kind, fill = block[3], block[4]
    before, bands = taps_before(rule), result[0].shape[0]
    work, along = mean_space(source, bands), np.zeros(bands)
    for k in range(runs.shape[0]):
        if fill[k] == ALL:
            continue
        row, col = runs[k, 1] - offset[1], runs[k, 3] - offset[0]
        for i in range(runs[k, 4] - runs[k, 3]):
            if kind[k, i] == AVERAGE:
                spot = kernel_position(block, scales, before, k, i)
                reach = (np.float64(scales[k, 2, i]), np.float64(scales[k, 3, i]))
                usable, total = _mean_along(source, valid, spot, reach, rule, work, along)
                store_means(along, (usable, total), rule[2], result, (row, col + i))

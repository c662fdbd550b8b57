"""How many source pixels a target pixel spans, and what that means for the kernel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel, maker
from photoplan.kernels.place import ALL, AVERAGE, EMPTY, INTERIOR, NOTHING, SOME
from photoplan.kernels.position import (
    RUN,
    cell_space,
    find_cells,
    middle_of_run,
    row_weights,
    run_coefficients,
    shift_to,
    single,
)
from photoplan.kernels.weights import STRETCH_FROM, STRETCH_FULL

# Scales are measured at the corners of boxes and the ends of runs; between them a perspective is hardly larger. What
# comes this near to averaging is looked at pixel by pixel.
LOOK_CLOSER = 0.97 * STRETCH_FROM


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
def _run_slopes(
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
    w0, w1, w2, w3 = single(coef, 2)
    b0, b1, b2, b3 = single(slope, 2)
    h0, first, one = np.float32(h_ref), np.float32(u_first), np.float32(1.0)
    for c in range(2):
        x0, x1, x2, x3 = single(coef, c)
        a0, a1, a2, a3 = single(slope, c)
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
def _bend_slopes(
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
def _largest_of_run(
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
def _widening(along_u: NDArray[np.float32], along_v: NDArray[np.float32], stretch: NDArray[np.float32]) -> None:
    """Widening of the kernel along one axis of the image for the pixels of a run; see `weights.stretch`."""
    begin, full, one = np.float32(STRETCH_FROM), np.float32(STRETCH_FULL), np.float32(1.0)
    rate = np.float32((STRETCH_FULL - 1.0) / (STRETCH_FULL - STRETCH_FROM))
    for i in range(along_u.shape[0]):
        scale = np.sqrt(along_u[i] * along_u[i] + along_v[i] * along_v[i])
        partly = one + rate * (scale - begin)
        widened = partly if scale > begin else one
        stretch[i] = scale if scale >= full else widened


@maker
def slope_space() -> tuple[Any, ...]:
    """Working space of `slopes_of_run`."""
    slopes, higher = np.empty((6, RUN), np.float32), np.empty((6, RUN), np.float32)
    return np.empty((4, 3)), np.empty((4, 3)), slopes, higher, cell_space()


@inner
def slopes_of_run(
    anchors: tuple[Any, ...],
    run: NDArray[np.int32],
    heights: NDArray[np.float32],
    tilt: NDArray[np.float32],
    origin: NDArray[np.float64],
    work: tuple[Any, ...],
) -> bool:
    """Fills work[2], see `_run_slopes`, relative to `origin`; False, and anything, if nothing in the run is widened.

    tilt: see `_run_slopes`; (2, 0): none.
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
        shift_to(origin, coef)
        shift_to(origin, slope)
        largest = longer * longer * _largest_of_run(coef, slope, (first, last, h_ref), box_heights[box])
        alone = box == lowest and box + 1 == box_start[run[0] + 1]
        if alone and tilt.shape[1] == 0 and largest <= LOOK_CLOSER * LOOK_CLOSER:
            return False
        if box == lowest:
            _run_slopes(coef, slope, run[3] - u_ref, heights, h_ref, tilt, slopes)
        else:
            _run_slopes(coef, slope, run[3] - u_ref, heights, h_ref, tilt, higher)
            low = np.float32(box_heights[box, 0])
            for i in range(n):
                if heights[i] >= low:
                    for k in range(6):
                        slopes[k, i] = higher[k, i]
    # What a pixel covers is that of the smooth part of a flight; from line to line it changes at random.
    if field.size > 0 and field.shape[2] == 2:
        find_cells(frame, field, origin, slopes[0, :n], slopes[3, :n], cells)
        _bend_slopes(frame, field, (cells[0][:n], cells[1], cells[2]), slopes)
    return True


@inner
def make_average(wider: NDArray[np.bool_], fill: NDArray[np.uint8], kind: NDArray[np.uint8], k: int) -> int:
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
    work, no_tilt, wider = slope_space(), np.empty((2, 0), np.float32), np.empty(RUN, np.bool_)
    slopes, origin = work[2], np.empty(2)
    count = 0
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        origin[0], origin[1] = float(corner[k, 0]), float(corner[k, 1])
        if not slopes_of_run(anchors, runs[k], relief[row, col : col + n], no_tilt, origin, work):
            continue
        _widening(slopes[1, :n], slopes[2, :n], scales[k, 0])
        _widening(slopes[4, :n], slopes[5, :n], scales[k, 1])
        for i in range(n):
            wider[i] = scales[k, 0, i] > 1.0 or scales[k, 1, i] > 1.0
        count += make_average(wider[:n], fill, kind, k)
    return count

"""What a pixel covers of a source where its depth changes from pixel to pixel: a view over ground that runs away.

At constant depth a pixel of a view is a small square; on ground that is seen at a grazing angle it is an ellipse, ten
or a hundred times as long as wide, in any direction of the source. It is averaged by widened kernels (as wide as the
ellipse) at several places along it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.area import mean_at, mean_space, settle, spot_of, taps_before
from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.place import ALL, AVERAGE
from photoplan.kernels.position import RUN, middle_of_run, row_weights, run_coefficients, run_origin
from photoplan.kernels.scale import make_average, slope_space, slopes_of_run
from photoplan.kernels.weights import STRETCH_FROM, STRETCH_FULL

LONGEST = 16.0
"""An ellipse that is longer than this many times its width is averaged over a wider one: at most 5° off grazing."""


@inner
def _step(before: float, at: float, after: float) -> np.float32:
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
            result[0, row - top, col - left] = _step(west, at, east)
            result[1, row - top, col - left] = _step(north, at, south)
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
    work, origin, wider = slope_space(), np.empty(2), np.empty(RUN, np.bool_)
    slopes = work[2]
    rate = (STRETCH_FULL - 1.0) / (STRETCH_FULL - STRETCH_FROM)
    count = 0
    for k in range(runs.shape[0]):
        row, col, n = runs[k, 1] - offset[1], runs[k, 3] - offset[0], runs[k, 4] - runs[k, 3]
        origin[0], origin[1] = float(corner[k, 0]), float(corner[k, 1])
        slopes_of_run(anchors, runs[k], relief[row, col : col + n], tilt[:, row, col : col + n], origin, work)
        for i in range(n):
            long, short, x, y = _ellipse(slopes[1, i], slopes[2, i], slopes[4, i], slopes[5, i])
            # As `weights.stretch`.
            wide = 1.0 if short <= STRETCH_FROM else min(short, 1.0 + rate * (short - STRETCH_FROM))
            wide = short if short >= STRETCH_FULL else wide
            reach = np.sqrt(max(0.0, long * long - max(wide, STRETCH_FROM) ** 2))
            scales[k, 0, i] = scales[k, 1, i] = np.float32(wide)
            scales[k, 2, i], scales[k, 3, i] = np.float32(reach * x), np.float32(reach * y)
            wider[i] = wide > 1.0 or reach > 0.0
        count += make_average(wider[:n], fill, kind, k)
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
    work, origin = slope_space(), np.empty(2)
    coef, slopes = work[0], work[2]
    for k in range(runs.shape[0]):
        rect, row, col, n = rects[runs[k, 0]], runs[k, 1], runs[k, 3], runs[k, 4] - runs[k, 3]
        box = box_start[runs[k, 0]]
        run_coefficients(
            rect, box_heights[box], corners[box], middle_of_run(rect, runs[k]), row_weights(rect, row), coef
        )
        run_origin(coef, origin)
        slopes_of_run(anchors, runs[k], relief[row, col : col + n], tilt[:, row, col : col + n], origin, work)
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
        found, every = mean_at(source, valid, moved, rule, work)
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
                spot = spot_of(block, scales, before, k, i)
                reach = (np.float64(scales[k, 2, i]), np.float64(scales[k, 3, i]))
                usable, total = _mean_along(source, valid, spot, reach, rule, work, along)
                settle(along, (usable, total), rule[2], result, (row, col + i))

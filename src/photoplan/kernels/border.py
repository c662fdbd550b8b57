"""Third step of a tile, where needed: pixels at the edge of the valid part of the source."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel
from photoplan.kernels.place import ALL, BORDER

LEAST_WEIGHT = 0.5 - 1e-6
"""A pixel is valid if the weights of its valid taps add up to this: a half, up to rounding."""


@inner
def store(value: float, limits: tuple[Any, ...], out: NDArray[Any], place: tuple[Any, ...]) -> None:
    """Round half away from zero, clip and write; limits = (low, high, rounding), rounding 0 for float data."""
    low, high, rounding = limits
    if rounding > 0.0:
        value = np.floor(value + rounding) if value >= 0.0 else np.ceil(value - rounding)
        value = min(max(value, low), high)
    out[place[0], place[1], place[2]] = value


@inner
def weight_of(coefficients: NDArray[Any], column: int, g: float) -> float:
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
        wy = weight_of(coefficients, half + j, gy) if 0 <= y < size[1] else 0.0
        for i in range(taps):
            x = col + i
            weight = 0.0
            if 0 <= y < size[1] and 0 <= x < size[0] and (valid.size == 0 or valid[y, x] != 0):
                weight = wy * weight_of(coefficients, i, gx)
            weights[j, i] = weight
            total += weight
    return total


@inner
def _weighted(
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
                value = _weighted(source, band // lanes, band % lanes, place, taps, weights)
                store(value / total, limits, out, (band, row, col + i))

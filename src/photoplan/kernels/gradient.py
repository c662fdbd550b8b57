"""Gradients of a surface from its heights half a pixel away, and the light that falls on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel


@inner
def _slope(before: float, middle: float, after: float, step: float) -> float:
    """Difference over a step; over half of it where one side has no height."""
    if np.isnan(before):
        return 2.0 * (after - middle) / step
    if np.isnan(after):
        return 2.0 * (middle - before) / step
    return (after - before) / step


@kernel
def gradients(
    across: NDArray[np.float32],
    along: NDArray[np.float32],
    middle: NDArray[np.float32],
    resolution: float,
    result: NDArray[np.float32],
) -> None:
    """Slopes to the east and to the north at pixel centres.

    Parameters
    ----------
    across
        Heights in the middles of the pixels' left and right edges, shape (h, w + 1), metres; NaN = none.
    along
        Heights in the middles of their upper and lower edges, shape (h + 1, w).
    middle
        Heights at the centres, shape (h, w).
    resolution
        Side of a pixel, metres.
    result
        Filled, shape (2, h, w): dz/dX and dz/dY; NaN where the centre has no height, or nothing beside it in X or Y.
    """
    for i in range(middle.shape[0]):
        for j in range(middle.shape[1]):
            z = np.float64(middle[i, j])
            gx, gy = np.nan, np.nan
            if not np.isnan(z):
                gx = _slope(np.float64(across[i, j]), z, np.float64(across[i, j + 1]), resolution)
                gy = _slope(np.float64(along[i + 1, j]), z, np.float64(along[i, j]), resolution)
            none = np.isnan(gx) or np.isnan(gy)
            result[0, i, j] = np.nan if none else gx
            result[1, i, j] = np.nan if none else gy


@kernel
def illumination(
    slopes: NDArray[np.float32],
    exaggeration: float,
    suns: NDArray[np.float64],
    weighted: bool,
    result: NDArray[np.float32],
) -> None:
    """Light of one or several suns on a matt surface (Lambert): the cosine of the angle of incidence, never below 0.

    Parameters
    ----------
    slopes
        dz/dX and dz/dY, shape (2, h, w).
    exaggeration
        Factor of all heights.
    suns
        Unit vectors towards the suns (east, north, up), shape (n, 3).
    weighted
        Each sun counts with the squared cosine of the angle between its azimuth and the slope's, so that every slope
        has the contrast of the sun that it faces or turns its back to. Else all count alike.
    result
        Filled, shape (h, w), 0 to 1; NaN where a slope is NaN.
    """
    n = suns.shape[0]
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            gx, gy = exaggeration * slopes[0, i, j], exaggeration * slopes[1, i, j]
            steep = gx * gx + gy * gy
            norm = 1.0 / np.sqrt(1.0 + steep)
            total, weights = 0.0, 0.0
            for k in range(n):
                light = max(suns[k, 2] - gx * suns[k, 0] - gy * suns[k, 1], 0.0) * norm
                weight = 1.0
                if weighted and steep > 0.0:
                    flat = suns[k, 0] * suns[k, 0] + suns[k, 1] * suns[k, 1]
                    facing = gx * suns[k, 0] + gy * suns[k, 1]
                    weight = facing * facing / (steep * max(flat, 1e-30))
                total += weight * light
                weights += weight
            result[i, j] = np.nan if np.isnan(steep) else total / max(weights, 1e-30)

"""Displacement between bands from all structure of a scene: least squares matching of small windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.linear import solve
from photoplan.errors import InputError
from photoplan.quality.colour.model import Displacements

_Array = NDArray[np.float64]
#: Side of the windows, pixels.
_SIDE = 48
#: Steps of a match at most.
_ROUNDS = 15
#: Least correlation of both bands in a window: below it they do not show the same structure.
_LEAST_CORRELATION = 0.9
#: A match with a larger standard deviation, pixels, says nothing of fractions of a pixel.
_MOST_SIGMA = 0.1
#: Windows of natural scenes are not known better than this, since colours change across edges, pixels.
_FLOOR = 0.01
#: Pixels around a window in which its counterpart may lie, with room for interpolation.
_MARGIN = 6


def patch_displacements(
    reference: _Array, band: _Array, saturation: float = float("inf"), most: int = 400
) -> Displacements:
    """Displacements of a band in windows, by least squares matching with brightness and contrast as unknowns.

    Every edge and texture of a window takes part, whatever its direction; where colours change together with
    brightness, single windows are displaced by that, which the model over the field averages and tests.

    Parameters
    ----------
    reference, band : (height, width)
        Grey values; NaN where there is none.
    saturation : float
        Windows with grey values from here on are left out.
    most : int
        Windows at most, evenly spread.

    Raises
    ------
    InputError
        Fewer than four windows match.
    """
    height, width = reference.shape
    reach = _SIDE + 2 * _MARGIN
    rows = np.arange(0, height - reach + 1, _SIDE)
    columns = np.arange(0, width - reach + 1, _SIDE)
    corners = [(int(r), int(c)) for r in rows for c in columns]
    step = max(1, -(-len(corners) // most))
    found = []
    for row, column in corners[::step]:
        part = (slice(row, row + reach), slice(column, column + reach))
        here, there = reference[part], band[part]
        if not (np.isfinite(here).all() and np.isfinite(there).all()):
            continue
        if max(here.max(), there.max()) >= saturation:
            continue
        match = _matched(here, there)
        if match is not None:
            middle = (reach - 1) / 2.0
            found.append((column + middle, row + middle, *match))
    if len(found) < 4:
        raise InputError(
            f"{len(found)} of {len(corners[::step])} windows of {_SIDE} × {_SIDE} pixels show the same structure in "
            "both bands (correlation from 0.9); at least 4 are needed"
        )
    table = np.array(found)
    n = len(found)
    place = np.repeat(table[:, :2], 2, 0)
    direction = np.tile(np.eye(2), (n, 1))
    sigma = np.hypot(table[:, 4:6].ravel(), _FLOOR)
    return Displacements(place, direction, table[:, 2:4].ravel(), sigma, np.repeat(np.arange(n), 2))


def _matched(here: _Array, there: _Array) -> tuple[float, float, float, float] | None:
    """Displacement along x and y and their standard deviations; None: the windows do not match."""
    inner = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
    spline = ndimage.spline_filter(there, order=3)
    y, x = np.mgrid[_MARGIN : here.shape[0] - _MARGIN, _MARGIN : here.shape[1] - _MARGIN].astype(float)
    grey = here[inner].ravel()
    if grey.std() < 1e-9 or there[inner].std() < 1e-9:
        return None
    # Slopes of the reference, at whole pixels: their noise has nothing to do with that of the interpolated band, and
    # by symmetry nothing with that of the reference. Slopes of the band would pull the result to whole pixels.
    slopes = [each[inner].ravel() for each in np.gradient(here)[::-1]]
    contrast, moved = there[inner].std() / here[inner].std(), np.zeros(2)
    for _ in range(_ROUNDS):
        at = [y + moved[1], x + moved[0]]
        values = ndimage.map_coordinates(spline, at, order=3, prefilter=False).ravel()
        # band(place + displacement) = contrast · reference + brightness.
        matrix = np.stack([-contrast * slopes[0], -contrast * slopes[1], grey, np.ones(grey.size)], 1)
        fit = solve(matrix, values)
        unknowns = fit.unknowns
        if fit.condition < 1e-4:
            return None
        moved += np.clip(unknowns[:2], -1.0, 1.0)
        if np.abs(moved).max() > _MARGIN - 3 or unknowns[2] <= 0.0:
            return None
        contrast = unknowns[2]
        if np.abs(unknowns[:2]).max() < 1e-4:
            break
    sigma = fit.sigmas[:2]
    if sigma.max() > _MOST_SIGMA:
        return None
    if np.corrcoef(values, grey)[0, 1] < _LEAST_CORRELATION:
        return None
    return float(moved[0]), float(moved[1]), float(sigma[0]), float(sigma[1])

"""Displacement between bands: from straight edges along their normal, and from all structure by small windows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from photoplan.adjustment.iterate import levenberg
from photoplan.adjustment.linear import Fit, solve
from photoplan.errors import InputError
from photoplan.quality.colour.model import Displacements
from photoplan.quality.edges.find import EdgeRegion

_Array = NDArray[np.float64]
#: Steps of a fit at most.
_ROUNDS = 30
#: Least step at an edge in units of the noise of a pixel, in each band.
_LEAST_SNR = 5.0
#: A position is not known better than this whatever its fit says, pixels.
_FLOOR = 0.005


def edge_displacements(
    reference: _Array, band: _Array, edges: Sequence[EdgeRegion], saturation: float = float("inf")
) -> Displacements:
    """Displacements of a band along the normals of edges that were found in the reference.

    In each band the step of a normal distribution is fitted to the pixels of an edge; the direction comes from the
    reference. The difference of both positions is free of what both bands share, such as the object's own edge; where
    the bands are blurred unsymmetrically and differently, that enters.
    """
    rows = []
    height, width = reference.shape
    for number, edge in enumerate(edges):
        window = edge.window((width, height))
        part = (slice(window[1], window[1] + window[3]), slice(window[0], window[0] + window[2]))
        mask = edge.mask(window) & np.isfinite(reference[part]) & np.isfinite(band[part])
        if mask.sum() < 60 or max(reference[part][mask].max(), band[part][mask].max()) >= saturation:
            continue
        line = edge.line
        x = (np.arange(window[2]) + (window[0] - line.x))[None, :]
        y = (np.arange(window[3]) + (window[1] - line.y))[:, None]
        along = (x * line.tx + y * line.ty)[mask]
        across = (y * line.tx - x * line.ty)[mask]
        first = _step(along, across, reference[part][mask], None)
        if first is None:
            continue
        second = _step(along, across, band[part][mask], first[2])
        if second is None:
            continue
        # `across` grows along (−ty, tx).
        rows.append((line.x, line.y, -line.ty, line.tx, second[0] - first[0], np.hypot(first[1], second[1]), number))
    if len(rows) < 4:
        raise InputError(
            f"{len(rows)} of {len(edges)} edges can be measured in both bands; at least 4 are needed: clean, straight, "
            "unsaturated, with contrast in both"
        )
    table = np.array(rows)
    sigma = np.hypot(table[:, 5], _FLOOR)
    return Displacements(
        place=table[:, :2], direction=table[:, 2:4], value=table[:, 4], sigma=sigma, group=table[:, 6].astype(int)
    )


def _step(along: _Array, across: _Array, grey: _Array, slope: float | None) -> tuple[float, float, float] | None:
    """Position of a blurred step across, its standard deviation, and the slope of its line; None: no clear step."""
    unknown = 3 if slope is None else 2

    def shares(at: _Array) -> _Array:
        return np.asarray(special.ndtr((across - at[0] - at[2] * along) / np.exp(at[1])))

    def levels(at: _Array) -> Fit:
        return solve(np.stack([np.ones(grey.size), shares(at)], 1), grey)

    def equations(at: _Array) -> tuple[_Array, _Array]:
        """Derivatives of the grey values by position, blur, slope of the line and both levels, and residuals."""
        fit = levels(at)
        moved = [at + 1e-5 * np.eye(3)[k] for k in range(unknown)]
        columns = [fit.unknowns[1] * (shares(there) - fit.A[:, 1]) / 1e-5 for there in moved]
        return np.column_stack([*columns, fit.A]), fit.residuals

    def moved(at: _Array, step: _Array) -> _Array | None:
        trial = at + np.pad(np.clip(step[:unknown], -1.0, 1.0), (0, 3 - unknown))
        return trial if abs(trial[1]) <= 4.0 else None

    found = levenberg(np.array([0.0, 0.0, slope or 0.0]), equations, moved, _ROUNDS)
    free, noise, cofactors = found.state, found.sigma0, found.cofactors()
    if cofactors is None:
        return None
    sigma = noise * float(np.sqrt(cofactors[0, 0]))
    reach = float(np.abs(across).max())
    if not np.isfinite([sigma, *free]).all() or abs(free[0]) > 0.6 * reach or np.exp(free[1]) > 0.5 * reach:
        return None
    if abs(levels(free).unknowns[1]) < _LEAST_SNR * noise or sigma > 0.3:
        return None
    return float(free[0]), sigma, float(free[2])


#: Side of the windows, pixels.
_WINDOW = 48
#: Steps of a match at most.
_MATCHING_ROUNDS = 15
#: Least correlation of both bands in a window: below it they do not show the same structure.
_LEAST_CORRELATION = 0.9
#: A match with a larger standard deviation, pixels, says nothing of fractions of a pixel.
_MOST_SIGMA = 0.1
#: Windows of natural scenes are not known better than this, since colours change across edges, pixels.
_MATCHING_FLOOR = 0.01
#: Pixels around a window in which its counterpart may lie, with room for interpolation.
_MARGIN = 6


def patch_displacements(
    reference: _Array, band: _Array, saturation: float = float("inf"), most: int = 400
) -> Displacements:
    """Displacements of a band in windows, by least squares matching with brightness and contrast as unknowns.

    Every edge and texture of a window takes part, whatever its direction; where colours change together with
    brightness, single windows are displaced by that, which the model over the field averages and tests.
    """
    height, width = reference.shape
    reach = _WINDOW + 2 * _MARGIN
    rows = np.arange(0, height - reach + 1, _WINDOW)
    columns = np.arange(0, width - reach + 1, _WINDOW)
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
            f"{len(found)} of {len(corners[::step])} windows of {_WINDOW} × {_WINDOW} pixels show the same structure "
            "in both bands (correlation from 0.9); at least 4 are needed"
        )
    table = np.array(found)
    n = len(found)
    place = np.repeat(table[:, :2], 2, 0)
    direction = np.tile(np.eye(2), (n, 1))
    sigma = np.hypot(table[:, 4:6].ravel(), _MATCHING_FLOOR)
    return Displacements(
        place=place, direction=direction, value=table[:, 2:4].ravel(), sigma=sigma, group=np.repeat(np.arange(n), 2)
    )


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
    for _ in range(_MATCHING_ROUNDS):
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

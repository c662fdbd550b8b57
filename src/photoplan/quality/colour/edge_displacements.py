"""Displacement between bands from straight edges: where each band's edge lies along the common normal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

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

    Parameters
    ----------
    reference, band : (height, width)
        Grey values; NaN where there is none.
    edges : sequence of EdgeRegion
        As `find_edges` gives them for the reference.
    saturation : float
        Grey values from here on are saturated: such edges are left out.

    Raises
    ------
    InputError
        Fewer than four edges can be measured in both bands.
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
    return Displacements(table[:, :2], table[:, 2:4], table[:, 4], sigma, table[:, 6].astype(int))


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

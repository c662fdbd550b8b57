"""Displacement between bands from straight edges: where each band's edge lies along the common normal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

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
    free = np.array([0.0, np.log(1.0), 0.0 if slope is None else slope])
    unknown = 3 if slope is None else 2

    def shares(at: _Array) -> _Array:
        return np.asarray(special.ndtr((across - at[0] - at[2] * along) / np.exp(at[1])))

    def linear(at: _Array) -> tuple[_Array, _Array, float]:
        basis = np.stack([np.ones(grey.size), shares(at)], 1)
        levels = np.asarray(np.linalg.lstsq(basis, grey, rcond=None)[0], np.float64)
        left = grey - basis @ levels
        return levels, left, float(left @ left)

    damping = 1e-3
    levels, left, best = linear(free)
    for _ in range(_ROUNDS):
        jacobian = _jacobian(shares, free, levels, unknown)
        normal = jacobian.T @ jacobian
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal) + 1e-12), jacobian.T @ left, rcond=None)[0]
        trial = free.copy()
        trial[:unknown] += np.clip(step[:unknown], -1.0, 1.0)
        if abs(trial[1]) > 4.0:
            return None
        new_levels, new_left, value = linear(trial)
        if value <= best * (1.0 + 1e-12):
            free, levels, left, best, damping = trial, new_levels, new_left, value, damping / 5.0
            if abs(step[0]) < 1e-6:
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    noise = np.sqrt(best / max(grey.size - unknown - 2, 1))
    jacobian = _jacobian(shares, free, levels, unknown)
    try:
        sigma = noise * np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[0, 0])
    except np.linalg.LinAlgError:
        return None
    reach = float(np.abs(across).max())
    if not np.isfinite([sigma, *free]).all() or abs(free[0]) > 0.6 * reach or np.exp(free[1]) > 0.5 * reach:
        return None
    if abs(levels[1]) < _LEAST_SNR * noise or sigma > 0.3:
        return None
    return float(free[0]), float(sigma), float(free[2])


def _jacobian(shares: Callable[[_Array], _Array], at: _Array, levels: _Array, unknown: int) -> _Array:
    """Derivatives of the grey values: position, blur, slope of the line, both levels."""
    basis = np.stack([np.ones(shares(at).size), shares(at)], 1)
    columns = []
    for k in range(unknown):
        moved = at.copy()
        moved[k] += 1e-5
        columns.append(levels[1] * (shares(moved) - basis[:, 1]) / 1e-5)
    return np.column_stack([*columns, basis])

"""Grid widths adapted to the relief."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.kernels.sample_grid import sample_lattice
from photoplan.surfaces.units import Unit


def thin(unit: Unit, tolerance: float) -> Unit:
    """A unit with the coarsest grid, by factors of two, whose bilinear surface keeps to all posts."""
    if unit.faces is not None:
        raise InputError(f"unit at {unit.left}, {unit.top} has triangles; thin the grid first, then build them")
    if not tolerance >= 0:
        raise InputError(f"tolerance {tolerance}; a height in metres, zero or more, is needed")
    step = 1
    while unit.meshes % (2 * step) == 0 and _keeps(unit.heights, 2 * step, tolerance):
        step *= 2
    if step == 1:
        return unit
    return dataclasses.replace(
        unit,
        heights=np.ascontiguousarray(unit.heights[::step, ::step]),
        sigmas=np.ascontiguousarray(unit.sigmas[::step, ::step]),
    )


def _keeps(heights: NDArray[np.float32], step: int, tolerance: float) -> bool:
    """Whether posts at every `step` describe the same area, and all posts well enough."""
    count = heights.shape[0]
    coarse = np.ascontiguousarray(heights[::step, ::step])
    n = coarse.shape[0] - 1
    valid = _complete(np.isfinite(heights)).reshape(n, step, n, step)
    whole, none = valid.all(axis=(1, 3)), ~valid.any(axis=(1, 3))
    if not (np.where(_complete(np.isfinite(coarse)), whole, none)).all():
        return False
    between = sample_lattice(coarse, 0.0, 1 / step, count, 0.0, 1 / step, count)
    both = np.isfinite(heights) & np.isfinite(between)
    return bool((np.abs(heights[both].astype(float) - between[both]) <= tolerance).all())


def _complete(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Meshes with all four posts."""
    return np.asarray(valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:] & valid[:-1, :-1])

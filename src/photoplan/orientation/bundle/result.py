"""From the solution of a bundle adjustment to its result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.orientation.bundle.active import Active
from photoplan.orientation.bundle.block import Adjusted, AdjustedCamera, AdjustedStrip, Block, Correlation, Group
from photoplan.orientation.bundle.robust import kinds_of, kinds_of_measurements
from photoplan.orientation.bundle.rows import residuals_of_all
from photoplan.orientation.bundle.select import Selection
from photoplan.orientation.bundle.solution import Solution
from photoplan.orientation.bundle.state import rotation_vector

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Weighted:
    """The last solution and how its observations were weighted."""

    solution: Solution
    factors: _Floats
    """Standard deviation found over the one stated, of each group (`kinds_of`)."""
    correlations: tuple[Correlation, ...]


def result_of(block: Block, selection: Selection, weighted: Weighted, active: Active, iterations: int) -> Adjusted:
    """The result as users see it."""
    solution = weighted.solution
    model, state = solution.model, solution.state
    residuals = residuals_of_all(model, state)
    redundancies, normalised = _of_measurements(solution, residuals)
    rejected = ~active.image
    ground_residuals, ground_normalised = _of_ground(solution)
    position_residuals, attitude_residuals = _of_direct(solution)
    sigma0 = solution.sigma0
    variance = sigma0**2 if np.isfinite(sigma0) else 1.0
    columns = model.columns
    return Adjusted(
        images=model.image_names,
        poses=state.poses(),
        pose_covariance=_blocks(solution, variance),
        cameras=_cameras(solution, variance),
        points=model.point_names,
        XYZ=state.XYZ,
        point_covariance=solution.point_cofactors * variance,
        rays=np.bincount(model.point, minlength=len(model.point_names)),
        left_out=selection.left_out,
        residuals=residuals,
        redundancies=redundancies,
        normalised=normalised,
        rejected=rejected,
        ground_residuals=ground_residuals,
        ground_normalised=ground_normalised,
        ground_rejected=~active.ground & np.isfinite(ground_residuals),
        position_residuals=position_residuals,
        position_rejected=~active.position,
        attitude_residuals=attitude_residuals,
        lever_arm=state.lever,
        lever_arm_sigma=_sigma(solution, columns.lever, 3, variance),
        boresight=rotation_vector(state.boresight),
        boresight_sigma=_sigma(solution, columns.boresight, 3, variance),
        strips=_strips(solution, variance),
        groups=_groups(solution, weighted.factors),
        sigma0=sigma0,
        redundancy=solution.redundancy,
        unknowns=columns.count + 3 * len(model.point_names),
        iterations=iterations,
        correlations=weighted.correlations,
    )


def _of_measurements(solution: Solution, residuals: _Floats) -> tuple[_Floats, _Floats]:
    """Redundancy numbers and normalised residuals of all measurements."""
    model = solution.model
    k = len(model.image)
    redundancies = np.full_like(residuals, np.nan)
    normalised = np.full_like(residuals, np.nan)
    redundancies[model.observation] = solution.redundancies[: 2 * k].reshape(-1, 2)
    normalised[model.observation] = solution.normalised()[: 2 * k].reshape(-1, 2)
    # What was taken out is judged against the scale of its group; it had no part in the result.
    out = np.isfinite(residuals[:, 0])
    out[model.observation] = False
    if out.any():
        scale = solution.scales()[kinds_of_measurements(model)[out]]
        normalised[out] = residuals[out] / model.block.observations.sigma[out] / scale[:, None]
    return redundancies, normalised


def _of_ground(solution: Solution) -> tuple[_Floats, _Floats]:
    model = solution.model
    ground = model.block.ground
    points = {name: k for k, name in enumerate(model.point_names)}
    at = np.array([points.get(n, -1) for n in ground.names], np.int64)
    residuals = np.full((len(ground), 3), np.nan)
    residuals[at >= 0] = solution.state.XYZ[at[at >= 0]] - ground.XYZ[at >= 0]
    normalised = np.full((len(ground), 3), np.nan)
    rows = slice(2 * len(model.image), 2 * len(model.image) + len(model.ground))
    normalised[model.ground, model.ground_axis] = solution.normalised()[rows]
    return residuals, normalised


def _of_direct(solution: Solution) -> tuple[_Floats, _Floats]:
    model, block = solution.model, solution.model.block
    position = np.full((0 if block.positions is None else len(block.positions.images), 3), np.nan)
    position[model.position_row] = solution.found.position
    attitude = np.full((0 if block.attitudes is None else len(block.attitudes.images), 3), np.nan)
    attitude[model.attitude_row] = solution.found.attitude
    return position, attitude


def _blocks(solution: Solution, variance: float) -> _Floats:
    """Covariance of every image's six unknowns."""
    n = solution.model.columns.images
    out = np.full((n, 6, 6), np.nan)
    if solution.inverse is not None:
        for k in range(n):
            out[k] = solution.inverse.block(np.arange(6 * k, 6 * k + 6)) * variance
    return out


def _sigma(solution: Solution, first: int, count: int, variance: float) -> _Floats:
    if first < 0:
        return np.zeros(count)
    if solution.inverse is None:
        return np.full(count, np.nan)
    return np.sqrt(np.diag(solution.inverse.block(np.arange(first, first + count))) * variance)


def _cameras(solution: Solution, variance: float) -> tuple[AdjustedCamera, ...]:
    model = solution.model
    found = []
    for name, camera, free in zip(model.camera_names, solution.state.cameras, model.free):
        covariance = np.full((len(free), len(free)), np.nan)
        if free and solution.inverse is not None:
            first = model.columns.cameras[name]
            covariance = solution.inverse.block(np.arange(first, first + len(free))) * variance
        point = (camera.x0, camera.y0)
        found.append(AdjustedCamera(name, camera.c, point, camera.lens, free, covariance))
    return tuple(found)


def _strips(solution: Solution, variance: float) -> tuple[AdjustedStrip, ...]:
    model, state = solution.model, solution.state
    out = []
    for k, name in enumerate(model.strip_names):
        first = model.columns.strips.get(name, -1)
        sigma = np.full(6, np.nan)
        width = {"shift": 3, "linear": 6}.get(model.block.drift, 0)
        if first >= 0:
            sigma[:width] = _sigma(solution, first, width, variance)
        out.append(AdjustedStrip(name, state.shifts[k], state.rates[k], float(model.epochs[k]), sigma))
    return tuple(out)


def _groups(solution: Solution, factors: _Floats) -> tuple[Group, ...]:
    """Figures of each kind of observation."""
    model = solution.model
    kinds, of = kinds_of(model)
    if solution.inverse is None:
        factors = np.full(len(kinds), np.nan)
    raw = np.concatenate(
        [
            solution.found.image.ravel(),
            _of_ground(solution)[0][model.ground, model.ground_axis],
            solution.found.position.ravel(),
            solution.found.attitude.ravel(),
        ]
    )
    counted = solution.weight[: len(of)] > 0
    groups = []
    for k, (name, unit) in enumerate(kinds):
        mine = (of == k) & counted
        if mine.any():
            rms = float(np.sqrt((raw[mine] ** 2).mean()))
            r = float(solution.redundancies[: len(of)][mine].sum())
            groups.append(Group(name, int(mine.sum()), r, rms, unit, float(factors[k])))
    return tuple(groups)

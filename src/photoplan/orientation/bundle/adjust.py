"""Bundle block adjustment: orientations, points and cameras from all observations at once, by least squares.

The unknowns are exterior orientations, ground points and, where they are free, parameters of cameras, lever arm,
boresight and drift. Points are eliminated (Schur complement), what remains is sparse and solved by SciPy. Gross errors
are found in two ways: first by weights that fall with the residual, from whatever start; then by data snooping
(Baarda 1968): each residual against its own standard deviation, the worst of each point first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.orientation.bundle.block import Active, Adjusted, AdjustSettings, Block, Correlation
from photoplan.orientation.bundle.correlation import correlation_of, effects_of_rows
from photoplan.orientation.bundle.loop import Loop, Progress
from photoplan.orientation.bundle.model import Model, build_model
from photoplan.orientation.bundle.normal import check_rank, reduce_normals
from photoplan.orientation.bundle.result import (
    Solution,
    Weighted,
    evened_sigmas,
    refitted_sigmas,
    result_of,
    solution_of,
    with_common_errors,
)
from photoplan.orientation.bundle.robust import (
    first_taken_out,
    judged_control,
    kinds_of_measurements,
    scales_of,
    snooped,
    weights_of,
)
from photoplan.orientation.bundle.rows import linearise, residuals_of, whitened
from photoplan.orientation.bundle.select import Selection, select, start_points
from photoplan.orientation.bundle.unknowns import State, start_state

_Floats = NDArray[np.float64]

#: Points farther from the block than this, in units of its largest extent, begin anew.
_FAR = 10.0
#: Times that the robust start is made, each without the control that the one before has found wrong.
_AGAIN = 3
#: Rounds of data snooping, and of variance components.
_ROUNDS, _COMPONENTS = 8, 6
#: Rounds after which standard deviations of image points are fitted to residuals.
_REFITTED = 2


def adjust_block(block: Block, settings: AdjustSettings | None = None, progress: Progress | None = None) -> Adjusted:
    """Adjust a block of images.

    Parameters
    ----------
    block : Block
        In a Cartesian system.
    settings : AdjustSettings, optional
    progress : callable, optional
        Told after each iteration.

    Raises
    ------
    GeometryError
        The observations do not determine the unknowns; the message names them. Or no image has enough points, or the
        iterations do not converge.
    InputError, UsageError
        A standard deviation is missing, or a parameter cannot be free.
    """
    settings = settings or AdjustSettings()
    loop = Loop(settings.iterations, progress or (lambda number, rms: None))
    active = Active.all_of(block)
    alternative: tuple[str, ...] = ()
    selection, XYZ, lost = _selected(block, active, frozenset(), wait=settings.robust)
    model = build_model(block, selection.images, selection.measured, selection.points)
    stated, refit = block.observations.sigma, settings.variance_components and settings.covariance
    if refit:
        block = replace(block, observations=evened_sigmas(model))
        model = build_model(block, selection.images, selection.measured, selection.points)
    state = _started(model, XYZ)
    _check(model, state, active)
    passes: list[tuple[State, Active, tuple[str, ...]]] = []
    for _ in range(_AGAIN if settings.robust else 0):
        state = loop.run(model, state, weights_of(model, active), robust=True)
        found = first_taken_out(model, state, replace(Active.all_of(block), ground=active.ground), settings.critical)
        factors = scales_of(model, whitened(model, residuals_of(model, state)))
        found, alternative = judged_control(model, state, found, factors, settings.critical)
        again, active = bool((active.ground & ~found.ground).any()), found
        if not again:
            active = _returned(model, state, active, factors, settings.critical)
            break
        passes.append((state, active, alternative))
    else:
        # Judgements that do not settle: the one that most measurements fit, of equal ones the first.
        if passes:
            state, active, alternative = max(passes, key=lambda item: int(item[1].image.sum()))
    for turn in range(_ROUNDS):
        loose = frozenset() if turn == 0 else lost
        while True:
            model, state, selection, lost = _rebuilt(block, model, state, active, loose)
            state, loose = loop.watched(model, state, weights_of(model, active))
            if not loose:
                break
            loose |= lost
        solution = solution_of(model, state, weights_of(model, active), settings.covariance)
        if refit and turn < _REFITTED:
            block = replace(block, observations=refitted_sigmas(solution, stated))
        if not settings.robust or turn == _ROUNDS - 1:
            break
        judged = solution.judged()
        next_active = snooped(model, state, judged, active, settings.critical)
        next_active, alternative = judged_control(model, state, next_active, judged.scales, settings.critical)
        as_weighted = block.observations is model.block.observations
        if next_active.equals(active) and (as_weighted or turn >= _REFITTED):
            break
        active = next_active
    if block.observations is not model.block.observations:
        model, state, selection, lost = _rebuilt(block, model, state, active, lost)
        state = loop.run(model, state, weights_of(model, active))
        solution = solution_of(model, state, weights_of(model, active), settings.covariance)
    weighted = _weighted(loop, solution, selection, active, settings)
    check_rank(model, weighted.solution.state, weighted.solution.reduced)
    return replace(result_of(selection, weighted, active, loop.count), other_control=alternative)


def _weighted(
    loop: Loop, solution: Solution, selection: Selection, active: Active, settings: AdjustSettings
) -> Weighted:
    """The solution with the accuracies that residuals show: variance components, and correlated image points.

    Positions and attitudes that agree among each other far better than stated may all be off by the rest.
    """
    model, state = solution.model, solution.state
    correlations: tuple[Correlation, ...] = ()
    if settings.correlation and settings.covariance:
        image = model.parts.image
        used = solution.weight[image][::2] > 0
        correlations = correlation_of(model, solution.normalised()[image].reshape(-1, 2), used)
    effects = effects_of_rows(model, correlations, len(solution.e)) if correlations else None
    factors: _Floats | None = None
    common = False
    for _ in range(2 * _COMPONENTS):
        if settings.variance_components and settings.covariance:
            factors = solution.trusted(solution.factors(factors))
        elif effects is None:
            break
        weight = weights_of(model, active, factors)
        state = loop.run(model, state, weight if effects is None else weight / effects)
        solution = solution_of(model, state, weight, settings.covariance, effects)
        if factors is not None and not np.allclose(solution.trusted(solution.factors(factors)), factors, rtol=0.02):
            continue
        block = model.block if factors is None or common else with_common_errors(solution, factors)
        if block is model.block:
            break
        common = True
        model = build_model(block, selection.images, selection.measured, selection.points)
        if effects is not None:
            effects = effects_of_rows(model, correlations, model.rows)
        solution = solution_of(model, state, weights_of(model, active, factors), settings.covariance, effects)
    return Weighted(solution, solution.factors(factors), correlations)


def _selected(
    block: Block, active: Active, lost: frozenset[str], wait: bool = False
) -> tuple[Selection, _Floats, frozenset[str]]:
    """What takes part, start values of its points, and the points whose rays are parallel."""
    while True:
        selection = select(block, active, lost)
        if not selection.images or not selection.points:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in selection.left_out[:5])
            raise GeometryError(
                f"no image has enough measured points to be adjusted ({reasons or 'no measurements'}); are image "
                "points and images of the same block?"
            )
        XYZ, parallel = start_points(block, selection, wait)
        if not parallel:
            return selection, XYZ, lost
        lost |= parallel


def _check(model: Model, state: State, active: Active) -> None:
    """Refuse at once what nothing determines; start values with points behind cameras say nothing of that yet."""
    weight = weights_of(model, active)
    if not np.isfinite(whitened(model, residuals_of(model, state))[weight > 0]).all():
        return
    rows, _ = linearise(model, state, np.sqrt(weight))
    check_rank(model, state, reduce_normals(rows, len(model.point_names)))


def _rebuilt(
    block: Block, model: Model, state: State, active: Active, lost: frozenset[str], anew: bool = False
) -> tuple[Model, State, Selection, frozenset[str]]:
    """The model without what was taken out; unknowns keep their values, points that come back are intersected.

    Rays that are left may be parallel, so that points can be lost here too. With `anew` all points are intersected.
    """
    poses = dict(zip(model.image_names, state.poses()))
    block = replace(block, images=tuple(replace(b, pose=poses.get(b.name, b.pose)) for b in block.images))
    selection, XYZ, lost = _selected(block, active, lost)
    made = build_model(block, selection.images, selection.measured, selection.points)
    before = {name: k for k, name in enumerate(model.point_names)}
    old = np.array([before.get(n, -1) for n in made.point_names], np.int64)
    # What wrong rays have driven far away is intersected anew, without them.
    from_where = state.images.centers if len(state.images.centers) else XYZ
    middle = from_where.mean(axis=0)
    reach = _FAR * np.linalg.norm(np.concatenate([XYZ, from_where]) - middle, axis=1).max()
    old[anew | (np.linalg.norm(state.XYZ[old] - middle, axis=1) > reach)] = -1
    XYZ[old >= 0] = state.XYZ[old[old >= 0]]
    return made, state.carried(_started(made, XYZ)), selection, lost


def _returned(model: Model, state: State, active: Active, factors: _Floats, critical: float) -> Active:
    """Points that have lost most of their rays while orientations were poor, and that fit now that they are good."""
    seen = model.block.observations
    left = np.bincount(seen.point[active.image], minlength=len(seen.points))
    few = left < np.maximum(2.0, 0.6 * np.bincount(seen.point, minlength=len(seen.points)))
    tried = replace(active, image=active.image | few[seen.point])
    made, started, _, parallel = _rebuilt(model.block, model, state, tried, frozenset(), anew=True)
    scale = factors[kinds_of_measurements(made)[made.observation]]
    e = np.abs(residuals_of(made, started).image / made.sigma).max(axis=1) / scale
    worst = np.zeros(len(made.point_names))
    np.maximum.at(worst, made.point, np.nan_to_num(e, nan=np.inf))
    image = active.image.copy()
    image[made.observation[worst[made.point] < critical]] = True
    image |= (few & np.array([name in parallel for name in seen.points], bool))[seen.point]
    return replace(active, image=image)


def _started(model: Model, XYZ: _Floats) -> State:
    poses = [model.block.images[k].pose for k in model.image_rows]
    return start_state(model.block, model.camera_names, model.strip_names, poses, XYZ, model.sets)

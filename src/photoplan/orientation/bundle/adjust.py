"""Bundle block adjustment: orientations, points and cameras from all observations at once, by least squares.

The unknowns are exterior orientations, ground points and, where they are free, parameters of cameras, lever arm,
boresight and drift. Points are eliminated (Schur complement), what remains is sparse and solved by SciPy. Gross errors
are found in two ways: first by weights that fall with the residual, from whatever start; then by data snooping
(Baarda 1968): each residual against its own standard deviation, the worst of each point first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.orientation.bundle.block import Active, Adjusted, AdjustSettings, Block, Correlation
from photoplan.orientation.bundle.correlation import correlation_of, effects_of_rows
from photoplan.orientation.bundle.far import along_rays, loose_points
from photoplan.orientation.bundle.model import Model, build_model
from photoplan.orientation.bundle.normal import check_rank, reduce_normals
from photoplan.orientation.bundle.result import Solution, Weighted, result_of, solution_of
from photoplan.orientation.bundle.robust import (
    first_taken_out,
    judged_control,
    kinds_of_measurements,
    robust_weights,
    scales_of,
    snooped,
    softened,
    weights_of,
)
from photoplan.orientation.bundle.rows import linearise, residuals_of, whitened
from photoplan.orientation.bundle.select import Selection, select, start_points
from photoplan.orientation.bundle.unknowns import State, start_state

#: Called after each iteration: its number, and the root mean square of the weighted residuals.
Progress = Callable[[int, float], None]

_Floats = NDArray[np.float64]

#: Largest step at the end, in units of each unknown's own standard deviation (the others fixed).
_CONVERGED = 1e-3
_ROUNDING = 1e-6
#: The same for the robust start, and its least number of iterations.
_ROUGHLY, _LEAST = 0.5, 8
#: Largest relative change of the sum of squares at the end.
_SETTLED = 1e-9
#: Damped steps are short for that reason alone. But where so many of them one after the other lower the sum of squares
#: by less than this part of a variance each, what is left to go means nothing: an unknown that is off by its whole
#: standard deviation makes one.
_FLAT, _FLAT_STEPS = 1e-4, 4
#: Part of a variance that may be left to go where the number of iterations is used up, as the last steps shrink.
_NEARLY = 0.1
#: Points farther from the block than this, in units of its largest extent, begin anew.
_FAR = 10.0
#: Times that the robust start is made, each without the control that the one before has found wrong.
_AGAIN = 3
#: Iterations after which it is looked whether rays of points are parallel.
_LOOK = 5
#: Rounds of data snooping, and of variance components.
_ROUNDS, _COMPONENTS = 8, 6
#: Whole steps that may make things worse for once: a block that turns as a whole cannot avoid it, since the step is
#: straight and its way is not. What they led to counts only if it is better in the end.
_PATIENCE = 4
#: Steps within which it has to be better, else the best state is taken up again, with damped steps alone.
_AWAY = 8
#: Damping (part of the diagonal) after a step that made things worse, and when to give up.
_FIRST_DAMPING, _MOST_DAMPING = 1e-12, 1e6


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
    loop = _Loop(settings.iterations, progress or (lambda number, rms: None))
    active = Active.all_of(block)
    alternative: tuple[str, ...] = ()
    selection, XYZ, lost = _selected(block, active, frozenset(), wait=settings.robust)
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
        if not settings.robust or turn == _ROUNDS - 1:
            break
        judged = solution.judged()
        next_active = snooped(model, state, judged, active, settings.critical)
        next_active, alternative = judged_control(model, state, next_active, judged.scales, settings.critical)
        if next_active.equals(active):
            break
        active = next_active
    weighted = _weighted(loop, solution, active, settings)
    check_rank(model, weighted.solution.state, weighted.solution.reduced)
    return replace(result_of(block, selection, weighted, active, loop.count), other_control=alternative)


def _weighted(loop: _Loop, solution: Solution, active: Active, settings: AdjustSettings) -> Weighted:
    """The solution with the accuracies that residuals show: variance components, and correlated image points."""
    model, state = solution.model, solution.state
    correlations: tuple[Correlation, ...] = ()
    if settings.correlation and settings.covariance:
        image = model.parts.image
        used = solution.weight[image][::2] > 0
        correlations = correlation_of(model, solution.normalised()[image].reshape(-1, 2), used)
    effects = effects_of_rows(model, correlations, len(solution.e)) if correlations else None
    factors: _Floats | None = None
    for _ in range(_COMPONENTS):
        if settings.variance_components and settings.covariance:
            factors = solution.trusted(solution.factors(factors))
        elif effects is None:
            break
        weight = weights_of(model, active, factors)
        state = loop.run(model, state, weight if effects is None else weight / effects)
        solution = solution_of(model, state, weight, settings.covariance, effects)
        if factors is None or np.allclose(solution.trusted(solution.factors(factors)), factors, rtol=0.02):
            break
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


class _Loop:
    """Iterations to the minimum; counts them over all rounds."""

    def __init__(self, most: int, progress: Progress) -> None:
        self.count = 0
        self._most, self._progress = most, progress
        self._watch, self._loose = False, frozenset[str]()

    def watched(self, model: Model, state: State, base: _Floats) -> tuple[State, frozenset[str]]:
        """As `run`, but stopped where the rays of points turn out to be parallel: these points are handed back."""
        self._watch, self._loose = True, frozenset()
        try:
            state = self.run(model, state, base)
        finally:
            self._watch = False
        if not self._loose:
            e = whitened(model, residuals_of(model, state))
            behind = np.flatnonzero(~np.isfinite(e[model.parts.image][::2]) & (base[model.parts.image][::2] > 0))
            self._loose = frozenset(model.point_names[k] for k in model.point[behind])
            rows, _ = linearise(model, state, np.sqrt(np.where(np.isfinite(e), base, 0.0)))
            self._loose |= loose_points(model, state, rows)
        return state, self._loose

    def run(self, model: Model, state: State, base: _Floats, robust: bool = False) -> State:
        """The state where the sum of squares with weights `base` (rows,) is least (Levenberg–Marquardt)."""
        if robust:
            base = base * softened(model, state)
        damping, cost = 0.0, np.inf
        patience, best, least, gains = _PATIENCE, state, np.inf, [np.inf] * _FLAT_STEPS
        due, away = False, 0
        for turn in range(self._most):
            e = whitened(model, residuals_of(model, state))
            weight = base * robust_weights(model, e * np.sqrt(base), turn) if robust else base
            weight = np.where(np.isfinite(e), weight, 0.0)
            before = _cost(e, weight)
            away += 1
            if before <= least:
                best, least, away = state, before, 0
            elif (patience == 0 or away > _AWAY) and patience >= 0 and not robust:
                state, patience, damping = best, -1, _FIRST_DAMPING
                continue
            rows, _ = linearise(model, state, np.sqrt(weight))
            due |= self._watch and turn % _LOOK == _LOOK - 1
            # Not in the middle of steps that made things worse: rays are parallel there that are not.
            if due and state is best:
                due = False
                self._loose = loose_points(model, state, rows)
                if self._loose:
                    return state
            while True:
                reduced = reduce_normals(rows, len(model.point_names), damping)
                step, points = reduced.solved(model, state)
                moved = state.moved(model.columns, step, along_rays(model, state, points))
                after = _cost(whitened(model, residuals_of(model, moved)), weight)
                if after <= before * (1.0 + 1e-9) + 1e-12:
                    break
                if patience > 0 and damping == 0.0 and after < np.inf:
                    patience -= 1
                    break
                damping = max(10.0 * damping, _FIRST_DAMPING)
                if damping > _MOST_DAMPING:
                    raise GeometryError(
                        "the adjustment does not converge: no step makes the residuals smaller. Are start "
                        "orientations, image points and control of the same block?"
                    )
            damping = 0.0 if damping <= _FIRST_DAMPING else damping / 10.0
            state = moved
            self.count += 1
            self._progress(self.count, float(np.sqrt(after / max(1.0, float((weight > 0).sum())))))
            largest = float(np.abs(step / reduced.scale).max()) if len(step) else 0.0
            settled = abs(cost - after) <= _SETTLED * after or after < 1e-18 * len(e)
            variance = after / max(1.0, float((weight > 0).sum()) - model.columns.count - 3 * len(model.point_names))
            gains = [*gains[1:], abs(before - after) / max(variance, 1e-300)]
            # A damped step is short for that reason alone, unless rounding is all that is left.
            ended = (damping == 0.0 and (largest < _CONVERGED or settled)) or largest < _ROUNDING or max(gains) < _FLAT
            if ended and not robust:
                if after <= least * (1.0 + 1e-9) + 1e-12 or patience < 0:
                    return state
                away = _AWAY
            if robust and turn >= _LEAST and largest < _ROUGHLY:
                return state
            cost = after
        if robust or _left(gains) < _NEARLY:
            return state
        raise GeometryError(
            f"the adjustment has not converged after {self._most} iterations (largest step {largest:.2g} standard "
            "deviations). Are the start orientations about right, and all free parameters determined? Images that have "
            "no start orientation are oriented from control and tie points"
        )


def _left(gains: list[float]) -> float:
    """What steps to come may gain, if each is to the next as the last ones were; infinite where they do not shrink."""
    first, last = gains[0], gains[-1]
    ratio = (last / first) ** (1.0 / (len(gains) - 1)) if 0.0 < last < first < np.inf else 1.0 - (last == 0.0)
    return last * ratio / (1.0 - ratio) if ratio < 1.0 else np.inf


def _cost(e: _Floats, weight: _Floats) -> float:
    """Weighted sum of squares; infinite when a point that counts has come behind a camera."""
    counted = weight > 0
    if not np.isfinite(e[counted]).all():
        return np.inf
    return float((weight[counted] * e[counted] ** 2).sum())

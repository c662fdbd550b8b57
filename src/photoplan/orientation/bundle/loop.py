"""Iterations of a bundle block adjustment to its least sum of squares, from start values that may be far off.

Steps are those of Levenberg and Marquardt, undamped as long as they help. Two things are particular to blocks. A block
that turns as a whole cannot avoid to get worse for a while, since a step is straight and its way is not: a few such
steps are let pass, and the best state is taken up again if they lead nowhere. And rays of a point may turn out to be
parallel on the way: then the points are handed back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.orientation.bundle.far import along_rays, loose_points
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.normal import reduce_normals
from photoplan.orientation.bundle.robust import robust_weights, softened
from photoplan.orientation.bundle.rows import Rows, linearise, residuals_of, whitened
from photoplan.orientation.bundle.unknowns import State

#: Called after each iteration: its number, and the root mean square of the weighted residuals.
Progress = Callable[[int, float], None]

_Floats = NDArray[np.float64]

#: Largest step at the end, in units of each unknown's own standard deviation (the others fixed).
_CONVERGED = 1e-3
_ROUNDING = 1e-6
#: The same for the robust start, and its least number of iterations.
_ROUGHLY, _LEAST = 0.5, 8
#: Largest relative change of the sum of squares at the end. Below _CONVERGED ** 2 variances it means nothing either: an
#: unknown that is off by the largest step makes as much, and rounding of large coordinates may make more than 1e-9.
_SETTLED = 1e-9
#: Damped steps are short for that reason alone. But where so many of them one after the other lower the sum of squares
#: by less than this part of a variance each, what is left to go means nothing: an unknown that is off by its whole
#: standard deviation makes one.
_FLAT, _FLAT_STEPS = 1e-4, 4
#: Part of a variance that may be left to go where the number of iterations is used up, as the last steps shrink.
_NEARLY = 0.1
#: Iterations after which it is looked whether rays of points are parallel.
_LOOK = 5
#: Whole steps that may make things worse for once, and steps within which it has to be better than ever.
_PATIENCE, _AWAY = 4, 8
#: Damping (part of the diagonal) after a step that made things worse, and when to give up.
_FIRST_DAMPING, _MOST_DAMPING = 1e-12, 1e6


class Loop:
    """Iterations to the minimum; counts them over all rounds of an adjustment."""

    def __init__(self, most: int, progress: Progress) -> None:
        self.count = 0
        self._most, self._progress = most, progress

    def watched(self, model: Model, state: State, base: _Floats) -> tuple[State, frozenset[str]]:
        """As `run`, but stopped where the rays of points turn out to be parallel: these points are handed back."""
        watch = _Watch()
        state = self.run(model, state, base, watch=watch)
        if watch.loose:
            return state, watch.loose
        e = whitened(model, residuals_of(model, state))
        behind = np.flatnonzero(~np.isfinite(e[model.parts.image][::2]) & (base[model.parts.image][::2] > 0))
        rows, _ = linearise(model, state, np.sqrt(np.where(np.isfinite(e), base, 0.0)))
        return state, frozenset(model.point_names[k] for k in model.point[behind]) | loose_points(model, state, rows)

    def run(
        self, model: Model, state: State, base: _Floats, robust: bool = False, watch: _Watch | None = None
    ) -> State:
        """The state where the sum of squares with weights `base` (rows,) is least."""
        if robust:
            base = base * softened(model, state)
        descent, cost, gains = _Descent(model, state), np.inf, [np.inf] * _FLAT_STEPS
        for turn in range(self._most):
            e = whitened(model, residuals_of(model, state))
            weight = base * robust_weights(model, e * np.sqrt(base), turn) if robust else base
            weight = np.where(np.isfinite(e), weight, 0.0)
            before = _cost(e, weight)
            redundancy = max(1.0, float((weight > 0).sum()) - model.columns.count - 3 * len(model.point_names))
            if descent.leads_nowhere(state, before) and not robust:
                state = descent.taken_up()
                continue
            rows, _ = linearise(model, state, np.sqrt(weight))
            # Not in the middle of steps that made things worse: rays are parallel there that are not.
            if watch is not None and watch.stops(turn, model, state, rows, calm=state is descent.best):
                return state
            step = descent.step(state, rows, weight, before, redundancy)
            state, after = step.state, step.cost
            self.count += 1
            self._progress(self.count, float(np.sqrt(after / max(1.0, float((weight > 0).sum())))))
            variance = after / redundancy
            gains = [*gains[1:], abs(before - after) / max(variance, 1e-300)]
            if robust:
                if turn >= _LEAST and step.largest < _ROUGHLY:
                    return state
            elif step.ends(abs(cost - after) <= _SETTLED * after or after < 1e-18 * len(e), max(gains)):
                if descent.is_least(after, redundancy):
                    return state
                descent.go_back()
            cost = after
        if robust or _left(gains) < _NEARLY:
            return state
        raise GeometryError(
            f"the adjustment has not converged after {self._most} iterations (largest step {step.largest:.2g} standard "
            "deviations). Are the start orientations about right, and all free parameters determined? Images that have "
            "no start orientation are oriented from control and tie points"
        )


class _Watch:
    """Looks now and then whether the rays of points are parallel."""

    def __init__(self) -> None:
        self.loose: frozenset[str] = frozenset()
        self._due = False

    def stops(self, turn: int, model: Model, state: State, rows: Rows, calm: bool) -> bool:
        """Whether points have been found that rays do not determine; `calm`: it may be looked now."""
        self._due |= turn % _LOOK == _LOOK - 1
        if not (self._due and calm):
            return False
        self._due = False
        self.loose = loose_points(model, state, rows)
        return bool(self.loose)


@dataclass(frozen=True, eq=False)
class _Step:
    """Where a step has led."""

    state: State
    cost: float
    largest: float
    """Largest component in units of each unknown's own standard deviation."""
    damped: bool

    def ends(self, settled: bool, gain: float) -> bool:
        """Whether it is the last one; `settled`: the sum of squares is, `gain`: the largest of the last steps."""
        # A damped step is short for that reason alone, unless rounding is all that is left.
        short = self.largest < _CONVERGED or settled
        return (not self.damped and short) or self.largest < _ROUNDING or gain < _FLAT


class _Descent:
    """Damping of steps, the best state so far, and for how long it may be left."""

    def __init__(self, model: Model, start: State) -> None:
        self._model, self._damping = model, 0.0
        self.best, self._least = start, np.inf
        self._patience, self._away = _PATIENCE, 0
        self._gone_back = False

    def leads_nowhere(self, state: State, cost: float) -> bool:
        """Keep a state if it is the best one; whether steps that made things worse have come to nothing."""
        self._away += 1
        if cost <= self._least:
            self.best, self._least, self._away = state, cost, 0
            return False
        return not self._gone_back and (self._patience == 0 or self._away > _AWAY)

    def taken_up(self) -> State:
        """The best state again, from which damped steps alone go on."""
        self._gone_back, self._damping, self._patience = True, _FIRST_DAMPING, 0
        return self.best

    def is_least(self, cost: float, redundancy: float) -> bool:
        """Whether an end with this sum of squares counts: it is the best one, or no other way is left."""
        return self._gone_back or _is_no_more(cost, self._least, redundancy)

    def go_back(self) -> None:
        """Take up the best state next, unless the state at hand is better."""
        self._away = _AWAY

    def step(self, state: State, rows: Rows, weight: _Floats, before: float, redundancy: float) -> _Step:
        """A step that lowers the sum of squares, damped until it does; a whole one may raise it for once."""
        model = self._model
        while True:
            reduced = reduce_normals(rows, len(model.point_names), self._damping)
            moves, points = reduced.solved(model, state)
            moved = state.moved(model.columns, moves, along_rays(model, state, points))
            after = _cost(whitened(model, residuals_of(model, moved)), weight)
            if _is_no_more(after, before, redundancy):
                break
            if self._patience > 0 and self._damping == 0.0 and after < np.inf:
                self._patience -= 1
                break
            self._damping = max(10.0 * self._damping, _FIRST_DAMPING)
            if self._damping > _MOST_DAMPING:
                raise GeometryError(
                    "the adjustment does not converge: no step makes the residuals smaller. Are start "
                    "orientations, image points and control of the same block?"
                )
        self._damping = 0.0 if self._damping <= _FIRST_DAMPING else self._damping / 10.0
        largest = float(np.abs(moves / reduced.scale).max()) if len(moves) else 0.0
        return _Step(moved, after, largest, self._damping > 0.0)


def _is_no_more(after: float, before: float, redundancy: float) -> bool:
    """Whether a sum of squares is no larger than another, but for what means nothing."""
    return after <= before + max(_SETTLED, _CONVERGED**2 / redundancy) * before + 1e-12


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

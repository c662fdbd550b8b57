"""Least squares of equations that are not linear: Gauss-Newton steps, damped where they lead upwards."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.linear import Decomposed

_Floats = NDArray[np.float64]
State = TypeVar("State")

#: Largest step at the end, in units of each unknown's own standard deviation (the others fixed). The one rule of all
#: iterations of this package: what is left to go then is small against what is known, whatever the unknown's unit.
CONVERGED = 1e-3
#: Damping (part of the diagonal) after a step that made things worse, and when to give up.
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e6
#: Part of the first sum of squares that is no more than rounding.
_NOTHING = 1e-26


@dataclass(frozen=True, eq=False)
class Equations(Generic[State]):
    """Linearised equations at a state: residual + A · step."""

    state: State
    A: _Floats
    """(n, u)."""
    v: _Floats
    """Computed minus observed, (n,), both divided by standard deviations where these differ."""

    @property
    def square(self) -> float:
        """Sum of squares; infinite where a residual is not finite."""
        square = float(self.v @ self.v)
        return square if math.isfinite(square) else math.inf

    @property
    def redundancy(self) -> int:
        """Equations minus unknowns, at least 1."""
        return max(len(self.v) - self.A.shape[1], 1)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight."""
        return math.sqrt(self.square / self.redundancy)

    def cofactors(self) -> _Floats | None:
        """Inverse normal equations (u, u); None: the unknowns are not determined."""
        parts = Decomposed.of(self.A)
        return parts.cofactors if parts.rank == self.A.shape[1] else None


def levenberg(
    start: State,
    equations: Callable[[State], tuple[_Floats, _Floats] | None],
    moved: Callable[[State, _Floats], State | None],
    most: int = 25,
) -> Equations[State]:
    """The state with the least sum of squares near a start (Levenberg 1944, Marquardt 1963)."""
    first = equations(start)
    assert first is not None
    now = Equations(start, *first)
    nothing, damping = _NOTHING * now.square, 0.0
    parts = Decomposed.of(now.A)
    for _ in range(most if math.isfinite(now.square) else 0):
        step = -parts.back(parts.along(now.v), damping)
        state = moved(now.state, step)
        found = None if state is None else equations(state)
        trial = None if state is None or found is None else Equations(state, *found)
        small = float(np.abs(step * parts.length).max(initial=0.0)) <= CONVERGED * now.sigma0
        if trial is not None and trial.square <= now.square * (1.0 + 1e-9):
            now = trial
            if now.square <= nothing or (small and damping <= FIRST_DAMPING):
                break
            damping = damping / 10.0 if damping > 1e-9 else 0.0
            parts = Decomposed.of(now.A)
            continue
        damping = max(10.0 * damping, FIRST_DAMPING)
        if damping > MOST_DAMPING or (small and damping <= FIRST_DAMPING):
            break
    return now


def by_differences(values: Callable[[_Floats], _Floats], at: _Floats, step: ArrayLike) -> _Floats:
    """Derivatives of values (n,) by unknowns (u,), shape (n, u): central differences with a step, or one for each."""
    steps = np.broadcast_to(np.asarray(step, float), at.shape)
    ends = [(values(at + move), values(at - move)) for move in np.diag(steps)]
    found = [(up - down) / (2.0 * h) for (up, down), h in zip(ends, steps)]
    return np.stack(found, axis=-1) if found else np.empty((len(values(at)), 0))

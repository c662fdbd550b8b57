"""What an automatic gain control does after a step of brightness (Behr 1989, §4.2.5, fig. 4.17)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.chances import chance_f, chance_normal
from photoplan.errors import InputError
from photoplan.quality.camera.approach import LEAST_VALUES, Approach, check_times, fit_approach

Array = NDArray[np.float64]

#: Frames before the step below which nothing is said about the noise there.
LEAST_BEFORE = 3
#: A step is this many times larger than anything else between two frames.
_CLEAR = 3.0


@dataclass(frozen=True)
class NoiseChange:
    """Noise of single frames before the step and after it."""

    before: float | None
    """Standard deviation of one frame's mean grey value; None: too few frames."""
    after: float
    """The same about the curve that the values follow after the step."""
    probability: float | None
    """Chance that equal noise gives a ratio as far from 1 (F-test, two-sided)."""


@dataclass(frozen=True, eq=False)
class GainControl:
    """A transition, and what the camera does to the grey values after it though the scene is the same."""

    name: str
    step_time: float
    """Time of the first frame after the step, seconds."""
    direction: str
    """`bright to dark` or `dark to bright`."""
    before: float
    """Mean grey value before the step."""
    sigma_before: float | None
    approach: Approach
    """Grey values after the step: `change` is what the control adds, with sign."""
    noise: NoiseChange
    first: int
    """Index of the first frame after the step."""
    times: Array
    values: Array

    @property
    def step(self) -> float:
        """Grey values from before the step to right after it."""
        right_after = self.approach.start if self.approach.start is not None else float(self.values[self.first])
        return right_after - self.before

    @property
    def share(self) -> float | None:
        """The change as part of the step, negative where the control works against it; None: no change known."""
        return None if self.approach.change is None else self.approach.change / self.step


@dataclass(frozen=True)
class Asymmetry:
    """Whether the control works by the same amount after both transitions."""

    difference: float
    """Size of the change after bright to dark minus that after dark to bright, grey values."""
    sigma: float
    probability: float
    """Chance that equal changes differ as much."""


def gain_control(times: Array, values: Array, *, step_time: float | None = None, name: str = "series") -> GainControl:
    """Follow the grey values after a step of brightness.

    The scene is the same in all frames after the step, so a change of the grey values is the camera's.
    """
    t, y = check_times(times, name), np.asarray(values, float)
    if y.shape != t.shape or not np.isfinite(y).all():
        raise InputError(f"{name}: {y.size} finite grey values at {t.size} times are needed, one per frame")
    first = _first_after(t, y, step_time, name)
    if len(y) - first < LEAST_VALUES:
        raise InputError(
            f"{name}: {len(y) - first} frames after the step; at least {LEAST_VALUES} are needed to follow the control"
        )
    approach = fit_approach(t[first:], y[first:], what=f"{name} after the step")
    ahead = y[:first]
    before = float(ahead.mean())
    spread = float(ahead.std(ddof=1)) if first >= LEAST_BEFORE else None
    after = approach.start if approach.start is not None else float(y[first])
    direction = "bright to dark" if after < before else "dark to bright"
    sigma_before = None if spread is None else spread / math.sqrt(first)
    noise = NoiseChange(spread, approach.rms, _ratio_test(spread, first - 1, approach))
    return GainControl(
        name=name,
        step_time=float(t[first]),
        direction=direction,
        before=before,
        sigma_before=sigma_before,
        approach=approach,
        noise=noise,
        first=first,
        times=t,
        values=y,
    )


def compare_transitions(dark: GainControl, bright: GainControl) -> Asymmetry:
    """Compare the change after bright to dark with that after dark to bright; no significant change counts as none."""
    sizes, variances = [], []
    for one in (dark, bright):
        a = one.approach
        if a.change is None and a.significant:
            raise InputError(f"{one.name}: {a.verdict}; the size of its change is not known and cannot be compared")
        sizes.append(abs(a.change) if a.change is not None else 0.0)
        # A change that was not seen is none, to within what the mean of the frames would show.
        none = a.rms * math.sqrt(2.0 / (a.redundancy + 1))
        variances.append((a.sigma_change if a.sigma_change is not None else none) ** 2)
    difference, sigma = sizes[0] - sizes[1], math.sqrt(sum(variances))
    probability = chance_normal(difference / sigma) if sigma > 0.0 else float(difference == 0.0)
    return Asymmetry(difference, sigma, probability)


def _first_after(t: Array, y: Array, step_time: float | None, name: str) -> int:
    if step_time is not None:
        first = int(np.searchsorted(t, step_time))
        if not 0 < first < len(t):
            raise InputError(
                f"{name}: the step at {step_time:g} s leaves {first} frames before and {len(t) - first} after it; "
                f"the frames run from {t[0]:g} to {t[-1]:g} s"
            )
        return first
    if len(y) < LEAST_VALUES + 1:
        raise InputError(f"{name}: {len(y)} frames; at least {LEAST_VALUES} after the step and one before are needed")
    jumps = np.abs(np.diff(y))
    k = int(jumps.argmax())
    rest = float(np.delete(jumps, k).max())
    if not jumps[k] > _CLEAR * rest:
        raise InputError(
            f"{name}: no step stands out: the largest difference of two frames is {jumps[k]:.1f} grey values, the next "
            f"{rest:.1f}; state the time of the step"
        )
    return k + 1


def _ratio_test(spread: float | None, redundancy: int, approach: Approach) -> float | None:
    if spread is None or not (spread > 0.0 and approach.rms > 0.0):
        return None
    one = chance_f((spread / approach.rms) ** 2, redundancy, approach.redundancy)
    return 2.0 * min(one, 1.0 - one)

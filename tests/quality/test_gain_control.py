"""Automatic gain control after a step (Behr 1989, §4.2.5): size, time constant, asymmetry, noise."""

from __future__ import annotations

import numpy as np
import pytest
from tools.thinned import thinned

from photoplan.errors import InputError
from photoplan.quality.camera.drift import fit_settling
from photoplan.quality.camera.video import compare_transitions, gain_control

TIMES = np.arange(80) * 0.2
STEP = 4.0
AFTER = np.clip(TIMES - STEP, 0.0, None)


def transition(
    seed: int, before: float, after: float, change: float, tau: float = 2.0, noise: tuple[float, float] = (0.5, 0.5)
) -> np.ndarray:
    y = np.where(TIMES < STEP, before, after + change * (1 - np.exp(-AFTER / tau)))
    return y + np.random.default_rng(seed).normal(0, np.where(TIMES < STEP, noise[0], noise[1]))


@thinned("runs", 100, 200)
def test_17_grey_values_after_bright_to_dark_are_recovered(runs: int) -> None:
    """Behr: about 17 grey values after a step from bright to dark; hardly any after one from dark to bright."""
    sizes, constants = [], []
    for seed in range(runs):
        found = gain_control(TIMES, transition(seed, 160, 60, 17.0))
        assert found.direction == "bright to dark" and found.approach.significant
        a = found.approach
        assert a.change is not None and a.sigma_change is not None and a.time_constant is not None
        assert a.sigma_time_constant is not None
        sizes.append((a.change - 17.0) / a.sigma_change)
        constants.append((a.time_constant - 2.0) / a.sigma_time_constant)
    print(
        f"\n{a.change:.2f} ± {a.sigma_change:.2f}, τ {a.time_constant:.2f} ± {a.sigma_time_constant:.2f}; normalised "
    )
    print(f"change {np.std(sizes):.3f}, time constant {np.std(constants):.3f}")
    for errors in (sizes, constants):
        assert 0.9 < np.sqrt(np.mean(np.square(errors))) < 1.1
    assert found.share == pytest.approx(-0.17, abs=0.01)


@thinned("runs", 30, 300)
def test_no_change_is_no_number(runs: int) -> None:
    """Noise alone is called a change in less than 2 % of the cases; what is not significant has no size."""
    alarms = 0
    for seed in range(runs):
        found = gain_control(TIMES, transition(seed, 60, 160, 0.0))
        alarms += found.approach.significant
        if not found.approach.significant:
            assert found.approach.change is None and "no significant" in found.approach.verdict
    print(f"\nfalse alarms: {alarms} of {runs}")
    assert alarms <= 0.02 * runs


def test_asymmetry_of_the_transitions() -> None:
    dark = gain_control(TIMES, transition(1, 160, 60, 17.0))
    bright = gain_control(TIMES, transition(2, 60, 160, 0.0))
    found = compare_transitions(dark, bright)
    assert found.difference == pytest.approx(17.0, abs=0.5) and found.probability < 1e-6
    same = gain_control(TIMES, transition(3, 60, 160, -17.0))
    assert compare_transitions(dark, same).probability > 0.01


def test_noise_before_and_after() -> None:
    found = gain_control(TIMES, transition(4, 160, 60, 17.0, noise=(0.3, 1.2)))
    assert found.noise.before == pytest.approx(0.3, rel=0.4) and found.noise.after == pytest.approx(1.2, rel=0.2)
    assert found.noise.probability is not None and found.noise.probability < 1e-4
    even = gain_control(TIMES, transition(5, 160, 60, 17.0))
    assert even.noise.probability is not None and even.noise.probability > 0.01


def test_step_is_found_or_given() -> None:
    y = transition(6, 160, 60, 17.0)
    assert gain_control(TIMES, y).first == gain_control(TIMES, y, step_time=4.0).first == 20


@pytest.mark.parametrize(("tau", "words"), [(0.02, "too fast"), (60.0, "too short")])
def test_time_constants_out_of_reach_are_said(tau: float, words: str) -> None:
    t = np.arange(60) * 0.2
    y = 60 + 50 * (1 - np.exp(-t / tau)) + np.random.default_rng(7).normal(0, 0.3, 60)
    found = fit_settling(t, y)
    assert words in found.verdict and found.change is None and found.time_constant is None


def test_bad_series_are_refused_in_words() -> None:
    y = transition(8, 160, 60, 17.0)
    with pytest.raises(InputError, match="no step stands out"):
        gain_control(TIMES, np.random.default_rng(9).normal(100, 1, 80))
    with pytest.raises(InputError, match="leaves 0 frames before"):
        gain_control(TIMES, y, step_time=-1.0)
    with pytest.raises(InputError, match="5 frames after"):
        gain_control(TIMES[:25], y[:25])
    with pytest.raises(InputError, match="does not come after"):
        gain_control(TIMES[::-1], y)

"""The factor of standard deviations is found from what was held out, and nothing is made of what says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from photoplan.terrain.fit import KNOTS, NONE, HeldOut, Surroundings, calibrate, joined, signal_share

LINE = 0.5
"""On lines, errors are so much larger."""


def held_out(factor: NDArray[np.float64], noise: float, seed: int, count: int = 3000) -> HeldOut:
    """Errors that are as many times larger than stated as the factor says (at the knots), in blocks of five."""
    rng = np.random.default_rng(seed)
    distance = np.exp(rng.uniform(np.log(KNOTS[0]), np.log(KNOTS[-1]), count))
    sigma = 0.1 * distance**0.5
    rough = rng.lognormal(0, 0.5, count)
    beside = rng.uniform(0, 1, count)
    true = sigma * np.interp(np.log(distance), np.log(KNOTS), factor) * np.sqrt(rough) * (1 + LINE * beside)
    error = true * rng.normal(size=count) + rng.normal(0, noise, count)
    every = np.ones(count)
    block = np.arange(count) // 5
    around = Surroundings(signal_share(sigma, noise), distance, beside, rough)
    return HeldOut(error, sigma, noise**2 * every, around, block, rng.uniform(size=count))


def at_knots(noise: float, beside: float = 0.0) -> Surroundings:
    every = np.ones(len(KNOTS))
    return Surroundings(signal_share(0.1 * KNOTS**0.5, noise), KNOTS, beside * every, every)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_factor_that_grows_with_distance_is_found(noise: float) -> None:
    factor = np.array([1.0, 1.3, 1.6, 1.9, 2.2])
    held = held_out(factor, noise, 1)
    found = calibrate(held)
    np.testing.assert_allclose(found.factor(at_knots(noise)), factor, rtol=0.15)
    np.testing.assert_allclose(found.factor(at_knots(noise, beside=1.0)), factor * (1 + LINE), rtol=0.2)
    assert found.coefficients[-1] == pytest.approx(1.0, abs=0.2)
    for figures in found.classes:
        assert figures.before > 1.05 and figures.after == pytest.approx(1.0, abs=0.1)


def test_nothing_is_made_of_errors_that_noise_hides() -> None:
    """Surfaces known ten times better than points, noise stated 10 % too large: no factor of one half follows."""
    held = held_out(np.ones(5), 0.02, 2)
    held = replace(held, sigma=held.sigma / 50, error=np.random.default_rng(3).normal(0, 0.018, len(held.error)))
    around = replace(held.around, signal=signal_share(held.sigma, 0.02), rough=np.ones(3000))
    np.testing.assert_allclose(calibrate(replace(held, around=around)).factor(around), 1.0, atol=0.03)


def test_few_blocks_change_little_and_none_nothing() -> None:
    held = held_out(np.ones(5), 0.0, 4, count=10)
    held = replace(held, error=2 * held.sigma * np.sqrt(held.around.rough))
    assert 0 < calibrate(held).coefficients[:-1].max() < np.log(2)
    none = np.empty(0)
    assert calibrate(HeldOut(none, none, none, Surroundings(*[none] * 4), np.empty(0, np.int64), none)) is NONE
    np.testing.assert_allclose(NONE.factor(Surroundings(*[np.ones(2)] * 3, np.array([1.0, 4.0]))), [1.0, 2.0])


def test_blocks_of_several_rounds_stay_apart() -> None:
    held = held_out(np.ones(5), 0.0, 6, count=10)
    both = joined([held, held])
    assert np.unique(both.block).tolist() == [0, 1, 2, 3] and len(both.around.rough) == 20


def test_errors_where_the_ground_bends_are_told_apart() -> None:
    """Three times larger in the twentieth part that bends most: the class says so, which no distance tells."""
    held = held_out(np.ones(5), 0.0, 7)
    most = held.bend > 0.95
    found = calibrate(replace(held, error=np.where(most, 3.0, 1.0) * held.error))
    weak, _, strong = found.bends
    assert [round(c.furthest - c.nearest, 2) for c in found.bends] == [0.8, 0.15, 0.05]
    assert strong.enough and strong.after > 2.2 * weak.after and weak.after < 1.1
    assert max(c.after for c in found.classes) < 1.25


def test_one_blunder_among_the_held_out_does_not_decide() -> None:
    held = held_out(np.ones(5), 0.0, 5, count=400)
    error = held.error.copy()
    error[7] = 100.0
    spoiled = calibrate(replace(held, error=error)).coefficients
    np.testing.assert_allclose(spoiled, calibrate(held).coefficients, atol=0.2)

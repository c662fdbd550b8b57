"""Brightness drift: the figures of Behr's table 4.1, trend against noise."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.quality.camera.drift import brightness_drift

#: Behr 1989, table 4.1: mean, minimum, maximum, sigma, largest step of both cameras.
TABLE = {"left": (170.0, 163.8, 176.6, 2.1, 5.3), "right": (181.2, 178.6, 183.7, 2.0, 2.9)}


def minutes(n: int) -> np.ndarray:
    return np.arange(n) * 60.0


def test_figures_of_table_4_1_are_what_their_definitions_say() -> None:
    y = np.array([170.0, 171.5, 169.0, 174.3, 169.0, 170.5, 168.0, 170.0, 171.0, 170.2])
    found = brightness_drift(minutes(10), y)
    assert (found.mean, found.minimum, found.maximum) == (pytest.approx(170.35), 168.0, 174.3)
    assert found.sigma == pytest.approx(np.std(y, ddof=1))
    # From the third to the fourth, and from there to the fifth measurement; both are 5.3.
    assert found.largest_step == pytest.approx(5.3)


def test_printed_figures_of_table_4_1_agree_with_the_text() -> None:
    """Steps beyond five, range up to 13 (§4.2.4); no series exceeds range / 2 in sigma or its range in a step."""
    left, right = TABLE["left"], TABLE["right"]
    assert left[4] > 5 and round(left[2] - left[1]) == 13
    for mean, low, high, sigma, step in (left, right):
        assert low < mean < high and sigma <= (high - low) / 2 and step <= high - low
    # White noise of the left camera's sigma would make its largest of some 300 steps about 3 · √2 σ = 8.9: the printed
    # 5.3 shows that most of σ is drift.
    rng = np.random.default_rng(1)
    steps = [np.abs(np.diff(rng.normal(0, left[3], 300))).max() for _ in range(200)]
    assert np.mean(np.array(steps) > left[4]) > 0.99


def test_noise_and_drift_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    called_noise = sum(not brightness_drift(minutes(200), 170 + rng.normal(0, 2, 200)).drifts for _ in range(300))
    print(f"\nwhite noise called drift in {300 - called_noise} of 300")
    assert 300 - called_noise <= 9
    walk = 170 + np.cumsum(rng.normal(0, 0.5, 200)) + rng.normal(0, 1, 200)
    found = brightness_drift(minutes(200), walk)
    assert found.drifts and found.long_sigma > found.short_sigma
    # Successive differences hold the noise and one step of the walk.
    assert found.short_sigma == pytest.approx(np.sqrt(1 + 0.25 / 2), rel=0.15)


@pytest.mark.parametrize("correlated", [0.0, 0.8])
def test_trend_with_true_standard_deviation(correlated: float) -> None:
    rng = np.random.default_rng(3)
    errors, seen = [], 0
    for _ in range(300):
        noise = rng.normal(0, 1, 300)
        for k in range(1, 300):
            noise[k] += correlated * noise[k - 1]
        found = brightness_drift(minutes(300), 150 + 0.4 * minutes(300) / 3600 + noise)
        errors.append((found.trend - 0.4) / found.sigma_trend)
        seen += found.has_trend
    print(
        f"\ncorrelation {correlated}: normalised errors of the trend {np.std(errors):.3f}, significant in {seen} of 300"
    )
    assert 0.9 < np.sqrt(np.mean(np.square(errors))) < 1.1


def test_structure_function_and_allan_deviation() -> None:
    rng = np.random.default_rng(4)
    white = brightness_drift(minutes(2000), rng.normal(100, 2, 2000)).variation
    np.testing.assert_allclose(white.structure, 2.0, rtol=0.06)
    m = white.lapse / 60.0
    np.testing.assert_allclose(white.allan[:6], 2.0 / np.sqrt(m[:6]), rtol=0.12)
    ramp = brightness_drift(minutes(500), 0.01 * np.arange(500) + rng.normal(0, 1e-6, 500)).variation
    np.testing.assert_allclose(ramp.structure, 0.01 * ramp.lapse / 60.0 / np.sqrt(2), rtol=1e-3)


def test_uneven_times_have_no_allan_deviation() -> None:
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(10, 100, 200))
    v = brightness_drift(t, rng.normal(100, 2, 200)).variation
    assert np.isnan(v.allan).all() and np.isfinite(v.structure).all()


def test_bad_series_are_refused_in_words() -> None:
    y = np.random.default_rng(6).normal(100, 1, 30)
    with pytest.raises(InputError, match="9 measurements; at least 10"):
        brightness_drift(minutes(9), y[:9])
    with pytest.raises(InputError, match="does not come after"):
        brightness_drift(minutes(30)[::-1], y)
    t = minutes(30)
    t[4] = np.nan
    with pytest.raises(InputError, match="measurement 5 has no time"):
        brightness_drift(t, y)
    with pytest.raises(InputError, match="exactly 255"):
        brightness_drift(minutes(30), np.full(30, 255.0))
    y[3] = np.nan
    with pytest.raises(InputError, match="finite"):
        brightness_drift(minutes(30), y)

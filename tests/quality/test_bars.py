"""Bar patterns: known transfer recovered at any angle, phase and duty; modulation; Coltman's series; refusals."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from tools.patterns import bars, gauss_box, star
from tools.thinned import some, thinned

from photoplan.errors import InputError
from photoplan.quality.curves import MtfCurve
from photoplan.quality.patterns.bars import bar_curve, clipped_pixels, coltman_factor, coltman_mtf, measure_bars

SIGMA, LEVELS = 0.6, (40.0, 200.0)
TRANSFER = gauss_box(SIGMA)


def noisy(frequency, angle, seed=0, noise=2.0, **options):
    picture = bars((60, 80), frequency, angle, SIGMA, **options)
    return picture + np.random.default_rng(seed).normal(0.0, noise, picture.shape)


def square_contrast(frequency, angle):
    """Contrast of equal bars: the sum of their harmonic waves in the middle of a bar."""
    turn = np.deg2rad(angle)
    fx, fy = frequency * np.cos(turn), frequency * np.sin(turn)
    k = np.arange(1, 60, 2)
    return float(np.sum(4 / (pi * k) * np.sin(pi * k / 2) * TRANSFER(k * fx, k * fy)))


@pytest.mark.parametrize("duty", [0.5, 0.4])
@pytest.mark.parametrize("angle", some([3.0, 20.0, 37.0, 71.0, 120.0, 164.0], 0, 2, 4))
def test_mtf_of_any_direction_within_one_percent_at_a_signal_to_noise_ratio_of_80(angle, duty):
    worst = 0.0
    for k, frequency in enumerate((0.08, 0.15, 0.25, 0.33, 0.45)):
        phase = float(np.random.default_rng(k).uniform(-0.5, 0.5))
        group = measure_bars(noisy(frequency, angle, k, phase=phase, duty=duty))
        curve = bar_curve([group], LEVELS)
        turn = np.deg2rad(angle)
        true = float(TRANSFER(frequency * np.cos(turn), frequency * np.sin(turn)))
        worst = max(worst, abs(curve.mtf.modulation[1] / true - 1.0))
        assert group.frequency == pytest.approx(frequency, abs=1e-4)
        assert group.angle_deg == pytest.approx(angle, abs=0.05)
        assert group.phase == pytest.approx(phase, abs=3e-3)
        assert abs(curve.mtf.modulation[1] - true) < 4.0 * curve.mtf.sigma[1]
    print(f"largest error of the MTF at {angle}°, duty {duty}: {100 * worst:.2f} %")
    assert worst < 0.01


@pytest.mark.parametrize("angle", [0.0, 90.0])
@pytest.mark.parametrize("frequency", [0.08, 0.125, 0.25, 1 / 3, 0.4])
def test_bars_along_the_pixels_within_two_percent(frequency, angle):
    group = measure_bars(noisy(frequency, angle))
    curve = bar_curve([group], LEVELS)
    true = float(TRANSFER(frequency, 0.0))
    print(f"{frequency:.3f}: {curve.mtf.modulation[1]:.4f} ± {curve.mtf.sigma[1]:.4f}, true {true:.4f}")
    assert curve.mtf.modulation[1] == pytest.approx(true, rel=0.02)


@pytest.mark.parametrize("frequency", [0.06, 0.12, 0.2, 0.3, 0.42])
def test_contrast_transfer_is_that_of_square_waves(frequency):
    group = measure_bars(noisy(frequency, 20.0))
    curve = bar_curve([group], LEVELS)
    true = square_contrast(frequency, 20.0)
    print(f"{frequency}: CTF {curve.contrast.modulation[1]:.4f}, true {true:.4f}")
    assert curve.contrast.modulation[1] == pytest.approx(true, rel=0.01, abs=0.003)


def test_behr_section_3_6_7_modulation_of_wide_bars():
    # M = (Imax − Imin)/(Imax + Imin)
    group = measure_bars(noisy(0.04, 30.0))
    assert group.modulation == pytest.approx(160 / 240, rel=2e-3)
    assert (group.low, group.high, group.duty) == pytest.approx((40.0, 200.0, 0.5), rel=0.01)


def test_levels_come_from_the_widest_bars_and_slanting_light_is_divided_out():
    frequencies = (0.05, 0.15, 0.3, 0.44)
    light = 1.0 + 0.2 * (np.arange(80) / 79 - 0.5)[None, :]
    curve = bar_curve([measure_bars(noisy(f, 12.0, k, 1.0) * light) for k, f in enumerate(frequencies)])
    assert curve.levels_from.startswith("widest bars, 20.0 pixels")
    turn = np.deg2rad(12.0)
    for k, f in enumerate(frequencies):
        true = float(TRANSFER(f * np.cos(turn), f * np.sin(turn)))
        assert curve.mtf.modulation[k + 1] == pytest.approx(true, rel=0.015)


@thinned("count", 24, 60)
def test_standard_deviations_are_those_of_repetition(count):
    values, sigmas = [], []
    for seed in range(count):
        group = measure_bars(noisy(0.2, 25.0, seed, 6.0))
        values.append(group.fundamental)
        sigmas.append(group.fundamental_sigma)
    print(f"scatter {np.std(values):.5f}, stated {np.mean(sigmas):.5f}")
    assert np.std(values) == pytest.approx(np.mean(sigmas), rel=0.3)


def test_coltman_factors_of_the_printed_series():
    # Coltman 1954: +1, +1/3, −1/5, +1/7, 0, +1/11, −1/13, −1/15, −1/17, +1/19, …
    factors = [coltman_factor(k) for k in range(1, 20, 2)]
    assert factors == pytest.approx([1, 1 / 3, -1 / 5, 1 / 7, 0, 1 / 11, -1 / 13, -1 / 15, -1 / 17, 1 / 19])


def test_coltman_series_turns_contrast_into_mtf():
    frequency = np.linspace(0.0, 0.9, 181)
    contrast = np.array([1.0, *(square_contrast(f, 0.0) for f in frequency[1:])])
    mtf = coltman_mtf(MtfCurve(frequency, contrast))
    part = frequency <= 0.5
    true = TRANSFER(frequency[part], 0.0)
    # At frequency 0 the series converges slowly; 31 terms are used.
    error = np.abs(mtf.modulation[part] - true)[frequency[part] >= 0.02]
    print(f"largest error of Coltman's series: {error.max():.4f}")
    assert error.max() < 0.006


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (lambda: np.full((40, 40), 7.0), "no pattern"),
        (lambda: np.random.default_rng(0).normal(100, 5, (60, 60)), "no bars are found"),
        (lambda: noisy(0.02, 0.0), r"(no bars are found|periods of bars|more than bars)"),
        (lambda: bars((60, 80), 0.6, 10.0, 1.2) + np.random.default_rng(0).normal(0, 3, (60, 80)), "no bars are found"),
        (lambda: np.where(np.mgrid[:60, :80][1] > 41.3, 200.0, 40.0), r"(no bars|periods of bars|more than bars)"),
        (lambda: np.hstack([noisy(0.1, 5.0)[:, :40], noisy(0.23, 60.0)[:, :40]]), "more than bars"),
        (lambda: star((90, 90), (44.0, 45.0), 18), r"more than bars"),
        (lambda: np.where(np.mgrid[:50, :50][0] == 20, np.nan, 5.0), "50 of its pixels have no value"),
        (lambda: np.ones((6, 40)), "at least 12"),
        (lambda: np.ones((3, 20, 20)), "at least 12"),
        (lambda: bars((60, 60), 0.1, 5.0) - 300.0, "positive"),
    ],
)
def test_no_number_without_bars(picture, message):
    with pytest.raises(InputError, match=message):
        measure_bars(picture())


def test_clipped_bars_are_refused():
    picture = np.clip(np.round(noisy(0.06, 10.0) * 1.5), 0, 255).astype(np.uint8)
    with pytest.raises(InputError, match="saturated or clipped"):
        measure_bars(picture, clipped=clipped_pixels(picture))
    # Values of twelve bits in a type of sixteen, and floating point.
    for kind in (np.uint16, np.float32):
        picture = np.minimum(noisy(0.06, 10.0) * 20.0, 3700).astype(kind)
        with pytest.raises(InputError, match="saturated or clipped"):
            measure_bars(picture, clipped=clipped_pixels(picture))
    sound = noisy(0.06, 10.0).astype(np.float32)
    assert not clipped_pixels(sound).any()
    assert not clipped_pixels(np.round(bars((60, 80), 0.05, 10.0, 0.1)).astype(np.uint8)).any()


def test_full_contrast_has_to_be_known():
    with pytest.raises(InputError, match="no flat middle"):
        bar_curve([measure_bars(noisy(0.3, 10.0))])
    with pytest.raises(InputError, match="keep one"):
        bar_curve([measure_bars(noisy(0.05, 10.0))] * 2)
    with pytest.raises(InputError, match="no group"):
        bar_curve([])
    with pytest.raises(InputError, match="lower one"):
        bar_curve([measure_bars(noisy(0.3, 10.0))], (5.0, 4.0))


@thinned("series", 20, 40)
def test_standard_deviations_hold_the_error_of_the_object_s_contrast(series):
    """Of noisy bars, the widest of which tell the contrast: MTF and contrast transfer."""
    known = [measure_bars(bars((60, 80), f, 5.0, SIGMA)) for f in (0.05, 0.1)]
    truth = bar_curve(known)
    errors, sigmas = [], []
    for seed in range(series):
        groups = [measure_bars(noisy(f, 5.0, 100 * k + seed, 12.0)) for k, f in enumerate((0.05, 0.1))]
        curve, given = bar_curve(groups), bar_curve(groups, LEVELS)
        for found, right in ((curve.mtf, truth.mtf), (curve.contrast, truth.contrast)):
            errors.append(found.modulation[2] - right.modulation[2])
            sigmas.append(found.sigma[2])
        assert curve.mtf.sigma[2] > 1.1 * given.mtf.sigma[2]
    deviation = np.sqrt(np.mean((np.array(errors) / sigmas).reshape(-1, 2) ** 2, axis=0))
    print("errors in standard deviations:", deviation)
    assert deviation == pytest.approx([1.0, 1.0], abs=0.3)

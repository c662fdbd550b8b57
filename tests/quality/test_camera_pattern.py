"""Fixed pattern, defect elements and blooming recovered from a sensor whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from tools.camera_model import Sensor, gathered

from photoplan.errors import InputError
from photoplan.quality.camera.drift import find_blooming
from photoplan.quality.camera.sensor import (
    LINE_SHARE,
    WHITE_SHARE,
    background,
    find_blinking,
    find_defects,
    find_lines,
    high_pass,
    log_histogram,
    pattern_variance,
    prnu_percent,
    signed_root,
    spectrogram,
)

RUNS = 150


def stack_of(sensor, photons, frames, seed, exposure_ms=20.0):
    noise = np.random.default_rng(seed)
    return gathered((sensor.frame(photons, exposure_ms, noise) for _ in range(frames)), 2**sensor.bits - 1)


def pattern_of(stack, filtered=False):
    return pattern_variance(stack.mean, stack.level.temporal_variance, stack.level.frames, filtered=filtered)


def spread_of(normalised, what):
    value = float(np.sqrt(np.mean(np.square(normalised))))
    print(f"{what}: normalised errors spread {value:.3f} over {len(normalised)} runs (wanted 0.9 to 1.1)")
    return value


@pytest.mark.parametrize("filtered", [False, True])
def test_variances_of_rows_columns_and_pixels_come_back(filtered):
    noise = np.random.default_rng(0)
    sums = np.zeros(3)
    truth = np.array([4.0, 1.0, 9.0])
    for _ in range(40):
        image = 100 + 2 * noise.standard_normal((120, 1)) + noise.standard_normal((1, 150))
        image = image + 3 * noise.standard_normal((120, 150)) + 0.5 * noise.standard_normal((120, 150))
        found = pattern_variance(image, 1.0, 4, filtered=filtered)
        sums += (found.row, found.column, found.pixel)
    assert sums / 40 == pytest.approx(truth, rel=0.05)


def test_normalised_errors_of_dsnu_and_prnu_spread_by_one():
    dsnu, rows, prnu = [], [], []
    for run in range(RUNS):
        sensor = Sensor(shape=(90, 100), dsnu=6.0, dsnu_rows=3.0, prnu=0.02, seed=run + 1)
        dark = pattern_of(stack_of(sensor, 0, 4, run))
        bright = pattern_of(stack_of(sensor, 8000, 4, run + 5000))
        dsnu.append((dark.pixel - (0.4 * 6) ** 2) / dark.pixel_sigma)
        rows.append((dark.row - (0.4 * 3) ** 2) / dark.row_sigma)
        value, sigma = prnu_percent(bright, dark)
        prnu.append((value - 2.0) / sigma)
    for name, normalised in (("DSNU pixels", dsnu), ("DSNU rows", rows), ("PRNU", prnu)):
        assert 0.9 < spread_of(normalised, name) < 1.1
    assert abs(np.mean(prnu)) < 0.3


def test_high_pass_takes_uneven_light_out_and_leaves_white_noise():
    noise = np.random.default_rng(1)
    y, x = np.mgrid[0:200, 0:240]
    uneven = 1000 * np.cos(np.hypot(x - 120, y - 100) / 400) ** 4
    image = uneven * (1 + 0.01 * noise.standard_normal(uneven.shape))
    raw, even = (pattern_variance(image, 0.0, 2, filtered=f) for f in (False, True))
    truth = (0.01 * uneven).std() ** 2 + (0.01 * uneven).mean() ** 2
    assert even.total == pytest.approx(truth, rel=0.03)
    assert raw.total > 20 * even.total
    white = noise.standard_normal((400, 400))
    assert high_pass(white).var() / white.var() == pytest.approx(WHITE_SHARE, rel=0.01)
    lines = np.repeat(noise.standard_normal((4000, 1)), 50, axis=1)
    assert high_pass(lines).var() / lines.var() == pytest.approx(LINE_SHARE, rel=0.03)


def test_pattern_needs_frames_and_pixels():
    with pytest.raises(InputError, match="single frame"):
        pattern_variance(np.zeros((20, 20)), float("nan"), 1)
    with pytest.raises(InputError, match="16"):
        pattern_variance(np.zeros((10, 20)), 1.0, 2)
    with pytest.raises(InputError, match="not brighter"):
        same = pattern_variance(np.zeros((20, 20)), 1.0, 2)
        prnu_percent(same, same)
    assert signed_root(-1.0, 0.5)[0] == 0.0


def test_spectrogram_of_white_noise_is_level_and_shows_a_period():
    noise = np.random.default_rng(2)
    white = 3 * noise.standard_normal((256, 256))
    level = spectrogram(white, 1)
    assert level.amplitude.mean() == pytest.approx(3, rel=0.02)
    assert level.excess == pytest.approx(1, abs=0.03)
    assert np.isnan(level.peak_frequency)
    striped = white + 1.5 * np.sin(2 * np.pi * np.arange(256) / 16)
    assert spectrogram(striped, 1).peak_frequency == pytest.approx(1 / 16)
    assert np.isnan(spectrogram(striped, 0).peak_frequency)


HOT = {(10, 20): 4000.0, (50, 100): 1500.0, (119, 159): 900.0, (0, 0): 2500.0}
DEAD = ((30, 40), (80, 80))
BLINKING = ((60, 60), (90, 20))


def test_hot_dead_and_blinking_pixels_are_found_and_no_others():
    sensor = Sensor(hot=HOT, dead=DEAD, blinking=BLINKING, dsnu=3.0, prnu=0.01)
    dark = stack_of(sensor, 0, 8, 3, 1000.0)
    found = find_defects(dark.mean, dark.level.temporal_variance, 8, ("hot",))
    places = {(int(d.row), int(d.col)) for d in found.defects}
    assert set(HOT) <= places <= set(HOT) | set(BLINKING)
    assert (int(found.defects[0].row), int(found.defects[0].col)) == (10, 20)
    assert found.defects[0].value == pytest.approx(0.4 * 4000, rel=0.02)
    flat = stack_of(sensor, 9000, 8, 4)
    dead = find_defects(flat.mean, flat.level.temporal_variance, 8, ("dark",), 0.1)
    assert {(int(d.row), int(d.col)) for d in dead.defects} == set(DEAD)
    assert dark.variance is not None
    blinking = find_blinking(dark.variance, 8)
    assert {(int(d.row), int(d.col)) for d in blinking.defects} >= set(BLINKING)
    assert {(int(d.row), int(d.col)) for d in blinking.defects} <= set(BLINKING) | set(HOT)


def test_no_defect_is_found_in_noise_alone():
    alarms = 0
    for seed in range(20):
        stack = stack_of(Sensor(dsnu=3.0), 0, 4, seed)
        assert stack.variance is not None
        alarms += find_defects(stack.mean, stack.level.temporal_variance, 4, ("hot", "dark")).count
        alarms += find_blinking(stack.variance, 4).count
        alarms += find_lines(stack.mean).count
    assert alarms <= 1


def test_a_hot_pixel_makes_no_row_or_column_of_it():
    image = 100 + 2 * np.random.default_rng(5).standard_normal((120, 160))
    image[0, 100] = image[60, 0] = 4000.0
    assert find_lines(image).count == 0


def test_pixels_that_do_not_count_are_no_defects():
    """A lit disc on black: neither its border nor what lies beyond is defective, and its column of weak pixels is."""
    sensor = Sensor(hot=HOT, dead=((70, 90), (2, 2)))
    height, width = sensor.shape
    y, x = np.mgrid[:height, :width]
    disc = np.hypot(x - width / 2, y - height / 2) < 50
    stack = stack_of(sensor, 9000, 4, 6, 1.0)
    assert stack.variance is not None
    mean = np.where(disc, stack.mean, 0.02 * stack.mean)
    mean[:, 60] *= 0.8
    outside = np.where(disc, mean, np.nan)
    found = find_defects(outside, stack.level.temporal_variance, 4, ("hot", "dark"), 0.1)
    assert {(int(d.row), int(d.col)) for d in found.defects if d.col != 60} == {(70, 90)}
    assert sum(d.col == 60 for d in found.defects) == int(disc[:, 60].sum())
    assert [(d.kind, d.col) for d in find_lines(outside).defects] == [("column", 60.0)]
    assert find_blinking(np.where(disc, stack.variance, np.nan), 4).count == 0
    assert find_defects(mean, stack.level.temporal_variance, 4, ("hot", "dark"), 0.1).count > 1000


@pytest.mark.parametrize("black", [0.0, -2.0, 2.0])
def test_noise_that_is_cut_off_at_black_makes_no_hot_pixels(black):
    noise, alarms = np.random.default_rng(6), 0
    for _ in range(10):
        offset = black + 2 * noise.standard_normal((64, 80))
        offset[20, 30] += 60.0
        frames = np.clip(np.rint(offset + 2.5 * noise.standard_normal((4, 64, 80))), 0, 255)
        variance = float(frames.var(axis=0, ddof=1).mean())
        found = find_defects(frames.mean(axis=0), variance, 4, ("hot",), cut=True)
        assert (found.defects[0].row, found.defects[0].col) == (20, 30)
        alarms += found.count - 1
    assert alarms <= 1


def test_threshold_of_flat_frames_is_that_which_counts():
    image = 2000 + 20 * np.random.default_rng(1).standard_normal((64, 80))
    image[10, 10] = 2150.0
    image[40, 40] = 1750.0
    found = find_defects(image, 400.0, 4, ("hot", "dark"), 0.1)
    assert found.count == 1
    assert found.threshold == pytest.approx(200, rel=0.01)


def test_blinking_needs_frames_and_noise():
    with pytest.raises(InputError, match="four or more"):
        find_blinking(np.ones((20, 20)), 3)
    with pytest.raises(InputError, match="do not change"):
        find_blinking(np.zeros((20, 20)), 8)


def test_broken_rows_and_columns_are_found():
    noise = np.random.default_rng(5)
    image = 100 + 2 * noise.standard_normal((120, 160))
    image[[70, 71, 72]] -= 90  # a group of rows near black, as Behr 1989 reports of Almroth
    image[:, 33] += 4
    found = find_lines(image)
    rows = {int(d.row) for d in found.defects if d.kind == "row"}
    columns = {int(d.col) for d in found.defects if d.kind == "column"}
    assert (rows, columns) == ({70, 71, 72}, {33})


def test_background_ignores_single_pixels():
    y, x = np.mgrid[0:130, 0:170]
    smooth = 100 + 0.2 * x + 0.1 * y
    spotted = smooth.copy()
    spotted[40, 50] = 5000
    assert background(spotted)[30:60, 40:70] == pytest.approx(background(smooth)[30:60, 40:70], abs=0.2)
    assert np.abs(background(smooth) - smooth)[12:-12, 12:-12].max() < 0.5


def test_histogram_counts_all_pixels_and_models_the_many():
    noise = np.random.default_rng(6)
    deviation = noise.standard_normal((200, 200))
    bars = log_histogram(deviation, 1.0)
    assert bars.count.sum() == 40000
    assert bars.model.sum() == pytest.approx(40000, rel=0.001)


def bright_object(onset, share=1.0, seed=0, exposures=(2, 4, 8, 12, 16, 20, 28, 40)):
    """A lit square that runs over, mostly along columns, once it has `onset` grey values."""
    noise = np.random.default_rng(seed)
    response = np.full((80, 90), 0.3)
    response[30:42, 40:52] = 20.0
    response = ndimage.gaussian_filter(response, 0.7)
    images = []
    decay = np.exp(-np.arange(1, 25) / 6.0)
    for t in exposures:
        signal = response * t
        over = share * np.maximum(signal - onset, 0)
        spilled = signal - over
        for d, part in enumerate(0.02 * decay, 1):
            spilled[30 - d, :] += part * over.sum(axis=0)
            spilled[41 + d, :] += part * over.sum(axis=0)
            spilled[:, 40 - d] += 0.2 * part * over.sum(axis=1)
            spilled[:, 51 + d] += 0.2 * part * over.sum(axis=1)
        electrons = noise.poisson(np.maximum(spilled, 0) * 4) / 4
        images.append(np.clip(np.rint(10 + electrons + 0.5 * noise.standard_normal(signal.shape)), 0, 255))
    return [float(t) for t in exposures], images


def test_onset_of_blooming_within_its_standard_deviation():
    errors = []
    for seed in range(12):
        found = find_blooming(*bright_object(150.0, seed=seed), 10.0, 255.0)
        errors.append((found.onset_dn - 150.0) / found.onset_dn_sigma)
        assert found.last_without < 170
        assert found.extent_rows > 2 * found.extent_columns
    print(f"blooming onset of 150 DN: normalised errors {np.round(errors, 1)}")
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert np.abs(errors).max() < 3


def test_without_blooming_there_is_no_onset():
    found = find_blooming(*bright_object(1e9, seed=3), 10.0, 255.0)
    assert np.isnan(found.onset_dn)
    assert found.extent_rows <= 1 and found.extent_columns <= 1


def test_blooming_is_refused_where_it_cannot_be_seen():
    exposures, images = bright_object(150.0)
    with pytest.raises(InputError, match="four"):
        find_blooming(exposures[:3], images[:3], 10.0, 255.0)
    with pytest.raises(InputError, match="expose it longer"):
        find_blooming(*bright_object(1e9, exposures=(1, 2, 3, 4)), 10.0, 255.0)
    with pytest.raises(InputError, match="below half"):
        find_blooming(exposures[3:], images[3:], 10.0, 255.0)
    everywhere = [np.full((80, 90), min(10 + 20 * t, 255.0)) for t in exposures]
    with pytest.raises(InputError, match="small bright object"):
        find_blooming(exposures, everywhere, 10.0, 255.0)


def test_extent_counts_from_what_is_full_by_its_own_light():
    """Far beyond saturation the blurred border of the object is full without any blooming."""
    exposures = (4.5, 5, 5.5, 6, 6.5, 20, 80, 400)
    spill = find_blooming(*bright_object(150.0, exposures=exposures), 10.0, 255.0)
    assert spill.extent_exposure == 80  # the responses of single pixels say nothing of 400
    assert spill.extent_rows >= 10 and spill.extent_columns <= 3
    none = find_blooming(*bright_object(1e9, exposures=exposures), 10.0, 255.0)
    assert none.extent_rows <= 1 and none.extent_columns <= 1

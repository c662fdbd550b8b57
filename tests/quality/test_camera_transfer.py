"""Gain, noise, dark signal, linearity and saturation recovered from a sensor whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest
from tools.camera_model import Sensor, gathered
from tools.thinned import thinned

from photoplan.errors import InputError
from photoplan.quality.camera.geometry import fit_line, grey_wedge
from photoplan.quality.camera.photon_transfer import EmvaPoints, emva_sheet, find_saturation, linearity, photon_transfer
from photoplan.quality.camera.sensor import Level, dark_current, doubling_temperature

#: Small images for the many runs that a standard deviation of standard deviations needs.
SMALL = Sensor(shape=(24, 30))
RUNS = 500


def level_of(sensor, photons, exposure_ms, noise, frames=2, celsius=20.0):
    exposed = (sensor.frame(photons, exposure_ms, noise, celsius) for _ in range(frames))
    return gathered(exposed, 2**sensor.bits - 1).level


def transfer_of(sensor, noise, photons=(400, 1200, 2500, 4500, 7000, 10000)):
    bright = [level_of(sensor, p, 20.0, noise) for p in photons]
    return photon_transfer(bright, [level_of(sensor, 0, 20.0, noise)])


def spread_of(normalised, what):
    """Root mean square of errors over their stated standard deviations."""
    value = float(np.sqrt(np.mean(np.square(normalised))))
    print(f"{what}: normalised errors spread {value:.3f} over {len(normalised)} runs (wanted 0.9 to 1.1)")
    return value


@thinned("runs", 80, 500)
def test_normalised_errors_of_gain_and_read_noise_spread_by_one(runs):
    gain, read, read_dn = [], [], []
    for run in range(runs):
        found = transfer_of(SMALL, np.random.default_rng(run))
        gain.append((found.gain - SMALL.gain) / found.gain_sigma)
        truth = np.hypot(SMALL.read_noise, np.sqrt(SMALL.dark_current * 0.02))
        read.append((found.read_noise_e - truth) / found.read_noise_e_sigma)
        read_dn.append((found.read_noise_dn - truth * SMALL.gain) / found.read_noise_dn_sigma)
    for name, normalised in (("gain", gain), ("read noise e", read), ("read noise DN", read_dn)):
        assert 0.9 < spread_of(normalised, name) < 1.1
        assert abs(np.mean(normalised)) < 0.15


@pytest.mark.slow
@thinned("runs", 200, 500)
def test_normalised_errors_of_read_noise_without_dark_frames_spread_by_one(runs):
    """Far extrapolated: the errors of slope and offset of the line belong together."""
    read = []
    for run in range(runs):
        noise = np.random.default_rng(7000 + run)
        bright = [level_of(SMALL, p, 20.0, noise) for p in (60, 120, 200, 300, 400)]
        found = photon_transfer(bright, black_level=SMALL.bias)
        read.append((found.read_noise_e - SMALL.read_noise) / found.read_noise_e_sigma)
    assert 0.9 < spread_of(read, "read noise e without dark frames") < 1.1


def test_rounding_is_no_read_noise():
    coarse = Sensor(gain=0.08)  # 0.64 DN of read noise, 0.29 DN of rounding
    found = transfer_of(coarse, np.random.default_rng(4))
    assert found.read_noise_dn == pytest.approx(0.64, abs=4 * found.read_noise_dn_sigma)
    assert np.hypot(0.64, 12**-0.5) - 0.64 > 8 * found.read_noise_dn_sigma
    dark = level_of(coarse, 0, 20.0, np.random.default_rng(5))
    photons = np.linspace(500, 5000, 9)
    bright = [level_of(coarse, p, 20.0, np.random.default_rng(6)) for p in photons]
    means, variances = [x.mean for x in bright], [x.temporal_variance for x in bright]
    nine = np.ones(9)
    sheet = emva_sheet(
        EmvaPoints(
            photons,
            means,
            variances,
            dark.mean * nine,
            dark.temporal_variance * nine,
            np.full(9, dark.degrees, float),
            np.full(9, dark.mean_sigma),
        )
    )
    assert sheet.temporal_dark_noise_e == pytest.approx(8.0, abs=4 * sheet.temporal_dark_noise_e_sigma)
    assert 8 * (np.hypot(0.64, 12**-0.5) / 0.64 - 1) > 8 * sheet.temporal_dark_noise_e_sigma


def test_flicker_of_the_lamp_does_not_change_the_gain():
    steady, flickering = Sensor(), Sensor(flicker=0.02)
    a, b = (transfer_of(s, np.random.default_rng(3)) for s in (steady, flickering))
    assert a.gain == pytest.approx(0.4, rel=0.02)
    assert b.gain == pytest.approx(0.4, rel=0.02)


def test_temporal_variance_of_many_frames_without_their_drift():
    noise = np.random.default_rng(0)
    frames = [100 + 30 * k + 2.0 * noise.standard_normal((60, 70)) for k in range(5)]
    level = gathered(frames, 1e9).level
    assert level.temporal_variance == pytest.approx(4.0, abs=4 * level.variance_sigma)
    assert level.degrees == 4 * (60 * 70 - 1)


def test_full_well_at_the_peak_of_the_variance():
    noise = np.random.default_rng(5)
    sensor = Sensor(full_well=6000.0)
    photons = np.linspace(500, 14000, 24)
    bright = [level_of(sensor, p, 20.0, noise) for p in photons]
    found = photon_transfer(bright, [level_of(sensor, 0, 20.0, noise)])
    assert found.full_well_e == pytest.approx(6000, abs=3 * found.full_well_e_sigma)
    assert found.gain == pytest.approx(0.4, rel=0.02)
    without = photon_transfer(bright[:8], [level_of(sensor, 0, 20.0, noise)])
    assert np.isnan(without.full_well_e)


def test_read_noise_is_refused_where_black_is_cut_off():
    noise = np.random.default_rng(6)
    sensor = Sensor(bias=0.0)
    bright = [level_of(sensor, p, 20.0, noise) for p in (1000, 3000, 6000)]
    found = photon_transfer(bright, [level_of(sensor, 0, 20.0, noise)])
    assert np.isnan(found.read_noise_e)
    assert "black is cut off" in found.read_noise_refused
    assert found.gain == pytest.approx(0.4, rel=0.03)


def test_read_noise_is_refused_without_black_and_where_rounding_hides_it():
    noise = np.random.default_rng(7)
    bright = [level_of(Sensor(), p, 20.0, noise) for p in (1000, 3000, 6000)]
    assert "not known" in photon_transfer(bright).read_noise_refused
    coarse = Sensor(gain=0.02, bits=8, read_noise=5.0)
    bright = [level_of(coarse, p, 20.0, noise) for p in (4000, 8000, 15000)]
    assert "rounding" in photon_transfer(bright, [level_of(coarse, 0, 20.0, noise)]).read_noise_refused


@pytest.mark.parametrize("photons", [(1000, 3000), (1000, 60000, 70000, 80000)])
def test_too_few_levels_give_no_gain(photons):
    noise = np.random.default_rng(8)
    with pytest.raises(InputError, match="photon transfer needs 3"):
        photon_transfer([level_of(Sensor(), p, 20.0, noise) for p in photons])


def test_single_frames_give_no_gain():
    noise = np.random.default_rng(8)
    with pytest.raises(InputError, match="single frame"):
        photon_transfer([level_of(Sensor(), p, 20.0, noise, frames=1) for p in (1000, 2000, 3000)])


def test_frames_whose_variance_does_not_grow_give_no_gain():
    noise = np.random.default_rng(9)
    levels = [gathered(100 * k + noise.standard_normal((2, 40, 40)), 255).level for k in (1, 1.5, 2)]
    with pytest.raises(InputError, match="does not grow"):
        photon_transfer(levels)


def dark_series(sensor, noise, celsius=20.0, exposures=(100.0, 500.0, 1000.0, 2000.0)):
    return exposures, [level_of(sensor, 0, e, noise, 3, celsius) for e in exposures]


@thinned("runs", 80, 500)
def test_normalised_errors_of_dark_current_and_doubling_temperature_spread_by_one(runs):
    current, doubling = [], []
    for run in range(runs):
        noise = np.random.default_rng(1000 + run)
        found = [dark_current(*dark_series(SMALL, noise, t)) for t in (20.0, 30.0, 40.0)]
        current.append((found[0].current_dn_s - SMALL.dark_current * SMALL.gain) / found[0].current_dn_s_sigma)
        both = doubling_temperature(
            [20.0, 30.0, 40.0], [f.current_dn_s for f in found], [f.current_dn_s_sigma for f in found]
        )
        doubling.append((both.doubling_k - SMALL.doubling) / both.doubling_k_sigma)
    assert 0.9 < spread_of(current, "dark current") < 1.1
    assert 0.9 < spread_of(doubling, "doubling temperature") < 1.1


def test_dark_current_is_refused_where_black_is_cut_off_or_exposures_are_few():
    noise = np.random.default_rng(2)
    with pytest.raises(InputError, match="black is cut off"):
        dark_current(*dark_series(Sensor(bias=1.0), noise))
    with pytest.raises(InputError, match="needs 3"):
        dark_current(*dark_series(Sensor(), noise, exposures=(100.0, 500.0)))


def test_doubling_temperature_needs_two_temperatures_and_growth():
    with pytest.raises(InputError, match="two or more"):
        doubling_temperature([20.0, 20.0], [1.0, 1.1], [0.1, 0.1])
    with pytest.raises(InputError, match="not significantly positive"):
        doubling_temperature([20.0, 30.0], [0.1, 1.1], [0.1, 0.1])
    with pytest.raises(InputError, match="does not grow"):
        doubling_temperature([20.0, 30.0], [1.1, 1.0], [0.1, 0.1])
    exact = doubling_temperature([20.0, 27.0, 34.0], [1.0, 2.0, 4.0], [0.01] * 3)
    assert exact.doubling_k == pytest.approx(7.0, rel=1e-9)


def test_linearity_error_of_a_straight_and_of_a_bent_curve():
    x = np.linspace(5, 95, 19)
    straight = linearity(x, 10 * x + 3, np.full(19, 0.01), 1000)
    assert straight.error_percent < 1e-9
    assert (straight.slope, straight.offset) == pytest.approx((10, 3))
    assert straight.segment[1:] == pytest.approx(10)
    bent = linearity(x, 10 * x * (1 - 0.001 * x), np.full(19, 0.01), 1000)
    assert 0.3 < bent.error_percent < 2
    assert bent.error_max_percent > 0 > bent.error_min_percent


@pytest.mark.parametrize(("bend", "least"), [(0.0, 0.9), (1e-4, 0.6), (1e-3, 0.9)])
def test_normalised_errors_of_the_linearity_error(bend, least):
    """The deviations share the noise of the line; on a straight curve all of the error is noise, and said to be."""
    x = np.linspace(8, 90, 10)
    exact = 10 * x * (1 - bend * x)
    sigma = np.sqrt(0.002 * exact)
    truth = linearity(x, exact, sigma, 1000).error_percent
    normalised = []
    for run in range(RUNS):
        found = linearity(x, exact + sigma * np.random.default_rng(run).standard_normal(x.size), sigma, 1000)
        normalised.append((found.error_percent - truth) / found.error_percent_sigma)
    assert least < spread_of(normalised, f"linearity error of a bend of {bend:g}") < 1.1


def test_read_noise_is_without_the_dark_current_of_the_shortest_dark_frames():
    """At 20 ms there are 60 electrons of dark current."""
    sensor, noise = Sensor(shape=(60, 80), dark_current=3000.0), np.random.default_rng(8)
    bright = [level_of(sensor, p, 20.0, noise) for p in (400, 1200, 2500, 4500, 7000, 10000)]
    exposures = (20.0, 40.0, 60.0, 100.0)
    dark = [level_of(sensor, 0, t, noise) for t in exposures]
    found = photon_transfer(bright, dark, exposures)
    assert abs(found.read_noise_e - sensor.read_noise) < 3.5 * found.read_noise_e_sigma
    assert found.read_noise_e_sigma < 0.05 * sensor.read_noise


def test_responsivity_of_a_flickering_lamp_has_the_flicker_in_its_standard_deviation():
    sensor, normalised = Sensor(shape=(24, 30), flicker=0.02), []
    photons = np.array([400.0, 1200, 2500, 4500, 7000, 10000, 13000])
    for run in range(150):
        noise = np.random.default_rng(run)
        dark = level_of(sensor, 0, 20.0, noise)
        bright = [level_of(sensor, p, 20.0, noise) for p in photons]
        same = np.ones(photons.size)
        sheet = emva_sheet(
            EmvaPoints(
                photons,
                [level.mean for level in bright],
                [level.temporal_variance for level in bright],
                dark.mean * same,
                dark.temporal_variance * same,
                dark.degrees * same,
                [np.hypot(level.mean_sigma, dark.mean_sigma) for level in bright],
            )
        )
        truth = sensor.gain * sensor.efficiency
        normalised.append((sheet.responsivity - truth) / sheet.responsivity_sigma)
    assert 0.8 < spread_of(normalised, "responsivity") < 1.2


def test_line_of_linearity_has_least_relative_deviations():
    noise = np.random.default_rng(0)
    x = np.linspace(10, 90, 9)
    y = 10 * x * (1 + 0.02 * noise.standard_normal(9))
    found = linearity(x, y, np.ones(9), 1000)
    used = found.used

    def cost(offset, slope):
        return np.sum(((found.signal - offset - slope * found.exposure)[used] / found.signal[used]) ** 2)

    best = cost(found.offset, found.slope)
    for d_offset, d_slope in ((0.5, 0), (-0.5, 0), (0, 0.02), (0, -0.02)):
        assert cost(found.offset + d_offset, found.slope + d_slope) > best


def test_linearity_refuses_exposures_that_cannot_be():
    with pytest.raises(InputError, match="falls from"):
        linearity([10, 20, 30, 40], [100, 400, 200, 600], [1] * 4, 1000)
    with pytest.raises(InputError, match="positive and differ"):
        linearity([10, 10, 30], [100, 100, 300], [1] * 3, 1000)
    with pytest.raises(InputError, match="needs 3"):
        linearity([10, 20, 30], [10, 20, 300], [1] * 3, 1000)


def test_saturation_by_clipping_by_response_and_by_variance():
    x = np.array([10.0, 20, 40, 80, 160, 320])
    clipped = find_saturation(x, np.minimum(10 * x, 1023), 0.0, [0, 0, 0, 0, 1, 1])
    assert clipped is not None
    assert (clipped.rule, clipped.last_unsaturated, clipped.first_saturated) == ("clipping", 80, 160)
    assert clipped.exposure == pytest.approx(102.3)
    flat = find_saturation(x, np.minimum(10 * x, 700), 0.0, np.zeros(6))
    assert flat is not None
    assert (flat.rule, flat.level_dn) == ("response", 700)
    mean = 10 * x / (1 + x / 3000)
    collapse = find_saturation(x, mean, 0.0, np.zeros(6), np.where(x < 200, mean, 5.0))
    assert collapse is not None and collapse.rule == "variance"
    assert find_saturation(x, 2 * x, 0.0, np.zeros(6), 2 * x) is None


def test_saturation_of_a_simulated_sensor():
    noise = np.random.default_rng(11)
    sensor = Sensor(full_well=5000.0)
    exposures = np.array([5.0, 10, 20, 40, 60, 80])
    levels = [level_of(sensor, 250 * e, e, noise) for e in exposures]
    found = find_saturation(
        exposures,
        [level.mean for level in levels],
        sensor.bias,
        [level.saturated_share for level in levels],
        [level.temporal_variance for level in levels],
    )
    assert found is not None
    assert found.level_dn == pytest.approx(sensor.bias + 0.4 * 5000, abs=1)
    assert found.last_unsaturated < 40.0 <= found.first_saturated
    with pytest.raises(InputError, match="every level"):
        find_saturation(exposures, np.full(6, 255.0), 0.0, np.ones(6))


def test_grey_wedge_of_a_proportional_and_of_a_shouldered_sensor():
    density = np.arange(0.05, 1.85, 0.15)
    transmission = 10**-density
    straight = grey_wedge(density, 800 * transmission, np.full(12, 0.1), 1000)
    assert straight.gamma == pytest.approx(1.0, abs=1e-6)
    assert straight.error_percent < 1e-6
    bent = grey_wedge(density, 800 * transmission**0.6, np.full(12, 0.1), 1000)
    assert bent.gamma == pytest.approx(0.6, abs=1e-6)
    assert bent.error_percent > 5
    with pytest.raises(InputError, match="brighter"):
        grey_wedge([0.1, 0.4, 0.7, 1.0], [800, 400, 600, 100], [1] * 4, 1000)
    with pytest.raises(InputError, match="needs 3"):
        grey_wedge([0.1, 0.4, 0.7, 1.0], [1000, 1000, 600, 1], [1] * 4, 1000)


def test_emva_sheet_of_a_simulated_sensor():
    noise = np.random.default_rng(12)
    sensor = Sensor(full_well=6000.0)
    photons = np.linspace(300, 15000, 30)
    bright = [level_of(sensor, p, 20.0, noise) for p in photons]
    dark = level_of(sensor, 0, 20.0, noise, 2)
    sheet = emva_sheet(
        EmvaPoints(
            photons,
            [level.mean for level in bright],
            [level.temporal_variance for level in bright],
            np.full(30, dark.mean),
            np.full(30, dark.temporal_variance),
            np.full(30, dark.degrees),
            [np.hypot(level.mean_sigma, dark.mean_sigma) for level in bright],
        )
    )
    assert sheet.gain == pytest.approx(0.4, abs=4 * sheet.gain_sigma)
    assert sheet.quantum_efficiency_percent == pytest.approx(50, abs=4 * sheet.quantum_efficiency_percent_sigma)
    assert sheet.temporal_dark_noise_e == pytest.approx(8.0, abs=4 * sheet.temporal_dark_noise_e_sigma)
    assert sheet.saturation_e == pytest.approx(6000, abs=3 * sheet.saturation_e_sigma)
    assert not sheet.refused


def test_emva_sheet_says_what_it_cannot_know():
    mean = np.linspace(100, 900, 9)
    points = EmvaPoints(
        np.full(9, np.nan), mean, mean * 0.5, np.zeros(9), np.full(9, 0.1), np.full(9, 1e5), np.sqrt(mean / 2e5)
    )
    sheet = emva_sheet(points)
    assert set(sheet.refused) == {"saturation", "quantum efficiency", "dark noise", "linearity error"}
    assert sheet.gain == pytest.approx(0.5, rel=0.01)
    for value in (sheet.quantum_efficiency_percent, sheet.saturation_e, sheet.temporal_dark_noise_e, sheet.snr_max):
        assert np.isnan(value)


def test_line_through_exact_points_and_its_standard_deviations():
    line = fit_line([1.0, 2, 3, 4], [3.0, 5, 7, 9], [0.1] * 4)
    assert (line.offset, line.slope) == pytest.approx((1, 2))
    # Textbook: variance of the slope is s² / Σ (x − x̄)², of the offset s² (1/n + x̄² / Σ (x − x̄)²).
    assert line.slope_sigma == pytest.approx(0.1 / np.sqrt(5))
    assert line.offset_sigma == pytest.approx(0.1 * np.sqrt(1 / 4 + 2.5**2 / 5))
    assert np.sqrt(line.covariance @ np.array([1, 2 * 2.5, 2.5**2])) == pytest.approx(0.05)
    scattered = fit_line([1.0, 2, 3, 4], [3.0, 6, 6, 9], [0.001] * 4)
    assert scattered.slope_sigma > 0.1
    with pytest.raises(InputError):
        fit_line([1.0, 1.0], [1.0, 2.0], [1.0, 1.0])


def test_statistics_agree_with_numpy():
    noise = np.random.default_rng(1)
    frames = noise.integers(0, 255, (4, 20, 30)).astype(np.uint8)
    mask = noise.random((20, 30)) > 0.3
    stack = gathered(frames, 250, mask)
    assert stack.mean == pytest.approx(frames.mean(axis=0))
    assert stack.variance == pytest.approx(frames.astype(float).var(axis=0, ddof=1))
    assert stack.level.mean == pytest.approx(frames[:, mask].mean())
    assert stack.level.saturated_share == pytest.approx((frames[:, mask] >= 250).mean())
    residual = frames[:, mask].astype(float)
    residual -= residual.mean(axis=0) + residual.mean(axis=1, keepdims=True) - residual.mean()
    assert stack.level.temporal_variance == pytest.approx((residual**2).sum() / (3 * (mask.sum() - 1)))


def test_level_without_noise_has_no_negative_variance():
    level = gathered(np.full((3, 5, 5), 7.0), 255).level
    assert isinstance(level, Level)
    assert level.temporal_variance == 0

"""Line jitter by plumb line (Behr 1989, §4.1.2): positions, fields, periods, spikes, parallel edges, control."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tools.camera_series import edge_lines
from tools.thinned import thinned

from photoplan.errors import InputError
from photoplan.quality.camera.geometry import correlate_edge, fit_edge
from photoplan.quality.camera.sensor import jitter_grey, jitter_pixels
from photoplan.quality.camera.video import Harmonic, Waves, above_control, compare_edges, line_jitter, spectrum

LINES = np.arange(400.0)


def window(
    position: np.ndarray, seed: int = 0, noise: float = 1.0, blur: float = 0.8, contrast: float = 120.0
) -> np.ndarray:
    """Grey values of an edge in whole steps from 0 to 255."""
    rng = np.random.default_rng(seed)
    grey = edge_lines(position, 40, blur, contrast, 60.0, lambda shape: rng.normal(0, noise, shape))
    return np.clip(np.rint(grey), 0, 255)


def test_position_error_of_eq_4_5() -> None:
    """20 ns at 10 MHz are 0.2 pixel: the product, though eq. 4.5 prints a quotient."""
    assert jitter_pixels(20e-9, 10e6) == pytest.approx(0.2)


def test_grey_error_of_eq_4_6_and_4_7() -> None:
    """Eq. 4.7 prints 20 grey values; its formula gives 51, and a step of 100, which the text names, gives 20."""
    formula, text = jitter_grey(20e-9, 255, 100e-9), jitter_grey(20e-9, 100, 100e-9)
    print(f"\neq. 4.7: formula {formula:.0f}, printed 20; with the text's step of 100: {text:.0f}")
    assert formula == pytest.approx(51.0) and text == pytest.approx(20.0)


def test_period_of_120_lines_in_hertz() -> None:
    """A line lasts 64 µs (625 lines in 40 ms). 120 lines of a field are 130 Hz, the text's "about 150 Hz" (a multiple
    of the 50 Hz of the fields); 120 rows of an interlaced image are 60 lines of a field, 260 Hz."""
    found = Harmonic(120.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0)
    field, rows = found.hertz(64e-6, False), found.hertz(64e-6, True)
    print(f"\n120 lines: {field:.1f} Hz if lines of one field, {rows:.1f} Hz if rows of the whole image; printed 150")
    assert field == pytest.approx(130.2, abs=0.05) and rows == pytest.approx(260.4, abs=0.05)


@pytest.mark.parametrize("blur", [0.5, 0.8, 1.2, 2.0])
@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_edge_positions_have_true_standard_deviations(blur: float, noise: float) -> None:
    position = 18.3 + 0.003 * LINES
    grey = window(position, 1, noise, blur)
    found = fit_edge(grey)
    error = found.position - position
    by_correlation = correlate_edge(grey, found).position - position
    print(
        f"\nblur {blur}, noise {noise}: fit {error.std():.4f} px, normalised {np.std(error / found.sigma):.3f}, "
        f"correlation {by_correlation.std():.4f} px"
    )
    assert 0.9 < np.sqrt(np.mean((error / found.sigma) ** 2)) < 1.1
    assert abs(error.mean()) < 4 * error.std() / 20
    # Behr's control gave 0.05 to 0.10 px for correlation and parabola; the fit is no worse than it.
    assert error.std() <= 1.02 * by_correlation.std() and by_correlation.std() < 0.1
    assert found.contrast == pytest.approx(120.0, rel=0.02)


def test_bright_to_dark_edges_do_as_well() -> None:
    grey = window(18.3 + 0.003 * LINES, 2)
    there, back = fit_edge(grey), fit_edge(grey[:, ::-1])
    np.testing.assert_allclose(there.position + back.position, 39.0, atol=0.005)  # other pixels take part


def test_parabola_of_three_coefficients() -> None:
    """Eq. 4.9 and 4.10 find a shift by whole pixels exactly, and one by parts of a pixel nearly."""
    position = 18.3 + np.where(LINES % 3 == 1, 5.0, 0.0)
    found = correlate_edge(window(position, 3, 0.0), fit_edge(window(position, 3, 0.0)))
    np.testing.assert_allclose(found.position, position, atol=0.005)
    parts = 18.3 + 0.5 * (LINES % 2)
    found = correlate_edge(window(parts, 3, 0.0), fit_edge(window(parts, 3, 0.0)))
    assert np.abs(found.position - parts).max() < 0.05


def test_period_amplitude_fields_with_true_standard_deviations() -> None:
    rng = np.random.default_rng(4)
    amplitude, period, fields = [], [], []
    t = np.arange(480.0)
    for k in range(50):
        y = 20 + 0.003 * t + 0.3 * np.sin(2 * np.pi * t / 120 + k) + rng.normal(0, 0.1, 480) + 0.05 * (t % 2)
        found = line_jitter(y)
        h = found.harmonics[0]
        amplitude.append((h.amplitude - 0.3) / h.sigma_amplitude)
        period.append((h.period - 120) / h.sigma_period)
        fields.append((found.field_offset - 0.05) / found.sigma_field_offset)
    spreads = [float(np.sqrt(np.mean(np.square(e)))) for e in (amplitude, period, fields)]
    print(f"\n{h.amplitude:.3f} ± {h.sigma_amplitude:.3f} px, {h.period:.1f} ± {h.sigma_period:.1f} lines; normalised")
    print("amplitude {:.3f}, period {:.3f}, fields {:.3f}".format(*spreads))
    assert all(0.85 < s < 1.15 for s in spreads)  # 50 samples: ± 0.1
    assert found.residual_sigma == pytest.approx(0.1, rel=0.1)
    model = h.at(t)
    assert np.corrcoef(model, np.sin(2 * np.pi * t / 120 + k))[0, 1] > 0.999


@thinned("runs", 20, 40)
def test_noise_alone_has_no_period_no_curve_no_fields(runs: int) -> None:
    rng = np.random.default_rng(5)
    found = [line_jitter(20 + 0.003 * LINES + rng.normal(0, 0.1, 400)) for _ in range(runs)]
    alarms = [
        sum(bool(f.harmonics) for f in found),
        sum(f.degree > 1 for f in found),
        sum(f.fields_differ for f in found),
    ]
    print(f"\nfalse alarms in {runs}: periods {alarms[0]}, curves {alarms[1]}, fields {alarms[2]}")
    assert max(alarms) <= runs / 40 and not any(f.spikes for f in found)


def test_two_oscillations_are_both_found() -> None:
    rng = np.random.default_rng(6)
    y = 20 + 0.3 * np.sin(2 * np.pi * LINES / 120) + 0.1 * np.sin(2 * np.pi * LINES / 7.3) + rng.normal(0, 0.05, 400)
    first, second = line_jitter(y).harmonics
    assert first.period == pytest.approx(120, abs=1.5) and second.period == pytest.approx(7.3, abs=0.01)


def test_spectrum_is_what_least_squares_explain() -> None:
    """At every frequency: the sum of squares that cosine and sine take away beside trend and fields."""
    rng = np.random.default_rng(20)
    t = np.sort(rng.choice(120, 90, replace=False)).astype(float)
    y = rng.normal(0, 1, 90) + 0.05 * t + np.sin(t / 9)
    base = np.column_stack([np.ones(90), t, t**2, t % 2])
    found = spectrum(Waves(t), y, base)
    rss0 = np.linalg.lstsq(base, y, rcond=None)[1][0]
    for k in range(0, len(found.frequency), 9):
        angle = 2 * np.pi * found.frequency[k] * t
        rss = np.linalg.lstsq(np.column_stack([base, np.cos(angle), np.sin(angle)]), y, rcond=None)[1][0]
        assert found.power[k] == pytest.approx(1 - rss / rss0, abs=1e-9)


def test_spikes_are_listed_and_do_not_count() -> None:
    rng = np.random.default_rng(7)
    y = 20 + 0.003 * LINES + rng.normal(0, 0.1, 400)
    clean = line_jitter(y)
    y[77] += 20.0  # Behr: single deviations of up to 20 pixels
    y[200:203] -= 5.0
    y[310] = np.nan
    found = line_jitter(y)
    assert [s.line for s in found.spikes] == [77, 200, 201, 202] and found.missing == (310,)
    assert found.spikes[0].deviation == pytest.approx(20.0, abs=0.3)
    assert found.sigma == pytest.approx(clean.sigma, rel=0.02)
    assert found.slope == pytest.approx(clean.slope, abs=1e-4)


def test_curved_edges_are_modelled_and_said() -> None:
    """Fall-off and distortion bend an edge (Behr 1989, fig. 4.6)."""
    rng = np.random.default_rng(8)
    u = LINES / 200 - 1
    bent = 20 + 0.5 * u**2 + rng.normal(0, 0.05, 400)
    found = line_jitter(bent)
    assert found.degree == 2 and found.sagitta == pytest.approx(0.33, abs=0.03)
    assert found.sigma == pytest.approx(0.05, rel=0.1) and not found.harmonics
    straight = line_jitter(bent, degree=1)
    assert straight.degree == 1 and straight.sigma > 0.1


def test_parallel_edges_tell_line_starts_from_the_clock() -> None:
    rng = np.random.default_rng(9)
    a, b, common = (rng.normal(0, s, 400) for s in (0.1, 0.1, 0.2))
    starts = compare_edges(line_jitter(20 + a + common), line_jitter(30 + b + common))
    print(f"\ncommon {starts.common_sigma:.3f} ± {starts.sigma_common:.3f}, own {starts.own_sigma}; {starts.verdict}")
    assert starts.common_sigma == pytest.approx(0.2, abs=3 * starts.sigma_common)
    assert starts.own_sigma[0] == pytest.approx(0.1, abs=0.03)
    assert starts.low < 0.8 < starts.high
    clock = compare_edges(line_jitter(20 + a), line_jitter(30 + b))
    assert clock.probability > 0.01 and "not errors at the start" in clock.verdict
    errors = []
    for k in range(30):
        rng = np.random.default_rng(100 + k)
        x, y, c = (rng.normal(0, s, 300) for s in (0.1, 0.1, 0.2))
        pair = compare_edges(line_jitter(20 + x + c), line_jitter(30 + y + c))
        errors.append((pair.common_sigma - 0.2) / pair.sigma_common)
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25  # 30 samples: ± 0.13


def test_periodic_parts_of_other_phase_hide_no_common_ones() -> None:
    rng = np.random.default_rng(10)
    c = rng.normal(0, 0.1, 480)
    t = np.arange(480.0)
    a = line_jitter(20 + c + 0.3 * np.sin(2 * np.pi * t / 120) + rng.normal(0, 0.02, 480))
    b = line_jitter(30 + c + 0.3 * np.sin(2 * np.pi * t / 120 + 2) + rng.normal(0, 0.02, 480))
    assert compare_edges(a, b).correlation < 0.1
    assert compare_edges(a, b, periodic=False).correlation > 0.9


def test_spikes_of_one_edge_only() -> None:
    """Figure 4.5: spikes come at one edge only."""
    rng = np.random.default_rng(11)
    x, y = rng.normal(0, 0.1, (2, 400))
    x[50] += 4
    y[90] += 4
    x[120] += 4
    y[120] += 4
    found = compare_edges(line_jitter(20 + x), line_jitter(30 + y))
    assert found.common_spikes == (120,) and found.single_spikes == (50, 90)


def test_jitter_beyond_the_control() -> None:
    rng = np.random.default_rng(12)
    control = line_jitter(20 + rng.normal(0, 0.07, 400))
    moved = line_jitter(20 + rng.normal(0, 0.07, 400) + rng.normal(0, 0.2, 400))
    found = above_control(moved, control)
    assert found.sigma == pytest.approx(0.2, abs=3 * found.sigma_sigma) and found.probability < 1e-9
    none = above_control(line_jitter(20 + rng.normal(0, 0.07, 400)), control)
    assert none.probability > 0.001


def test_jitter_of_an_image_is_recovered() -> None:
    """Positions move, grey values are made, positions and their jitter are found."""
    rng = np.random.default_rng(13)
    moved = 18.3 + 0.003 * LINES + rng.normal(0, 0.15, 400) + 0.2 * np.sin(2 * np.pi * LINES / 90)
    found = line_jitter(fit_edge(window(moved, 14)).position)
    assert found.residual_sigma == pytest.approx(0.15, rel=0.1)
    assert found.harmonics[0].amplitude == pytest.approx(0.2, abs=4 * found.harmonics[0].sigma_amplitude)
    assert found.harmonics[0].period == pytest.approx(90, abs=4 * found.harmonics[0].sigma_period)


def test_bad_edges_are_refused_in_words() -> None:
    rng = np.random.default_rng(15)
    with pytest.raises(InputError, match="no edge in"):
        fit_edge(rng.normal(100, 3, (100, 40)))
    with pytest.raises(InputError, match="do not change"):
        fit_edge(np.full((100, 40), 7.0))
    bright = np.clip(window(18.3 + 0.003 * LINES, 16, contrast=190.0) + 40, 0, 255)
    with pytest.raises(InputError, match="saturated"):
        fit_edge(bright, saturation=255.0)
    with pytest.raises(InputError, match="saturated"):
        fit_edge(np.minimum(window(18.3 + 0.003 * LINES, 16), 170.0))
    with pytest.raises(InputError, match="cut off in the dark"):
        fit_edge(np.maximum(window(18.3 + 0.003 * LINES, 16), 65.0))
    half = window(18.3 + 0.003 * LINES, 17)
    half[150:] = rng.normal(60, 1, (250, 40))
    with pytest.raises(InputError, match=r"no edge in 2\d\d of 400 lines"):
        fit_edge(half)
    with pytest.raises(InputError, match="at least 18 columns"):
        fit_edge(half[:, :12])
    with pytest.raises(InputError, match="10000 lines are taken"):
        fit_edge(np.zeros((10_001, 40), np.float32))
    with pytest.raises(InputError, match="and 16 lines"):
        fit_edge(half[:10])
    with pytest.raises(InputError, match="edge in 8 lines"):
        line_jitter(np.arange(8.0))
    textured = window(18.3 + 0.003 * LINES, 18) + 28 * rng.normal(0, 1, (400, 40))
    with pytest.raises(InputError, match="texture"):
        fit_edge(textured)
    with pytest.raises(InputError, match="3 lines in common"):
        y = np.full(400, np.nan)
        z = y.copy()
        y[:40], z[37:77] = rng.normal(20, 0.1, (2, 40))
        compare_edges(line_jitter(y), line_jitter(z))
    assert math.isfinite(fit_edge(window(18.3 + 0.003 * LINES, 19)).noise)

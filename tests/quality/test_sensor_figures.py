"""Sensor figures against every figure of Behr 1989: tables 3.1, 3.3, 3.4 and equations 3.3 to 3.23, 4.5 to 4.7."""

from __future__ import annotations

from math import pi, radians

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.quality.camera import sensor
from photoplan.quality.camera.sensor import NoiseBudget, VideoNorm

CCIR = VideoNorm(625, 64e-6, 12e-6, 25 * 64e-6 + 12e-6, 4 / 3, 0.67)


def printed(name: str, value: float, figure: float, digits: int) -> None:
    """The value rounds to the figure that the source prints."""
    print(f"{name}: {value:.6g}, printed {figure:g}")
    assert round(value, digits) == figure


def test_behr_equations_3_1_to_3_5_lines_from_the_viewing_angle():
    lines = sensor.lines_from_viewing(radians(14.0), radians(1.5 / 60))
    printed("Z, eq. 3.3", lines, 560, 6)
    height = sensor.viewed_length(3.0, radians(14.0))
    spacing = sensor.viewed_length(3.0, radians(1.5 / 60))
    assert height / spacing == pytest.approx(lines, rel=1e-12)
    assert sensor.columns_of(lines, 4 / 3) == pytest.approx(746.667, abs=1e-3)
    assert sensor.points_of(lines, 4 / 3) == pytest.approx(560 * 560 * 4 / 3)


def test_behr_table_3_1_the_norm():
    printed("f_H Hz", CCIR.line_hz, 15625, 6)
    printed("f_B Hz", CCIR.frame_hz, 25, 9)
    printed("f_V Hz", CCIR.field_hz, 50, 9)


def test_behr_equations_3_6_to_3_11_bandwidth_and_blanking():
    assert CCIR.plain_hz == pytest.approx(0.5 * 625**2 * 4 / 3 * 25)
    printed("f_gr MHz, eq. 3.7 (sources README: 6.51)", CCIR.plain_hz / 1e6, 6.51, 2)
    assert CCIR.columns_factor == pytest.approx(64 / 52)
    assert CCIR.lines_factor == pytest.approx(40000 / (40000 - 1612))
    # The text states 1.15 beside eq. 3.11, whose own value is 1.18.
    printed("f'_gr / f_gr, eq. 3.11 (text: 1.15)", CCIR.blanking_factor, 1.18, 2)


def test_behr_equation_3_12_kell_factor():
    printed("f*_gr MHz with the text's factor 1.15", 0.67 * 1.15 * CCIR.plain_hz / 1e6, 5.0, 1)
    printed("f*_gr MHz with eq. 3.11 (table 3.1: 5)", CCIR.kell_hz / 1e6, 5.15, 2)
    # §3.1 rounds 0.64 · 560 = 358.4 to 400.
    printed("k · Z", VideoNorm(560, 64e-6, 0, 0, 4 / 3, 0.64).resolved_lines, 358.4, 6)


def test_behr_equation_3_13_sampling_theorem():
    printed("f_s MHz for a signal of 5 MHz", sensor.sampling_hz(5e6) / 1e6, 10, 9)


def test_behr_equation_3_14_quantisation():
    assert sensor.quantisation_sigma(1.0) == pytest.approx(np.sqrt(1 / 12))
    values = np.random.default_rng(1).uniform(0, 255, 400_000)
    rounded = np.round(values) - values
    print(f"quantisation: {rounded.std():.5f} of rounded numbers, {sensor.quantisation_sigma(1.0):.5f} by eq. 3.14")
    assert rounded.std() == pytest.approx(sensor.quantisation_sigma(1.0), rel=3e-3)


def shifted(signal, inefficiency, transfers):
    """A row of charges after so many transfers, each of which leaves a share behind: the slow twin."""
    left = signal.astype(complex)
    for _ in range(transfers):
        left = (1 - inefficiency) * left + inefficiency * np.roll(left, 1)
    return left


@pytest.mark.parametrize("ratio", [1 / 16, 1 / 8, 1 / 4, 1 / 2])
def test_behr_equations_3_15_and_3_16_are_what_shifting_charges_does(ratio):
    inefficiency, transfers = 1e-4, 2000
    wave = np.exp(2j * pi * ratio * np.arange(64))
    response = (shifted(wave, inefficiency, transfers) / wave)[0]
    product = inefficiency * transfers
    modulation, phase = sensor.transfer_modulation(product, ratio), sensor.transfer_phase(product, ratio)
    print(f"f_s/f_c {ratio:g}: M {modulation:.5f} against {abs(response):.5f}")
    assert abs(response) == pytest.approx(float(modulation), rel=1e-4)
    # Eq. 3.16 is what is left of the lag without the delay of all frequencies, nε elements.
    lag = -np.angle(response) - product * 2 * pi * ratio
    assert lag == pytest.approx(float(phase), abs=1e-4)


def test_behr_figure_3_15_curves():
    assert sensor.transfer_modulation(1.0, 0.5) == pytest.approx(np.exp(-2))
    assert sensor.transfer_modulation(0.1, 0.25) == pytest.approx(np.exp(-0.1))
    assert sensor.transfer_modulation(3.0, 0.0) == 1.0


def test_behr_equations_3_17_and_3_18_line_resolution():
    across, down = sensor.line_resolution(512), sensor.line_resolution(480)
    printed("R_h LP", across, 256, 9)
    printed("R_v LP", down, 240, 9)
    printed("R_h LP/mm", across / 8.8, 29, 0)
    printed("R_v LP/mm", down / 6.6, 36, 0)


def test_behr_equations_3_19_to_3_22_sizes():
    printed("X_SEL µm", sensor.element_um(8.8, 384), 22.9, 1)
    printed("Y_SEL µm", sensor.element_um(6.6, 485), 13.6, 1)
    # A line raster of 5 mm, as many pixels as the printed sizes give.
    printed("X_PIX µm", sensor.pixel_um(5.0, 5000 / 17.2), 17.2, 9)
    printed("Y_PIX µm", sensor.pixel_um(5.0, 5000 / 14.4), 14.4, 9)


@pytest.mark.parametrize(("size", "limit"), [(22.9, 21.8), (13.6, 36.8), (17.2, 29.1), (14.4, 34.7)])
def test_behr_equation_3_23_and_table_3_4_nyquist_frequency(size, limit):
    printed(f"f_N LP/mm of {size} µm", float(sensor.nyquist(size)), limit, 1)


def test_behr_table_3_3_noise_budget():
    budget = NoiseBudget(1e6, 0.01 * 1e6, sensor.transfer_noise(1e6, 1e-5, 2000), sensor.amplifier_noise(0.25))
    printed("shot", budget.shot, 1000, 6)
    printed("dark", budget.dark, 100, 6)
    printed("amplifier", budget.amplifier, 200, 6)
    # The table prints ε = 1e-4 beside 200 electrons: its formula gives 632 with it, and 200 with 1e-5.
    printed("transfer, ε = 1e-5", budget.transfer, 200, 6)
    printed("transfer, ε = 1e-4", sensor.transfer_noise(1e6, 1e-4, 2000), 632, 0)
    # Its total is the plain sum; independent sources add by their squares.
    printed("plain sum", budget.plain_sum, 1500, 6)
    printed("root of the sum of squares (table: 1500)", budget.total, 1044, 0)


def test_behr_section_3_6_4_dark_current_doubles_in_ten_degrees():
    assert sensor.dark_at(3.0, 35.0, 25.0) == pytest.approx(6.0)
    assert sensor.dark_at(3.0, 5.0, 25.0) == pytest.approx(0.75)


def test_behr_equations_4_5_to_4_7_jitter():
    printed("Δs px, eq. 4.5 (as a product)", sensor.jitter_pixels(20e-9, 10e6), 0.2, 9)
    # Eq. 4.7 prints a step of 255 and the result of the step of 100 that the text before it names.
    printed("Δg, step 100", sensor.jitter_grey(20e-9, 100, 100e-9), 20, 9)
    printed("Δg, step 255", sensor.jitter_grey(20e-9, 255, 100e-9), 51, 9)


def test_apertures_are_fourier_transforms():
    frequency = np.array([0.0, 20.0, 60.0, 130.0])
    x = (np.arange(4000) + 0.5) / 4000 * 3.2 - 1.6
    box = np.abs(np.exp(-2j * pi * np.multiply.outer(frequency, x / 1000)).mean(-1))
    np.testing.assert_allclose(sensor.aperture_mtf(frequency, 3.2), box, atol=1e-7)
    grid = np.linspace(-1, 1, 1001)
    for v in (0.1, 0.5, 0.9):
        one = np.hypot(*np.meshgrid(grid, grid)) <= 1
        other = np.hypot(*np.meshgrid(grid - 2 * v, grid)) <= 1
        overlap = (one & other).sum() / one.sum()
        assert sensor.diffraction_mtf(100 * v, 100) == pytest.approx(overlap, abs=3e-3)
    assert sensor.diffraction_mtf(101.0, 100) == 0.0
    assert sensor.diffraction_cutoff(5.6, 550) == pytest.approx(324.675, abs=1e-3)


def test_impossible_values_are_refused():
    with pytest.raises(InputError, match="shorter than the period"):
        VideoNorm(625, 64e-6, 64e-6, 0, 1)
    with pytest.raises(InputError, match="Kell"):
        VideoNorm(625, 64e-6, 0, 0, 1, 1.4)
    with pytest.raises(InputError, match="positive"):
        NoiseBudget(0.0)
    with pytest.raises(InputError, match="positive"):
        sensor.diffraction_mtf(1.0, 0.0)

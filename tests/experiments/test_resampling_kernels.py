"""What the kernels do to a ramp, to an edge and to contrast; and that the package's kernels are these."""

import numpy as np
import pytest
import resampling_kernels as experiment

from photoplan.kernels.weights import KERNELS

PHASES = np.linspace(0, 1, 41)[:-1]
IN_PACKAGE = {
    "bilinear": "bilinear",
    "bicubic": "bicubic a = −0.5",
    "bicubic-1": "bicubic a = −1",
    "lanczos3": "Lanczos-3",
}


@pytest.mark.parametrize("kernel", ["bilinear", "bicubic a = −0.5"])
def test_ramp_is_reproduced(kernel):
    np.testing.assert_allclose(experiment.ramp_deviation(kernel, PHASES), 0, atol=1e-14)


@pytest.mark.parametrize(("kernel", "a"), [("bicubic a = −0.5", -0.5), ("bicubic a = −1", -1.0)])
def test_ramp_deviation_of_cubic_convolution_in_closed_form(kernel, a):
    computed = experiment.ramp_deviation(kernel, PHASES)
    np.testing.assert_allclose(computed, experiment.ramp_deviation_cubic(a, PHASES), atol=1e-14)


def test_bicubic_minus_one_moves_by_a_tenth_of_a_pixel_at_most():
    t = (3 - np.sqrt(3)) / 6
    assert experiment.ramp_deviation("bicubic a = −1", np.array([t]))[0] == pytest.approx(np.sqrt(3) / 18, abs=1e-14)
    fine = np.linspace(0, 1, 2001)[:-1]
    assert np.abs(experiment.ramp_deviation("bicubic a = −1", fine)).max() <= np.sqrt(3) / 18 + 1e-14


def test_lanczos_moves_by_a_fiftieth_of_a_pixel_at_most():
    fine = np.linspace(0, 1, 2001)[:-1]
    assert np.abs(experiment.ramp_deviation("Lanczos-3", fine)).max() == pytest.approx(0.0200, abs=5e-5)


@pytest.mark.parametrize("kernel", experiment.KERNELS)
@pytest.mark.parametrize("t", [0.0, 0.1, 0.25, 0.6, 0.8])
def test_edges_move_against_the_ramp_deviation(kernel, t):
    moved = experiment.edge_centroid_shift(kernel, t)
    assert moved == pytest.approx(-experiment.ramp_deviation(kernel, np.array([t]))[0], abs=1e-9)


@pytest.mark.parametrize("kernel", experiment.KERNELS)
def test_half_level_is_true_on_and_between_pixels(kernel):
    places = [0.0] if kernel == "nearest" else [0.0, 0.5]
    if kernel == "nearest":
        assert abs(experiment.half_level_shift(kernel, 0.0)) == pytest.approx(0.5, abs=1e-9)
        return
    for place in places:
        assert experiment.half_level_shift(kernel, place) == pytest.approx(0.0, abs=1e-6)


def test_figures_quoted_on_the_page():
    places = np.linspace(0, 0.98, 50)
    quoted = {"bilinear": 0.043, "bicubic a = −0.5": 0.049, "bicubic a = −1": 0.028, "Lanczos-3": 0.031}
    for kernel, value in quoted.items():
        worst = max(abs(experiment.half_level_shift(kernel, float(p))) for p in places)
        assert worst == pytest.approx(value, abs=6e-4)
    overshoots = {
        "nearest": 0.0,
        "bilinear": 0.0,
        "bicubic a = −0.5": 0.014,
        "bicubic a = −1": 0.042,
        "Lanczos-3": 0.020,
    }
    for kernel, value in overshoots.items():
        assert experiment.overshoot(kernel) == pytest.approx(value, abs=6e-4)
    drawn = {"bicubic a = −0.5": 0.07, "bicubic a = −1": 0.15, "Lanczos-3": 0.12}
    for kernel, value in drawn.items():
        assert experiment.overshoot(kernel, blur=0.0) == pytest.approx(value, abs=6e-3)
    contrast = {
        "nearest": (0.90, 0.76),
        "bilinear": (0.81, 0.57),
        "bicubic a = −0.5": (0.94, 0.72),
        "bicubic a = −1": (1.03, 0.79),
        "Lanczos-3": (1.01, 0.82),
    }
    for kernel, values in contrast.items():
        np.testing.assert_allclose(experiment.transfer(kernel, np.array([0.25, 0.4])), values, atol=6e-3)


@pytest.mark.parametrize("kernel", experiment.KERNELS)
def test_a_constant_keeps_its_contrast(kernel):
    assert experiment.transfer(kernel, np.array([0.0]))[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", IN_PACKAGE)
def test_the_packages_kernels_are_these(name):
    kernel = KERNELS[name]
    first = kernel.taps // 2 - 1
    columns = [int(np.flatnonzero(j - first == experiment.TAPS)[0]) for j in range(kernel.taps)]
    expected = experiment.weights(IN_PACKAGE[name], PHASES)[:, columns]
    np.testing.assert_allclose(kernel.weights(PHASES), expected, atol=1e-7)

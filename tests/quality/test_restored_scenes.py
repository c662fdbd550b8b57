"""Simulated scenes restored: the exact inverse for objects of whole pixels, least squares for any edge."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import convolve
from tools.blurred_scenes import FINE, NOISE, SIZE, any_edges, sharpness, taken, whole_pixels
from tools.thinned import some

from photoplan.errors import InputError
from photoplan.quality.curves import SpreadFunction
from photoplan.quality.restoration.design import DesignOptions, Sharpness, curve_transfer, design_filter
from photoplan.quality.restoration.restorer import SceneStatistics, block_spectra, fit_scene

INSIDE = np.s_[24:-24, 24:-24]


def rms(a):
    return float(np.sqrt(np.mean(a[INSIDE] ** 2)))


def transfer_at(frequency, seen, object_):
    """Modulation by the cross spectrum of whole lines, mean of rows and columns."""
    found = []
    for a, b in ((seen[INSIDE], object_[INSIDE]), (seen[INSIDE].T, object_[INSIDE].T)):
        window = np.hanning(a.shape[1])
        wave = window * np.exp(-2j * np.pi * frequency * np.arange(a.shape[1]))
        line_a, line_b = (a - a.mean()) @ wave, (b - b.mean()) @ wave
        found.append((line_a @ line_b.conj()).real / (line_b @ line_b.conj()).real)
    return float(np.mean(found))


@pytest.mark.parametrize("sigma", some([0.35, 0.5, 0.6], 2))
def test_exact_restoration_of_objects_of_whole_pixels(sigma):
    rng = np.random.default_rng(5)
    image, object_ = taken(whole_pixels(rng), sigma, rng)
    design = design_filter(sharpness(sigma), sharpness(sigma), options=DesignOptions("exact"))
    restored = convolve(image, design.kernel, mode="nearest")
    before, after = rms(image - object_), rms(restored - object_)
    mtf = transfer_at(0.3, image, object_), transfer_at(0.3, restored, object_)
    print(f"sigma {sigma}: rms {before:.2f} -> {after:.2f}, MTF(0.3) {mtf[0]:.3f} -> {mtf[1]:.3f}; {design.reason}")
    assert design.method == "exact"
    assert after <= before / 2
    assert mtf[1] > 0.9 > mtf[0]


@pytest.mark.parametrize("sigma", some([0.35, 0.5, 0.6], 2))
def test_no_ringing_at_edges_on_borders_of_pixels(sigma):
    rng = np.random.default_rng(5)
    scene = np.full((SIZE, SIZE), 50.0)
    scene[:, 128:] = 200.0
    image, _ = taken(np.kron(scene, np.ones((FINE, FINE))), sigma, rng, noise=0.0)
    kernel = design_filter(sharpness(sigma), sharpness(sigma), options=DesignOptions("exact")).kernel
    restored = convolve(image, kernel, mode="nearest")
    profile = (restored[128, 100:156] - 50.0) / 150.0
    ringing = max(float(profile.max()) - 1.0, -float(profile.min()))
    print(f"sigma {sigma}: ringing {100 * ringing:.2f} % of the step")
    assert ringing <= 0.02
    assert profile[26:30] == pytest.approx([0, 0, 1, 1], abs=0.02)


@pytest.mark.parametrize(("sigma", "bound"), some([(0.35, 0.57), (0.5, 0.5), (0.6, 0.52), (0.85, 0.57)], 2))
def test_least_squares_for_edges_in_any_place(sigma, bound):
    """No filter undoes what has folded back: what is left is stated, and less than the exact inverse leaves."""
    rng = np.random.default_rng(7)
    image, object_ = taken(any_edges(rng), sigma, rng)
    curve = sharpness(sigma).modulation()
    scene = fit_scene(block_spectra(image).mean(axis=0), curve_transfer(curve, curve), (0.1, 2.0))
    assert scene.noise == pytest.approx(NOISE, rel=0.1)
    design = design_filter(sharpness(sigma), sharpness(sigma), (scene,))
    left = rms(convolve(image, design.kernel, mode="nearest") - object_)
    before = rms(image - object_)
    print(f"sigma {sigma}: rms {before:.2f} -> {left:.2f} ({left / before:.2f}), noise {design.noise_gain:.1f} times")
    assert left < bound * before
    for factor in (0.3, 3.0):
        other = replace(scene, contrast=scene.contrast * factor)
        kernel = design_filter(sharpness(sigma), sharpness(sigma), (other,), DesignOptions("regularised")).kernel
        assert left < rms(convolve(image, kernel, mode="nearest") - object_)
    if sigma < 0.8:
        exact = design_filter(sharpness(sigma), sharpness(sigma), options=DesignOptions("exact"))
        assert left < rms(convolve(image, exact.kernel, mode="nearest") - object_)


def test_where_the_condition_does_not_hold():
    wide = Sharpness(SpreadFunction.symmetric([0.4, 0.22, 0.08]))
    with pytest.raises(InputError, match=r"A/Z = 0\.550"):
        design_filter(wide, wide, options=DesignOptions("exact"))
    with pytest.raises(InputError, match="noise and the contrast"):
        design_filter(wide, wide)
    design = design_filter(wide, wide, (SceneStatistics(0.5, 8.0),))
    print(design.reason)
    assert design.method == "regularised"
    assert "A/Z = 0.550" in design.reason


def test_designed_filters_keep_brightness_and_directions():
    x, y = sharpness(0.4), sharpness(0.6)
    for options in (DesignOptions("exact"), DesignOptions("regularised"), DesignOptions("exact", "separable")):
        kernel = design_filter(x, y, (SceneStatistics(0.5, 8.0),), options).kernel
        turned = design_filter(y, x, (SceneStatistics(0.5, 8.0),), options).kernel
        assert kernel.sum() == pytest.approx(1.0)
        assert turned == pytest.approx(kernel.T, abs=1e-9)
        # The blurred direction is sharpened more.
        middle = kernel.shape[0] // 2
        assert kernel[middle - 1, middle] < kernel[middle, middle - 1] < 0.0

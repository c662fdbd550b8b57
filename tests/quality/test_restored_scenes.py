"""Simulated scenes restored: the exact inverse for objects of whole pixels, least squares for any edge."""

import numpy as np
import pytest
from scipy.ndimage import convolve
from scipy.stats import norm

from photoplan.errors import InputError
from photoplan.quality.design import DesignOptions, Sharpness, design_filter
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.regularised import SceneStatistics
from photoplan.quality.spread import SpreadFunction

FINE = 8
SIZE = 256
NOISE = 0.5
INSIDE = np.s_[24:-24, 24:-24]
FREQUENCY = np.linspace(0.0, 2.0, 401)


def discrete_spread(sigma):
    """Of a Gaussian and the sensor's aperture, as an edge on the border of two pixels shows it."""

    def ramp(z):
        return z * norm.cdf(z / sigma) + sigma * norm.pdf(z / sigma)

    borders = np.arange(-20.5, 21.0)
    response = ramp(borders + 0.5) - ramp(borders - 0.5)
    return SpreadFunction.normalised(np.diff(response))


def sharpness(sigma):
    curve = MtfCurve(FREQUENCY, np.exp(-2 * (np.pi * sigma * FREQUENCY) ** 2) * np.sinc(FREQUENCY))
    return Sharpness(discrete_spread(sigma), curve)


def whole_pixels(rng):
    """Objects whose borders are borders of pixels (Kölbl's model)."""
    scene = np.full((SIZE, SIZE), 90.0)
    for _ in range(150):
        (col, row), (width, height) = rng.integers(0, SIZE, 2), rng.integers(1, 30, 2)
        scene[row : row + height, col : col + width] = rng.uniform(20, 230)
    return np.kron(scene, np.ones((FINE, FINE)))


def any_edges(rng):
    """Rectangles in any place and direction."""
    row, col = np.mgrid[: SIZE * FINE, : SIZE * FINE] / FINE
    scene = np.full(row.shape, 90.0)
    for _ in range(60):
        (x, y), angle, (width, height) = rng.uniform(0, SIZE, 2), rng.uniform(0, np.pi), rng.uniform(3, 40, 2)
        along = (col - x) * np.cos(angle) + (row - y) * np.sin(angle)
        across = (row - y) * np.cos(angle) - (col - x) * np.sin(angle)
        scene[(abs(along) < width) & (abs(across) < height)] = rng.uniform(20, 230)
    return scene


def taken(scene, sigma, rng, noise=NOISE):
    """The image: Gaussian blur, a pixel's aperture, sampled in the middle of the pixels, noise; and the object."""
    frequency = np.fft.fftfreq(scene.shape[0], 1 / FINE)
    blur = np.exp(-2 * (np.pi * sigma * frequency) ** 2) * np.sinc(frequency) / np.sinc(frequency / FINE)
    blur = blur * np.exp(2j * np.pi * frequency * (0.5 - 0.5 / FINE))
    image = np.fft.ifft2(np.fft.fft2(scene) * np.outer(blur, blur)).real[::FINE, ::FINE]
    return image + rng.normal(0, noise, image.shape), scene.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))


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


@pytest.mark.parametrize("sigma", [0.35, 0.5, 0.6])
def test_exact_restoration_of_objects_of_whole_pixels(sigma):
    rng = np.random.default_rng(5)
    image, object_ = taken(whole_pixels(rng), sigma, rng)
    design = design_filter(sharpness(sigma), sharpness(sigma))
    restored = convolve(image, design.kernel, mode="nearest")
    before, after = rms(image - object_), rms(restored - object_)
    mtf = transfer_at(0.3, image, object_), transfer_at(0.3, restored, object_)
    print(f"sigma {sigma}: rms {before:.2f} -> {after:.2f}, MTF(0.3) {mtf[0]:.3f} -> {mtf[1]:.3f}; {design.reason}")
    assert design.method == "exact"
    assert after <= before / 2
    assert mtf[1] > 0.9 > mtf[0]


@pytest.mark.parametrize("sigma", [0.35, 0.5, 0.6])
def test_no_ringing_at_edges_on_borders_of_pixels(sigma):
    rng = np.random.default_rng(5)
    scene = np.full((SIZE, SIZE), 50.0)
    scene[:, 128:] = 200.0
    image, _ = taken(np.kron(scene, np.ones((FINE, FINE))), sigma, rng, noise=0.0)
    restored = convolve(image, design_filter(sharpness(sigma), sharpness(sigma)).kernel, mode="nearest")
    profile = (restored[128, 100:156] - 50.0) / 150.0
    ringing = max(float(profile.max()) - 1.0, -float(profile.min()))
    print(f"sigma {sigma}: ringing {100 * ringing:.2f} % of the step")
    assert ringing <= 0.02
    assert profile[26:30] == pytest.approx([0, 0, 1, 1], abs=0.02)


@pytest.mark.parametrize(("sigma", "bound"), [(0.35, 0.57), (0.5, 0.5), (0.6, 0.52), (0.85, 0.57)])
def test_least_squares_for_edges_in_any_place(sigma, bound):
    """No filter undoes what has folded back: what is left is stated, and less than the exact inverse leaves."""
    rng = np.random.default_rng(7)
    image, object_ = taken(any_edges(rng), sigma, rng)
    scene = SceneStatistics(NOISE, float(np.sqrt((np.diff(image, axis=1) ** 2).mean() - 2 * NOISE**2)))
    design = design_filter(sharpness(sigma), sharpness(sigma), scene, DesignOptions("regularised"))
    left = rms(convolve(image, design.kernel, mode="nearest") - object_)
    before = rms(image - object_)
    print(f"sigma {sigma}: rms {before:.2f} -> {left:.2f} ({left / before:.2f}), noise {design.noise_gain:.1f} times")
    assert left < bound * before
    others = [
        design_filter(
            sharpness(sigma), sharpness(sigma), SceneStatistics(NOISE, scene.contrast * f), DesignOptions("regularised")
        )
        for f in (0.3, 3.0)
    ]
    assert all(left < rms(convolve(image, other.kernel, mode="nearest") - object_) for other in others)
    if sigma < 0.8:
        exact = design_filter(sharpness(sigma), sharpness(sigma))
        assert left < rms(convolve(image, exact.kernel, mode="nearest") - object_)


def test_where_the_condition_does_not_hold():
    wide = Sharpness(SpreadFunction.symmetric([0.4, 0.22, 0.08]))
    with pytest.raises(InputError, match=r"A/Z = 0\.550"):
        design_filter(wide, wide, options=DesignOptions("exact"))
    with pytest.raises(InputError, match="noise and the contrast"):
        design_filter(wide, wide)
    design = design_filter(wide, wide, SceneStatistics(0.5, 8.0))
    print(design.reason)
    assert design.method == "regularised"
    assert "A/Z = 0.550" in design.reason


def test_exact_inverses_that_amplify_noise_too_much_are_not_used():
    narrow = Sharpness(discrete_spread(0.72))
    design = design_filter(narrow, narrow, SceneStatistics(0.5, 8.0))
    print(design.reason)
    assert design.condition_x.holds
    assert design.method == "regularised"
    assert design.noise_gain < 6.0
    assert design_filter(narrow, narrow, options=DesignOptions("exact")).noise_gain > 6.0


def test_designed_filters_keep_brightness_and_directions():
    x, y = sharpness(0.4), sharpness(0.6)
    for options in (DesignOptions("exact"), DesignOptions("regularised"), DesignOptions("exact", "separable")):
        kernel = design_filter(x, y, SceneStatistics(0.5, 8.0), options).kernel
        turned = design_filter(y, x, SceneStatistics(0.5, 8.0), options).kernel
        assert kernel.sum() == pytest.approx(1.0)
        assert turned == pytest.approx(kernel.T, abs=1e-9)
        # The blurred direction is sharpened more.
        middle = kernel.shape[0] // 2
        assert kernel[middle - 1, middle] < kernel[middle, middle - 1] < 0.0

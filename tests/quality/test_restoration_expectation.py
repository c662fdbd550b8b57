"""Expected errors of filters: their mathematics, scenes found in images, and what is not known is not inverted."""

import numpy as np
import pytest
from rasterio.io import MemoryFile
from scipy.ndimage import convolve
from tools.blurred_scenes import (
    FREQUENCY,
    any_edges,
    diffraction,
    discrete_spread,
    fractal,
    gaussian,
    leaves,
    sharpened,
    sharpness,
    taken,
    white_texture,
)
from tools.thinned import some
from tools.unsupervised_wiener import unsupervised_wiener

from photoplan.errors import InputError
from photoplan.quality.curves import MtfCurve
from photoplan.quality.restoration.design import (
    DesignOptions,
    Expectation,
    Sharpness,
    at_frequencies,
    block_noise,
    curve_transfer,
    design_filter,
    image_noise,
    kept_by_compression,
    sharpest,
)
from photoplan.quality.restoration.restorer import SceneStatistics, block_spectra, fit_scene, scenes_of

SCENE = SceneStatistics(2.0, 12.0, 2.6)
INSIDE = np.s_[16:-16, 16:-16]
#: Of the scenes, 20 to 230.
RANGE = 210.0


def uncertain(sigma, doubt):
    one = sharpness(sigma)
    return Sharpness(one.spread, MtfCurve(FREQUENCY, one.curve.modulation, np.full(FREQUENCY.size, doubt)))


def gaussian_transfer(sigma, change=0.0):
    def transfer(u, v):
        known = np.exp(-2 * (np.pi * sigma) ** 2 * (u**2 + v**2)) * np.sinc(u) * np.sinc(v)
        return known + change, np.zeros_like(known)

    return transfer


def test_the_best_kernel_has_the_least_expected_error():
    expectation = Expectation.of(gaussian_transfer(0.6), SCENE)
    best = expectation.best((3, 4))
    assert best.shape == (7, 9) and best.sum() == pytest.approx(1.0)
    least = expectation.error(best)
    rng = np.random.default_rng(1)
    for _ in range(20):
        change = rng.normal(0.0, 0.02, best.shape)
        assert expectation.error(best + change - change.mean()) > least
    assert least < expectation.error(np.ones((1, 1)))


def test_expected_errors_of_known_kernels():
    """Nothing done to an ideal image leaves its noise; a scene much fainter than noise is best averaged away."""
    ideal = Expectation.of(gaussian_transfer(0.0), SceneStatistics(2.0, 5.0))
    assert ideal.error(np.ones((1, 1))) == pytest.approx(2.0)
    faint = Expectation.of(gaussian_transfer(0.0), SceneStatistics(2.0, 1e-3))
    assert faint.error(np.full((3, 3), 1 / 9)) == pytest.approx(2.0 / 3.0, rel=1e-3)
    assert faint.best((1, 1)) == pytest.approx(np.full((3, 3), 1 / 9), abs=1e-4)


def test_an_uncertain_transfer_function_has_the_mean_error_of_those_that_it_may_be():
    """E|K H - I|² over H = mean ± sigma is the same with either sign and a variance."""
    kernel = Expectation.of(gaussian_transfer(0.6), SCENE).best((5, 5))
    each = [Expectation.of(gaussian_transfer(0.6, sign * 0.05), SCENE).error(kernel) ** 2 for sign in (-1, 1)]

    def doubtful(u, v):
        known, nothing = gaussian_transfer(0.6)(u, v)
        return known, nothing + 0.05

    expectation = Expectation.of(doubtful, SCENE)
    assert expectation.error(kernel) ** 2 == pytest.approx(np.mean(each), rel=1e-9)
    # It is inverted less.
    assert (expectation.best((5, 5)) ** 2).sum() < (kernel**2).sum()


@pytest.mark.parametrize(("slope", "optics"), [(1.0, gaussian(0.6)), (1.4, diffraction(2.0))])
def test_scene_and_noise_are_found_in_an_image(slope, optics):
    rng = np.random.default_rng(2)
    image, object_ = taken(fractal(rng, slope, 192), optics, rng, noise=3.0)

    def transfer(u, v):
        return optics(np.hypot(u, v)) * np.sinc(u) * np.sinc(v), 0.0 * (u + v)

    scene = fit_scene(block_spectra(image).mean(axis=0), transfer, (0.5, 10.0))
    print(scene)
    assert scene.noise == pytest.approx(3.0, rel=0.03)
    assert scene.exponent == pytest.approx(2.0 * slope, abs=0.2)
    seen = np.sqrt(0.5 * ((np.diff(object_, axis=0) ** 2).mean() + (np.diff(object_, axis=1) ** 2).mean()))
    assert scene.contrast == pytest.approx(seen, rel=0.1)


def test_noise_stays_within_its_bounds_and_blocks_that_are_not_usable_do_not_count():
    rng = np.random.default_rng(3)
    grey = rng.normal(100.0, 2.0, (160, 160))
    assert block_spectra(grey).shape == (16, 64, 64)
    assert block_spectra(grey).mean() == pytest.approx(4.0, rel=0.05)
    assert fit_scene(block_spectra(grey).mean(axis=0), gaussian_transfer(0.5), (0.1, 1.5)).noise == pytest.approx(1.5)
    usable = np.ones(grey.shape, bool)
    usable[:, 150] = False
    assert len(block_spectra(grey, usable)) == 12
    grey[150] = np.nan
    assert len(block_spectra(grey, usable)) == 9
    assert block_spectra(grey[:40]).shape[1:] == (40, 40)


def test_a_direction_that_is_practically_unknown_stays_as_it_is():
    known, unknown = uncertain(0.6, 0.01), uncertain(0.6, 0.2)
    assert not known.doubt and "MTF50 0.2" in unknown.doubt
    design = design_filter(known, unknown, (SCENE,))
    assert design.kernel.shape == (1, 11)
    assert "practically unknown along columns: MTF50 0.28, interval" in design.reason
    assert design_filter(unknown, known, (SCENE,)).kernel.shape == (11, 1)
    for method in ("auto", "regularised", "exact"):
        with pytest.raises(InputError, match=r"unknown along rows: MTF50 .* along columns: MTF50 .* not inverted"):
            design_filter(unknown, unknown, (SCENE,), DesignOptions(method))
    with pytest.raises(InputError, match="unknown along rows"):
        design_filter(unknown, known, (SCENE,), DesignOptions("exact"))


@pytest.mark.parametrize("quality", some([60, 90], 0))
def test_noise_that_compression_has_smoothed_is_not_taken_for_the_scene(quality):
    """JPEG takes noise from high frequencies and from even blocks; the white noise that is left there is too little."""
    rng = np.random.default_rng(4)
    sharp, object_ = taken(0.75 * any_edges(rng, 192) + 0.25 * fractal(rng, 1.2, 192), 0.6, rng, noise=2.5)
    image = compressed(sharp, quality)
    noise = image_noise(block_noise(image))
    found = fit_scene(block_spectra(image).mean(axis=0), gaussian_transfer(0.6), (0.1 * noise, 30.0 * noise))
    print(found)
    assert found.smoothed > 0.3
    kernel = Expectation.of(gaussian_transfer(0.6), found).best((5, 5))
    restored = convolve(image, kernel, mode="mirror")
    before, after = (float(np.sqrt(np.mean((a - object_)[INSIDE] ** 2))) for a in (image, restored))
    print(f"quality {quality}: {before:.2f} -> {after:.2f}")
    assert after < 0.98 * before


def test_smoothed_noise_has_the_spectrum_that_is_stated():
    rng = np.random.default_rng(5)
    u = np.fft.fftfreq(256)
    smooth = np.exp(-2 * (np.pi * 0.6) ** 2 * (u**2 + u[:, None] ** 2))
    grey = np.fft.ifft2(np.fft.fft2(rng.normal(0.0, 2.0, (256, 256))) * smooth).real
    u = np.fft.fftfreq(64)
    stated = SceneStatistics(2.0, 1.0, smoothed=0.6).noise_power(u, u[:, None])
    for low, high in ((0.05, 0.2), (0.2, 0.35), (0.35, 0.5)):
        band = (np.hypot(u, u[:, None]) > low) & (np.hypot(u, u[:, None]) < high)
        assert block_spectra(grey).mean(axis=0)[band].mean() == pytest.approx(stated[band].mean(), rel=0.1)


def test_images_that_may_be_sharp_already_stay_as_they_are():
    scene = SceneStatistics(0.2, 8.0)
    known, doubtful = uncertain(0.15, 0.0), uncertain(0.15, 0.04)
    assert design_filter(known, known, (scene,)).method == "regularised"
    design = design_filter(doubtful, doubtful, (scene,))
    assert design.method == "none" and design.kernel.tolist() == [[1.0]]
    assert design.expected["regularised"] < design.expected["none"]
    assert "were the MTF at the upper end of its interval" in design.reason
    assert design_filter(doubtful, doubtful, (scene,), DesignOptions("regularised")).method == "regularised"


def test_auto_takes_what_is_expected_to_leave_the_least_error():
    """An exact inverse that is asked for says so where it is expected to be worse than the image."""
    design = design_filter(sharpness(0.6), sharpness(0.6), (SceneStatistics(3.0, 8.0),))
    assert design.method == "regularised"
    assert design.expected["regularised"] < design.expected["none"] < design.expected["exact"]
    asked = design_filter(sharpness(0.6), sharpness(0.6), (SceneStatistics(3.0, 8.0),), DesignOptions("exact"))
    assert asked.method == "exact" and "more error is expected than the image has" in asked.reason


def stored(image, bits):
    """Rounded to so many bits, and the step of a grey value."""
    step = 255.0 / (2**bits - 1)
    return np.clip(np.rint(image / step), 0, 2**bits - 1) * step, step


def designed(image, optics, **known):
    """The filter of an image whose transfer function is known."""
    curve = MtfCurve(FREQUENCY, optics(FREQUENCY) * np.abs(np.sinc(FREQUENCY)))
    even = image_noise(block_noise(image))
    scenes = scenes_of(block_spectra(image).mean(axis=0), curve_transfer(curve, curve), even, **known)
    one = Sharpness(discrete_spread(0.6), curve)
    return design_filter(one, one, scenes, kept=kept_by_compression(image[None]))


def left(image, object_, design, step=1.0):
    """Error after restoration by that before."""
    restored = np.rint(convolve(image, design.kernel, mode="mirror") / step) * step
    before, after = (float(np.sqrt(np.mean((a - object_)[INSIDE] ** 2))) for a in (image, restored))
    print(f"{before:.2f} -> {after:.2f}: {design.reason}")
    return after / before


def compressed(image, quality):
    """As JPEG leaves it."""
    rows, columns = image.shape
    with MemoryFile() as memory:
        with memory.open(driver="JPEG", width=columns, height=rows, count=1, dtype="uint8", quality=quality) as file:
            file.write(np.clip(np.rint(image), 0, 255).astype(np.uint8), 1)
        with memory.open() as file:
            return file.read(1).astype(float)


def textures(kind, rng, size=192):
    """Fine texture that fills the image, alone or with edges; or leaves that cover each other."""
    white = white_texture(rng, size)
    if kind == "white":
        return white
    if kind == "half":
        scene = any_edges(rng, size)
        scene[:, : scene.shape[1] // 2] += white[:, : scene.shape[1] // 2] - 125.0
        return np.clip(0.7 * scene + 40.0, 0.0, 255.0)
    if kind in ("edges", "fractal"):
        coarse = any_edges(rng, size) if kind == "edges" else fractal(rng, 1.5, size)
        return np.clip(0.6 * coarse + 50.0 + 0.35 * (white - 125.0), 0.0, 255.0)
    if kind == "leaves":
        return leaves(rng, size)
    return fractal(rng, float(kind), size)


#: Sigma of the blur, noise ratio, bits, and how much was sharpened with which radius.
SHARP = {"none": (0.45, 200, 8, None), "little": (0.3, 1000, 16, None), "sharpened": (0.6, 500, 16, (1.5, 0.8))}


def texture_case(kind, name, seed):
    """Error after restoration by that before, and the design."""
    rng = np.random.default_rng(seed)
    sigma, snr, bits, enhancement = SHARP[name]
    optics = gaussian(sigma)
    image, object_ = taken(textures(kind, rng), optics, rng, noise=RANGE / snr)
    if enhancement is not None:
        image, optics = sharpened(image, optics, *enhancement)
    image, step = stored(image, bits)
    design = designed(image, optics)
    return left(image, object_, design, step), design


@pytest.mark.parametrize(("kind", "name"), some([("white", "sharpened"), ("edges", "little"), ("fractal", "none")], 0))
def test_texture_that_may_be_noise_stays_as_it_is(kind, name):
    """Taken for noise it was smoothed: 1.8, 1.8 and 1.3 times the error that the image had."""
    ratio, design = texture_case(kind, name, 13)
    assert ratio <= 1.0
    assert design.method == "none" and design.kernel.tolist() == [[1.0]]
    assert "fine texture and noise cannot be told apart" in design.reason


@pytest.mark.slow
def test_texture_that_compression_has_erased_is_not_sharpened():
    """The borders of compressed blocks were sharpened in its place: 1.1 times the error."""
    rng = np.random.default_rng(16)
    image, object_ = taken(textures("leaves", rng), gaussian(0.45), rng, noise=2.0)
    design = designed(compressed(image, 60), gaussian(0.45))
    assert design.method == "none" and "compression has left" in design.reason
    design = designed(compressed(image, 95), gaussian(0.45))
    assert design.method == "regularised"
    assert left(compressed(image, 95), object_, design) < 0.9


def test_what_compression_has_kept_is_found_in_the_pixels():
    rng = np.random.default_rng(17)
    image, _ = taken(textures("leaves", rng), gaussian(0.6), rng, noise=2.0)
    assert (kept_by_compression(stored(image, 8)[0][None]) == 1.0).all()
    strong, weak = (kept_by_compression(compressed(image, quality)[None]) for quality in (50, 90))
    assert strong[0, 0] > 0.99 and strong[7, 7] == 0.0
    assert 1.0 > weak.mean() > strong.mean() + 0.2
    base = np.arange(8) / 16
    assert at_frequencies(strong, -base, base[:, None]) == pytest.approx(strong)


def test_noise_that_is_stated_tells_texture_from_it():
    rng = np.random.default_rng(14)
    image, object_ = taken(white_texture(rng, 192), gaussian(0.45), rng, noise=1.0)
    assert designed(image, gaussian(0.45)).method == "none"
    design = designed(image, gaussian(0.45), stated=1.0)
    assert design.method == "regularised"
    assert left(image, object_, design) < 0.7


def test_what_is_known_of_a_sharpened_image_stays_when_it_may_be_sharper():
    def enhanced(u, v):
        return 1.3 + 0.0 * (u + v), 0.1 + 0.0 * (u + v)

    modulation, sigma = sharpest(enhanced)(np.zeros(3), np.zeros(3))
    assert modulation.tolist() == [1.3] * 3 and sigma.tolist() == [0.0] * 3


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white", "edges", "fractal", "half", "leaves", "0.5", "0.75", "1.0"])
def test_no_texture_is_made_worse(kind):
    for name in SHARP:
        assert texture_case(kind, name, 15)[0] <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white", "edges", "fractal", "half", "leaves", "0.5", "0.75", "1.0"])
def test_no_compressed_texture_is_made_worse(kind):
    for sigma, quality in ((0.45, 60), (0.6, 90), (0.6, 75)):
        rng = np.random.default_rng(18)
        image, object_ = taken(textures(kind, rng), gaussian(sigma), rng, noise=2.0)
        image = compressed(image, quality)
        assert left(image, object_, designed(image, gaussian(sigma))) <= 1.0


OPTICS = {"gaussian 0.6": gaussian(0.6), "gaussian 0.9": gaussian(0.9), "diffraction 2": diffraction(2.0)}


def errors(scene, optics, snr, bits, rng):
    """Before, after restoration with the true transfer function, and of the unsupervised Wiener filter."""
    image, object_ = taken(scene, optics, rng, noise=RANGE / snr)
    image, step = stored(image, bits)
    design = designed(image, optics)
    assert design.method == "regularised"
    restored = np.rint(convolve(image, design.kernel, mode="mirror") / step) * step
    others = unsupervised_wiener(image, optics)
    before, after, other = (float(np.sqrt(np.mean((a - object_)[INSIDE] ** 2))) for a in (image, restored, others))
    print(f"{before:.3f} -> {after:.3f}, expected {design.expectation}; unsupervised Wiener {other:.3f}")
    assert design.expected["none"] == pytest.approx(before, rel=0.06)
    assert design.expected["regularised"] == pytest.approx(after, rel=0.06)
    return before, after, other


@pytest.mark.parametrize(("name", "snr", "bits"), some([("gaussian 0.6", 50, 8), ("diffraction 2", 200, 16)], 0))
def test_restored_images_are_as_good_as_those_of_the_unsupervised_wiener_filter(name, snr, bits):
    rng = np.random.default_rng(11)
    scene = 0.7 * any_edges(rng, 192) + 0.3 * fractal(rng, 1.2, 192)
    before, after, other = errors(scene, OPTICS[name], snr, bits, rng)
    assert after < 1.005 * other
    assert after < before


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["edges", "fractal 1", "fractal 1.5"])
@pytest.mark.parametrize("name", OPTICS)
def test_all_optics_and_noises_against_the_unsupervised_wiener_filter(kind, name):
    rng = np.random.default_rng(12)
    scene = any_edges(rng) if kind == "edges" else fractal(rng, float(kind.split()[1]))
    for snr in (50, 100, 200):
        for bits in (8, 16):
            before, after, other = errors(scene, OPTICS[name], snr, bits, rng)
            assert after < 1.005 * other
            assert after < before

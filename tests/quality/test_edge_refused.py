"""Regions that give no figure: each is refused with its reason, and never answered with a number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from tools.edges import edge_image, gaussian, true_mtf50
from tools.thinned import thinned

from photoplan.errors import InputError
from photoplan.quality.edges.response import EdgeSettings, measure_edge

SHAPE = (100, 60)


def _clean(seed=1, noise=0.02, angle=6.0, through=(29.3, 50.2)):
    random = np.random.default_rng(seed)
    return edge_image(SHAPE, angle, through, gaussian(0.7)) + random.normal(0.0, noise, SHAPE)


def _refused(image, words, **options):
    with pytest.raises(InputError, match=words):
        measure_edge(image, **options)


@thinned("count", 6, 20)
def test_the_clean_edge_is_measured(count):
    for seed in range(count):
        edge = measure_edge(_clean(seed), limits=(-1.0, 2.0))
        assert edge.mtf50 == pytest.approx(true_mtf50(6.0, gaussian(0.7)), rel=0.1)


@pytest.mark.parametrize("seed", range(10))
def test_noise_alone_is_no_edge(seed):
    image = np.random.default_rng(seed).normal(100.0, 3.0, SHAPE)
    _refused(image, "no edge|too narrow|noisy|too short|not even")


def test_a_constant_region_is_no_edge():
    _refused(np.full(SHAPE, 7.0), "no edge")


def test_a_ramp_is_no_edge():
    _refused(np.tile(np.linspace(0.0, 1.0, 60), (100, 1)) + _clean() * 0.0, "no edge|too narrow")


@pytest.mark.parametrize("seed", range(5))
def test_smooth_texture_alone_is_no_edge(seed):
    image = gaussian_filter(np.random.default_rng(seed).normal(0.0, 1.0, SHAPE), 3.0) * 50.0
    _refused(image, "no edge|too narrow|noisy|too short|not even|bent")


@pytest.mark.parametrize(("low", "high", "side"), [(-1.0, 0.99, "bright"), (0.03, 2.0, "dark")])
def test_a_clipped_side_is_refused(low, high, side):
    _refused(np.clip(_clean(), low, high), f"saturated edge: .* % of the pixels on its {side}", limits=(low, high))


def test_an_edge_drowned_in_noise_is_refused():
    _refused(_clean(noise=0.35), "noisy")


def test_an_edge_that_says_hardly_anything_is_refused():
    image = edge_image((14, 40), 4.0, (19.3, 7.2), gaussian(0.4))
    random = np.random.default_rng(2)
    _refused(image + random.normal(0.0, 0.17, image.shape), "noisy or too short: MTF50 would be")


def test_a_second_edge_is_refused():
    second = edge_image(SHAPE, 186.0, (42.0, 50.2), gaussian(0.7))
    _refused(_clean() + second - 1.0, "not even|no edge")
    step = 0.5 * edge_image(SHAPE, 6.0, (42.0, 50.2), gaussian(0.7))
    _refused(_clean() + step, "a second edge 1[23].* pixels beside")


@pytest.mark.parametrize("height", [3.0, 10.0])
def test_a_line_beside_a_step_is_refused(height):
    """Its overshoot would be hundreds of percent."""
    end = edge_image(SHAPE, 6.0, (31.3, 50.2), gaussian(0.7))
    _refused((1.0 + height) * _clean(noise=0.002) - height * end, "no edge but a line: .* % of the step beyond")


@thinned("count", 40, 60)
def test_figures_that_are_not_determined_are_not_known(count):
    """Edges of 20 rows along the pixels, SNR 5.6: widths have intervals above 0, or no value."""
    random = np.random.default_rng(3)
    widths = []
    for _ in range(count):
        image = edge_image((20, 40), 0.0, (19.3, 10.0), gaussian(0.4)) + random.normal(0.0, 0.18, (20, 40))
        try:
            edge = measure_edge(image)
        except InputError:
            continue
        widths.append((edge.fwhm, *edge.fwhm_interval))
    known = np.array([np.isfinite(each) for each in widths])
    assert (known.all(axis=1) == known.any(axis=1)).all() and 0 < known.all(axis=1).sum() < len(widths)
    assert all(low > 0.0 for _, low, _ in np.array(widths)[known.all(axis=1)])


def test_a_corner_is_refused():
    corner = np.minimum(
        edge_image(SHAPE, 6.0, (29.3, 50.0), gaussian(0.7)), edge_image(SHAPE, 96.0, (29.0, 45.0), gaussian(0.7))
    )
    _refused(corner + np.random.default_rng(1).normal(0.0, 0.02, SHAPE), "not even")


@pytest.mark.parametrize("seed", range(5))
def test_a_textured_side_is_refused(seed):
    random = np.random.default_rng(seed)
    texture = gaussian_filter(random.normal(0.0, 1.0, SHAPE), 2.0)
    texture *= 0.1 / texture.std()
    dark = edge_image(SHAPE, 186.0, (29.3, 50.2), gaussian(0.7))
    _refused(_clean(seed) + texture * dark, "not even: .* of .* % of the step")


def test_a_bent_edge_is_refused_and_the_parabola_named():
    rows, columns = np.mgrid[:100, :60].astype(float)
    image = 1.0 / (1.0 + np.exp(-2.0 * (columns - 30.0 - 0.06 * rows - 0.0012 * (rows - 50.0) ** 2)))
    image += np.random.default_rng(2).normal(0.0, 0.02, SHAPE)
    _refused(image, "bent edge: .* degree 2")
    measure_edge(image, settings=EdgeSettings(curve=2))


def test_a_short_edge_is_refused():
    image = edge_image((10, 60), 5.0, (29.3, 5.0), gaussian(0.7)) + np.random.default_rng(3).normal(0.0, 0.01, (10, 60))
    _refused(image, "too short: 10.0 pixels, at least 12")


def test_a_narrow_region_is_refused():
    image = edge_image((60, 12), 2.0, (5.3, 30.0), gaussian(3.0)) + np.random.default_rng(3).normal(0.0, 0.01, (60, 12))
    _refused(image, "too narrow")


@pytest.mark.parametrize("shape", [(3, 50), (50, 3), (0, 0)])
def test_hardly_any_pixels_are_refused(shape):
    _refused(np.zeros(shape), "8 × 8")


def test_other_shapes_and_empty_masks_are_refused():
    _refused(np.zeros((3, 50, 50)), "rows and columns")
    _refused(np.full(SHAPE, np.nan), "valid pixels")
    _refused(_clean(), "mask like it", valid=np.ones((5, 5), bool))


def _any_region(random):
    """Rubbish of many kinds: noise, steps of few grey values, single pixels, lines, holes, huge and tiny numbers."""
    shape = tuple(random.integers(8, 40, 2))
    image = random.normal(0.0, 1.0, shape) * 10.0 ** random.integers(-12, 12)
    kind = random.integers(6)
    if kind == 0:
        image = np.round(image / np.abs(image).max())
    elif kind == 1:
        image = np.zeros(shape)
        image[tuple(random.integers(0, n) for n in shape)] = 1e6
    elif kind == 2:
        image[random.uniform(size=shape) < 0.7] = np.nan
    elif kind == 3:
        image = edge_image(shape, random.uniform(0.0, 360.0), (5.0, 5.0), gaussian(0.3))
    elif kind == 4:
        image[:, shape[1] // 2 :] = np.inf
    else:
        image = np.add.outer(np.arange(shape[0]) % 2, np.arange(shape[1]) // 9 % 2) * 1.0
    return image


@pytest.mark.filterwarnings("error")
@thinned("count", 25, 150)
def test_any_region_gives_figures_or_a_reason(count):
    random = np.random.default_rng(20)
    measured = 0
    for _ in range(count):
        image = _any_region(random)
        try:
            edge = measure_edge(image, limits=(-1e30, 1e30))
        except InputError as refusal:
            assert len(str(refusal)) > 10
        else:
            measured += 1
            assert 0.0 < edge.fwhm < max(image.shape) or np.isnan(edge.fwhm)
    assert measured < 40 * count / 150

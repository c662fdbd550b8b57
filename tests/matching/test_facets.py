"""Facets stereo vision against rendered truth, without files."""

from __future__ import annotations

import numpy as np
import pytest
from tools.thinned import some

from photoplan.geometry.grid import Window
from photoplan.kernels.facets import add_curvatures, solve_heights, variances
from photoplan.matching.facets.observe import (
    FILTERS,
    Pyramid,
    Roughness,
    Smoother,
    away_from_border,
    curvatures,
    halved,
)
from photoplan.matching.facets.reconstruct import facets_of


class Pixels:
    def __init__(self, values: np.ndarray) -> None:
        self.values = values.astype(np.float32)

    @property
    def size(self) -> tuple[int, int]:
        return self.values.shape[1], self.values.shape[0]

    def read(self, window: Window) -> np.ndarray:
        out = np.full((window.height, window.width), np.nan, np.float32)
        inside = window & Window(0, 0, *self.size)
        if inside.size:
            out[inside.slices(window)] = self.values[inside.slices(Window(0, 0, *self.size))]
        return out


@pytest.mark.parametrize("span", FILTERS)
def test_levels_keep_places_and_means(span: int) -> None:
    """Pixel i of a level lies at i · 2^level: a slow wave is found again there, at each level."""
    y, x = np.mgrid[:700, :900]
    image = 100 + 30 * np.sin(x / 40 + 0.3) * np.cos(y / 50)
    pyramid = Pyramid(Pixels(image), span)
    assert FILTERS[span].sum() == pytest.approx(1)
    for level in (1, 2):
        got = pyramid.read(level, Window(20, 10, 300 // level, 290 // level))
        want = image[10 << level :: 1 << level, 20 << level :: 1 << level][: got.shape[0], : got.shape[1]]
        assert got.shape == want.shape and np.abs(got - want)[:-6, :-6].max() < 0.6
    assert pyramid.size(2) == (225, 175)
    assert np.isnan(pyramid.read(1, Window(-3, 0, 2, 2))).all()


def test_coarse_levels_are_made_once() -> None:
    """However many windows of fine levels are read in between; they are made of all of the image."""

    class Counted(Pixels):
        seen = 0

        def read(self, window: Window) -> np.ndarray:
            self.seen += window.size
            return super().read(window)

    image = Counted(np.zeros((2048, 2048)))
    pyramid = Pyramid(image, kept=12 * 256**2 * 4)
    coarse = pyramid.read(3, Window(0, 0, 256, 256))
    before = image.seen
    for row in range(0, 1024, 256):
        for col in range(0, 1024, 256):
            pyramid.read(1, Window(col, row, 256, 256))
    assert image.seen > 1.5 * before
    before = image.seen
    np.testing.assert_array_equal(pyramid.read(3, Window(0, 0, 256, 256)), coarse)
    assert image.seen == before


def test_the_widest_filter_keeps_more_and_aliases_less() -> None:
    x = np.arange(2000.0)
    for length, least, most in ((6.0, 0.85, 1.1), (2.6, 0.0, 0.12)):
        wave = np.tile(np.cos(2 * np.pi * x / length), (11, 1)).astype(np.float32)
        amplitude = halved(wave, FILTERS[11]).std() * np.sqrt(2)
        assert least < amplitude < most


def test_posts_of_a_level_are_the_same_for_every_window() -> None:
    from photoplan.geometry.grid import MapGrid

    grid = MapGrid(1000.0, 2000.0, 0.5, 300, 200, "EPSG:32633")
    a, b = (facets_of(grid, Window(col, 64, 64, 64), 2, 3) for col in (0, 64))
    assert (b.left - a.left) / a.pitch == 16 and a.pitch == 2.0
    fine = facets_of(grid, Window(64, 64, 32, 32), 0, 3, margin=0)
    assert (fine.posts[0, 0] == grid.to_map((64, 64))).all()


def ground(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Heights of 120 × 120 posts: waves of 40 posts, or a spectrum like that of terrain."""
    v, u = np.mgrid[:120, :120].astype(float)
    if kind == "waves":
        return 10 * np.sin(u / 6.4 + 0.4) * np.cos(v / 6.4)
    k = np.hypot(np.fft.fftfreq(120)[:, None], np.fft.fftfreq(120)[None])
    z = np.fft.ifft2(
        np.fft.fft2(rng.normal(size=(120, 120))) / np.maximum(k, 1e-2) ** (3.0 if kind == "rough" else 2.0)
    ).real
    return z * {"rough": 0.02, "fractal": 0.05}[kind]


@pytest.mark.parametrize("kind", some(["waves", "rough", "fractal"], 1))
def test_standard_deviations_hold_whatever_the_ground_is_like(kind: str) -> None:
    """Heights observed with a noise of 1, half of them three times worse; curvatures have estimated variances."""
    rng = np.random.default_rng(4)
    true = ground(kind, rng)
    sigma = np.where(np.arange(120) < 60, 1.0, 3.0) * np.ones((120, 1))
    seen = true + rng.normal(size=true.shape) * sigma
    pixels = np.zeros((7, 120, 120))
    pixels[0] = 1 / sigma**2
    inside = np.zeros((120, 120), bool)
    inside[6:-6, 6:-6] = True
    rough = Roughness.uniform((120, 120), 10.0)
    noise = rng.choice((-1.0, 1.0), size=true.shape) / sigma

    def equations(stiffer: float = 1.0) -> np.ndarray:
        out = pixels.copy()
        add_curvatures(stiffer * rough.weights, out)
        return out

    def solve(rights) -> np.ndarray:
        out = np.zeros((len(rights), 120, 120))
        for right, x in zip(rights, out):
            solve_heights(equations(), right, 500, 1e-4, x)
        return out

    signs = rng.choice((-1.0, 1.0), size=(3, *inside.shape))
    smoother = Smoother(solve, noise, inside, signs)
    for _ in range(8):
        (heights,) = solve([seen / sigma**2])
        rough = rough.estimated(heights, smoother)
    (heights,) = solve([seen / sigma**2])
    found = np.empty((2, 120, 120))
    for out, stiffer in zip(found, (1.0, 1.2)):
        variances(equations(stiffer), 24, 8, out)
    claimed = sum(rough.sandwich(heights, smoother, found, 1.2))
    normalised = (heights - true) / np.sqrt(claimed)
    for half in (slice(8, 52), slice(68, 112)):
        assert 0.8 < np.sqrt(np.mean(normalised[8:-8, half] ** 2)) < 1.25
    assert np.sqrt(np.mean((heights - true)[8:-8, 8:52] ** 2)) < 0.9


def test_the_pull_of_curvatures_is_half_the_gradient_of_their_sum() -> None:
    rng = np.random.default_rng(4)
    heights = rng.normal(size=(60, 60))
    rough = Roughness.uniform((60, 60), 0.5)
    slope, step = rough.gradient(heights), np.zeros_like(heights)
    step[30, 30] = 1e-4
    sums = [(rough.weights * curvatures(heights + s) ** 2).sum() / 2 for s in (step, -step)]
    assert slope[30, 30] == pytest.approx((sums[0] - sums[1]) / 2e-4, rel=1e-5)


def test_a_breakline_bends_more_than_its_hill_and_a_hill_is_none() -> None:
    """Curvatures of a smooth hill, all far larger than their band's variance, count; those of a ditch do not."""
    v, u = np.mgrid[:120, :120].astype(float)
    hill = 10 * np.sin(u / 6.4 + 0.4) * np.cos(v / 6.4)
    roughness = Roughness.uniform(hill.shape, 0.02)
    inner = (slice(None), slice(12, -12), slice(12, -12))
    factors = roughness.around(hill).factors[inner]
    assert np.percentile(factors, 5) > 0.4 and 0.9 < np.median(factors) < 1.3
    ditch = roughness.around(hill - 5 * (np.abs(u - 60) < 2)).factors
    assert ditch[0, 12:-12, 58:63:4].max() < 0.1 and np.median(ditch[inner]) > 0.8
    flat = roughness.around(5.0 * (u > 60))
    assert flat.factors[0, 30:90, 60].max() < 1e-3 and (flat.squares == roughness.squares).all()


def test_nothing_is_learnt_beside_what_two_images_do_not_see() -> None:
    seen = np.ones((60, 80), bool)
    assert away_from_border(seen, 6, 0.25).sum() == 48 * 68
    seen[:, :20] = False
    seen[30:33, 50:53] = False  # what something hides
    away = away_from_border(seen, 6, 0.25)
    assert not away[:, :26].any() and away[6:-6, 26:-6].sum() == 48 * 48 - 9 and away[29, 49]
    narrow = np.zeros((60, 80), bool)
    narrow[:, 30:43] = True
    assert away_from_border(narrow, 6, 0.25).sum() == 48 * 13

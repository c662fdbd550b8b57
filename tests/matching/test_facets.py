"""Facets stereo vision against rendered truth, without files."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.geometry.grid import Window
from photoplan.matching.facets.curvature import Roughness, curvatures
from photoplan.matching.facets.pyramid import FILTERS, Pyramid, halved
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


def test_roughness_is_estimated_in_patches() -> None:
    """Curvatures of known variance, ten times as rough on one half, pixels that know the heights well."""
    rng = np.random.default_rng(4)
    sigma = np.where(np.arange(120) < 60, 0.1, 1.0)
    heights = rng.normal(size=(120, 120)) * sigma
    from photoplan.matching.facets.curvature import SPANS, Known

    known = Known(np.full((3, 120, 120), 1e-9), np.full(len(SPANS), 1e-9))
    rough = Roughness.uniform((120, 120), 3.0)
    for _ in range(6):
        rough = rough.estimated(heights, known, np.full((120, 120), 1e6))
    # Differences of independent heights have 6 and 4 times their variance; Student's scale is somewhat less.
    for kind, times in ((0, 6), (1, 6), (2, 4)):
        left, right = rough.squares[kind, 20:100, 15:45].mean(), rough.squares[kind, 20:100, 75:105].mean()
        assert 0.5 < left / (0.01 * times) < 1.2 and 0.5 < right / times < 1.2
    slope = rough.gradient(heights)
    step = np.zeros_like(heights)
    step[50, 50] = 1e-4
    sums = [(rough.weights * curvatures(heights + s) ** 2).sum() / 2 for s in (step, -step)]
    assert slope[50, 50] == pytest.approx((sums[0] - sums[1]) / 2e-4, rel=1e-5)

"""The measuring tool itself: known shifts of a real photograph, and what it must refuse."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from scipy import ndimage

from tools.matching import Picture, gradients, match, robust_sd, smoothed

FINE = 0.05  # side of a pixel of the photograph, metres
CELL = 0.2  # side of a reference cell


def boxes(values, k):
    """Means of k × k cells."""
    rows, cols = (n // k for n in values.shape)
    return values[: rows * k, : cols * k].reshape(rows, k, cols, k).mean(axis=(1, 3))


@pytest.fixture(scope="module")
def photo(block):
    with rasterio.open(block / "images" / "DJI_0032.jpg") as data:
        return data.read().astype(float).mean(axis=0)[:800, :800]


def shifted(photo, east, north):
    """The photograph, its content moved by metres, as a picture of half the reference's cell."""
    moved = ndimage.shift(photo, (-north / FINE, east / FINE), order=5, mode="mirror")
    return Picture(boxes(moved, 2)[None], 0.0, 0.0, 2 * FINE)


def reference(photo):
    return Picture(boxes(photo, 4)[None], 0.0, 0.0, CELL)


SHIFTS = [(0.0, 0.0), (0.015, 0.035), (0.05, -0.075), (-0.1, 0.1), (0.23, -0.31)]


@pytest.mark.parametrize("east, north", SHIFTS)
def test_a_known_shift_of_a_real_photograph_is_found_to_a_twentieth_of_a_cell(photo, east, north):
    found = match(shifted(photo, east, north), reference(photo), patch=8, stride=8, search=0.6)
    assert len(found) >= 22  # of 5 × 5 patches
    assert np.abs(found.dx - east).max() < 0.05 * CELL
    assert np.abs(found.dy - north).max() < 0.05 * CELL
    assert found.quality.min() > 0.9


@pytest.mark.parametrize("east, north", SHIFTS[1:4])
def test_a_sparse_noisy_reference_of_other_radiometry_gives_the_same_shift(photo, east, north):
    rng = np.random.default_rng(7)
    values = reference(photo).values
    values = 40 + 0.4 * values + 4 * rng.standard_normal(values.shape)
    values[rng.random(values.shape) < 0.6] = np.nan
    sparse = Picture(values, 0.0, 0.0, CELL)
    found = match(shifted(photo, east, north), sparse, patch=8, stride=8, search=0.6, filled=0.3)
    assert len(found) >= 14
    assert abs(np.median(found.dx) - east) < 0.05 * CELL
    assert abs(np.median(found.dy) - north) < 0.05 * CELL


def test_gradients_see_through_a_slow_change_of_brightness(photo):
    shade = np.linspace(0, 300, photo.shape[1])[None, :]
    darker = reference(photo + shade)
    sharp = [gradients(p, 0.8 * CELL) for p in (shifted(photo, 0.05, -0.03), darker)]
    found = match(*sharp, patch=8, stride=8, search=0.6)
    assert len(found) >= 8
    assert np.abs(np.median(found.dx) - 0.05) < 0.05 * CELL
    assert np.abs(np.median(found.dy) + 0.03) < 0.05 * CELL


def test_gradient_of_a_ramp_is_its_slope_per_cell():
    row, col = np.mgrid[0:40, 0:50].astype(float)
    ramp = Picture((3 * col - 2 * row)[None], 0.0, 0.0, 5.0)
    along, down = gradients(ramp, 5.0).values
    assert np.allclose(along[np.isfinite(along)], 3, rtol=1e-3)
    assert np.allclose(down[np.isfinite(down)], -2, rtol=1e-3)
    assert np.isfinite(along).sum() == 32 * 42


def test_unrelated_pictures_have_no_quality(photo):
    noise = np.random.default_rng(3).standard_normal((1, 200, 200))
    found = match(shifted(photo, 0, 0), Picture(noise, 0.0, 0.0, CELL), patch=8, stride=8, search=0.6)
    assert (found.quality < 0.5).all()


def test_a_shift_beyond_the_search_range_is_not_reported(photo):
    found = match(shifted(photo, 1.5, 0.0), reference(photo), patch=8, stride=8, search=0.4)
    assert not (found.quality > 0.9).any()


def test_texture_in_one_direction_fixes_nothing():
    rng = np.random.default_rng(5)
    stripes = np.sin(np.arange(200) / 3.0)[None, None, :]
    one, other = (Picture(stripes + 0.002 * rng.standard_normal((1, 200, 200)), 0.0, 0.0, 1.0) for _ in range(2))
    assert len(match(one, other, patch=20, stride=20, search=5)) == 0


def test_smoothing_keeps_gaps_and_constants():
    values = np.full((1, 30, 30), 7.0)
    values[0, 10:20, 10:12] = np.nan
    smooth = smoothed(Picture(values, 0.0, 0.0, 1.0), 2.0).values
    assert np.array_equal(np.isnan(smooth), np.isnan(values))
    assert np.allclose(smooth[np.isfinite(smooth)], 7.0)


def test_robust_sd_of_normal_numbers_is_their_sd_and_ignores_a_tenth_of_wild_ones():
    values = np.random.default_rng(1).normal(5.0, 2.0, 20_000)
    assert robust_sd(values) == pytest.approx(2.0, rel=0.03)
    values[:2000] = 1e6
    assert robust_sd(values) == pytest.approx(2.0, rel=0.2)

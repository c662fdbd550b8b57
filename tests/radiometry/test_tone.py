"""Tables and gains: what becomes of grey values."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.radiometry.tone import Tone, powers_of, surface, toned

SIZE = (40, 30)
TONE = Tone((0.0, 100.0, 255.0), (10.0, 130.0, 200.0), ((1, 0, 0.2), (0, 2, -0.3)))


def test_a_table_is_linear_between_its_entries_and_goes_on_beyond_them() -> None:
    tone = Tone((50.0, 100.0, 200.0), (40.0, 140.0, 190.0))
    np.testing.assert_allclose(tone.table([50, 75, 150, 200]), [40, 90, 165, 190])
    np.testing.assert_allclose(tone.table([40, 220]), [20, 200])
    assert np.isnan(tone.table(np.nan))


@pytest.mark.parametrize(
    ("grey", "becomes", "words"),
    [
        ((0.0, 1.0), (0.0,), "2 grey values that become 1"),
        ((0.0, 0.0), (0.0, 1.0), "grey 0 comes after 0"),
        ((0.0, 9.0), (5.0, 4.0), "grey 0 becomes 5, but 9 becomes 4; a table may not fall"),
        ((0.0, np.inf), (5.0, 6.0), "no number"),
    ],
)
def test_tables_that_cannot_be_are_refused(grey: tuple[float, ...], becomes: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Tone(grey, becomes)


def test_surfaces_have_no_mean_over_the_image() -> None:
    """The mean over pixels differs from that over the area by the square of a pixel."""
    x, y = np.meshgrid(np.arange(400), np.arange(300))
    values = surface(x, y, (400, 300), powers_of(4))
    assert values.shape == (300, 400, 14)
    assert np.abs(values.mean(axis=(0, 1))).max() < 1e-5


def test_pixels_do_not_depend_on_the_window() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (1, 30, 40)).astype(np.uint8)
    whole = toned(pixels, Window(0, 0, *SIZE), SIZE, [TONE])
    part = toned(pixels[:, 7:20, 11:33], Window(11, 7, 22, 13), SIZE, [TONE])
    np.testing.assert_array_equal(part, whole[:, 7:20, 11:33])
    trend = 1 + 0.2 * (11 - 19.5) / 25 - 0.3 * (((7 - 14.5) / 25) ** 2 - (15 / 25) ** 2 / 3)
    assert whole[0, 7, 11] == np.rint(TONE.table(pixels[0, 7, 11] / trend))


def test_the_kernel_is_the_formula() -> None:
    """Random tables of unequal steps, trends of any powers, pixels before and beyond the table, NaN."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        grey = np.cumsum(rng.uniform(0.5, 60, rng.integers(2, 9))) - 30
        terms = tuple((int(i), int(j), float(c)) for i, j, c in zip(*rng.integers(0, 5, (2, 4)), rng.normal(0, 1, 4)))
        tone = Tone(tuple(grey.tolist()), tuple(np.cumsum(rng.uniform(0, 60, len(grey))).tolist()), terms)
        pixels = rng.uniform(-90, 400, (1, 30, 40)).astype(np.float32)
        pixels[0, 3, 5] = np.nan
        y, x = np.mgrid[:30, :40]
        expected = tone.table(pixels[0] / tone.trend(x, y, SIZE))
        np.testing.assert_allclose(toned(pixels, Window(0, 0, *SIZE), SIZE, [tone])[0], expected, rtol=2e-6, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("terms", [TONE.terms, ()])
def test_a_curve_becomes_light_before_the_trend(dtype: type, terms: tuple[tuple[int, int, float], ...]) -> None:
    curve = (5.0, 60.0, 240.0), (0.0, 110.0, 250.0)
    tone = Tone((0.0, 100.0, 255.0), (10.0, 130.0, 200.0), terms, curve)
    pixels = np.random.default_rng(0).integers(0, 256, (1, 30, 40)).astype(dtype)
    y, x = np.mgrid[:30, :40]
    grey = pixels[0].astype(float)
    light = np.where(grey < 60, (grey - 5) * 2, 110 + (grey - 60) * 140 / 180)
    expected = tone.table(light / tone.trend(x, y, SIZE))
    np.testing.assert_allclose(tone.of(pixels[0], x, y, SIZE), expected, rtol=1e-12)
    out = toned(pixels, Window(0, 0, *SIZE), SIZE, [tone])[0]
    if dtype != np.float32:
        expected = np.clip(np.rint(expected), 0, np.iinfo(dtype).max)
    np.testing.assert_allclose(out, expected, rtol=2e-6)
    without = Tone((0.0, 255.0), (0.0, 255.0), (), curve).at_mean_trend(256)
    np.testing.assert_allclose(without.table([5, 240]), [0, 250], atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
def test_integers_are_rounded_and_kept_in_their_range(dtype: type) -> None:
    steep = Tone((0.0, 100.0), (-50.0, 450.0 if dtype == np.uint8 else 90_000.0))
    pixels = np.array([[[0, 30, 100]]], dtype)
    out = toned(pixels, Window(0, 0, 3, 1), (3, 1), [steep])
    expected = steep.table(pixels[0])
    if dtype != np.float32:
        expected = np.clip(np.rint(expected), np.iinfo(dtype).min, np.iinfo(dtype).max)
    np.testing.assert_allclose(out[0], expected, rtol=1e-6)
    assert out.dtype == dtype

"""Marks in pixels: areas are exact, a mark lies at its reference point, an example looks like what it was cut from."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.cameras.fiducials import MarkExample, MarkPart, MarkPattern
from photoplan.errors import InputError
from photoplan.orientation.marks.locate import Template, coverage, render


def turned(pixels_per_mm: float, degrees: float, mirrored: bool = False) -> NDArray[np.float64]:
    """Millimetres x right, y up to columns and rows, turned anticlockwise as seen in the image."""
    a = np.deg2rad(degrees)
    rotation = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    flip = np.diag([-1.0, 1.0]) if mirrored else np.eye(2)
    return pixels_per_mm * np.diag([1.0, -1.0]) @ rotation @ flip


def disc(radius: float, sides: int = 90) -> NDArray[np.float64]:
    a = 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(a), np.sin(a)], axis=1)


def dot(radius: float = 0.2, tone: float = 1.0, background: float = 0.0) -> MarkPattern:
    return MarkPattern("dot", (MarkPart(disc(radius), tone),), background, (-0.5, -0.5, 0.5, 0.5))


def centroid(template: Template) -> NDArray[np.float64]:
    rows, columns = np.indices(template.values.shape)
    mass = template.values.astype(np.float64)
    return np.array([(mass * columns).sum(), (mass * rows).sum()]) / mass.sum()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_coverage_is_the_area_of_the_common_part(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 7))
    radii = rng.uniform(1, 6, 7)
    outline = rng.uniform(-2, 9, 2) + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    polygon = shapely.Polygon(outline).buffer(0)
    if polygon.geom_type != "Polygon" or abs(polygon.area - shapely.Polygon(outline).area) > 1e-9:
        return
    for each in (outline, outline[::-1]):
        share = coverage(each, (7, 8))
        for row, column in np.ndindex(7, 8):
            pixel = shapely.box(column - 0.5, row - 0.5, column + 0.5, row + 0.5)
            assert share[row, column] == pytest.approx(polygon.intersection(pixel).area, abs=1e-9)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.31, -0.44), (0.5, 0.5), (-7.3, 12.6)])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_symmetric_mark_lies_at_its_reference_point(offset: tuple[float, float], mirrored: bool) -> None:
    made = render(dot(), turned(40, 33, mirrored), offset=offset)
    np.testing.assert_allclose(centroid(made), made.reference, atol=0.002)
    beside = np.subtract(made.reference, offset)
    np.testing.assert_allclose(beside, np.round(beside), atol=1e-9)


def test_x_is_right_and_y_is_up_as_the_matrix_says() -> None:
    part = MarkPart(disc(0.05) + np.array([0.3, 0.2]), 1.0)
    pattern = MarkPattern("beside", (part,), 0.0, (-0.5, -0.5, 0.5, 0.5))
    upright = render(pattern, turned(40, 0))
    np.testing.assert_allclose(centroid(upright) - upright.reference, [12, -8], atol=0.01)
    left = render(pattern, turned(40, 90))
    np.testing.assert_allclose(centroid(left) - left.reference, [-8, -12], atol=0.01)
    mirrored = render(pattern, turned(40, 0, mirrored=True))
    np.testing.assert_allclose(centroid(mirrored) - mirrored.reference, [-12, -8], atol=0.01)


def test_later_parts_cover_earlier_ones_and_no_tone_is_not_compared() -> None:
    parts = (MarkPart(disc(0.4), 1.0), MarkPart(disc(0.2), 0.25), MarkPart(disc(0.1), np.nan))
    made = render(MarkPattern("rings", parts, np.nan, (-0.5, -0.5, 0.5, 0.5)), turned(100, 0), blur_px=1.0)
    x, y = (int(each) for each in made.reference)
    assert made.weights[y, x] == 0  # the middle has no tone
    assert made.values[y, x + 15] == pytest.approx(0.25, abs=1e-3)
    assert made.values[y, x + 30] == pytest.approx(1.0, abs=1e-3)
    assert made.weights[y, x + 30] == pytest.approx(1)
    assert made.weights[y, x + 45] == 0  # nor has the background
    assert made.weights.min() >= 0


def test_a_negative_exchanges_dark_and_bright() -> None:
    positive, negative = (render(dot(), turned(30, 10), negative=each) for each in (False, True))
    np.testing.assert_allclose(negative.values, 1 - positive.values, atol=1e-6)
    np.testing.assert_array_equal(negative.weights, positive.weights)


def test_a_turned_window_leaves_out_the_corners_of_the_template() -> None:
    made = render(dot(), turned(40, 45))
    assert made.weights[0, 0] == 0
    assert made.weights.sum() == pytest.approx(40 * 40, rel=1e-3)


def test_an_example_resampled_to_its_own_pixels_is_itself_without_grain() -> None:
    values = np.random.default_rng(3).uniform(20, 200, (31, 40))
    example = MarkExample("cut", values, (17.0, 12.0), 0.025)
    made = render(example, turned(40, 0))
    assert made.reference == (17.0, 12.0)
    smooth = ndimage.gaussian_filter((values - values.min()) / np.ptp(values), 0.8, mode="nearest")
    np.testing.assert_allclose(made.values, smooth, atol=1e-5)
    np.testing.assert_allclose(made.weights, 1, atol=1e-6)


@pytest.mark.parametrize(("scale", "degrees"), [(40.0, 90.0), (55.0, 20.0), (21.0, -35.0)])
def test_an_example_turned_and_scaled_looks_like_the_pattern_it_was_cut_from(scale: float, degrees: float) -> None:
    parts = (MarkPart(disc(0.3) * np.array([1.0, 0.5]), 0.2), MarkPart(disc(0.1) + np.array([0.2, 0.1]), 1.0))
    pattern = MarkPattern("uneven", parts, 0.6, (-0.8, -0.8, 0.8, 0.8))
    cut = render(pattern, turned(40, 0), blur_px=1.2, offset=(0.3, -0.2))
    example = MarkExample("cut", cut.values, cut.reference, 1 / 40)
    matrix = turned(scale, degrees)
    got = render(example, matrix)
    # Blur of the example grows with its enlargement; what shrinks was smoothed by the pixels it fills.
    blur = np.hypot(1.2, max(0.8, 0.5 * np.sqrt(max((40 / scale) ** 2 - 1, 0.0)))) * scale / 40
    want = render(pattern, matrix, blur_px=float(blur))
    dx, dy = (round(a - b) for a, b in zip(want.reference, got.reference, strict=True))
    height, width = (min(a, b) for a, b in zip(want.values.shape, got.values.shape, strict=True))
    both = [
        np.s_[max(dy, 0) + 1 : height - 2, max(dx, 0) + 1 : width - 2],
        np.s_[max(dy, 0) - dy + 1 : height - 2 - dy, max(dx, 0) - dx + 1 : width - 2 - dx],
    ]
    seen = (want.weights[both[0]] > 0.99) & (got.weights[both[1]] > 0.99)
    span = cut.values.max() - cut.values.min()
    low = cut.values.min()
    assert np.abs(want.values[both[0]] - (low + span * got.values[both[1]]))[seen].max() < 0.03


def test_missing_pixels_of_an_example_are_not_compared() -> None:
    values = np.random.default_rng(3).uniform(0, 1, (30, 30))
    values[:10] = np.nan
    made = render(MarkExample("cut", values, (15.0, 15.0), 0.025), turned(40, 0))
    assert made.weights[:9].max() == 0
    assert made.weights[12:].min() > 0.9
    assert np.isfinite(made.values).all()


def test_senseless_scales_are_refused() -> None:
    with pytest.raises(InputError, match="inverse"):
        render(dot(), np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"mark 'dot': 100000\d x 100000\d px"):
        render(dot(), turned(1e6, 0))
    with pytest.raises(InputError, match="px at this scale"):
        render(dot(), turned(1, 0))
    with pytest.raises(InputError, match="blur"):
        render(dot(), turned(40, 0), blur_px=float("nan"))
    with pytest.raises(InputError, match="contrast"):
        render(MarkExample("cut", np.ones((9, 9)), (4.0, 4.0), 0.025), turned(40, 0))

"""Features: where they lie, how they are spread, and that nothing but grey values decides."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from tools.ties import ArrayPixels

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.matching.features import (
    DESCRIPTOR_UNIT,
    Features,
    FeatureSettings,
    GreyImage,
    ReducedImage,
    extract_features,
    opencv,
    patches_at,
    to_bytes,
)


def texture(width: int = 400, height: int = 300, seed: int = 1) -> NDArray:
    noise = np.random.default_rng(seed).normal(size=(height, width))
    mixed = sum(s * ndimage.gaussian_filter(noise, s) for s in (1.5, 3, 6))
    return np.clip(127 + 40 * mixed / mixed.std(), 0, 255)


def grey(values: NDArray, **how: object) -> GreyImage:
    return GreyImage(ArrayPixels(values if values.ndim == 3 else values[None]), **how)


def same_places(a: Features, b: Features, limit: float) -> float:
    """Part of the features of a that have one of b so near."""
    gap = np.linalg.norm(a.xy[:, None] - b.xy[None], axis=-1).min(axis=1)
    return float((gap < limit).mean())


def test_blobs_are_found_where_they_are() -> None:
    row, col = np.mgrid[:120, :160]
    places = np.array([[40.25, 30.5], [110.7, 45.2], [80.0, 90.3]])
    values = 100.0 + sum(120 * np.exp(-((col - x) ** 2 + (row - y) ** 2) / 32) for x, y in places)
    found = extract_features(grey(values.astype(np.float32)), FeatureSettings(count=50))
    for place in places:
        assert np.linalg.norm(found.xy - place, axis=1).min() < 0.1


def test_reduced_images_give_features_in_pixels_of_the_full_image() -> None:
    row, col = np.mgrid[:360, :480]
    values = 100 + 120 * np.exp(-((col - 200.5) ** 2 + (row - 150.0) ** 2) / (2 * 12**2))
    found = extract_features(grey(values.astype(np.float32)), FeatureSettings(count=50, factor=3))
    nearest = np.linalg.norm(found.xy - (200.5, 150.0), axis=1).argmin()
    np.testing.assert_allclose(found.xy[nearest], (200.5, 150.0), atol=0.2)
    assert 8 < found.scale[nearest] < 18


def test_descriptors_are_unit_vectors_of_roots() -> None:
    found = extract_features(grey(texture().astype(np.uint8)), FeatureSettings(count=300))
    length = np.linalg.norm(found.descriptors.astype(float), axis=1) / DESCRIPTOR_UNIT
    np.testing.assert_allclose(length, 1.0, atol=0.02)


def test_sixteen_bits_give_the_features_of_eight() -> None:
    values = texture()
    a = extract_features(grey(values.astype(np.uint8)), FeatureSettings(count=2000))
    b = extract_features(grey((values * 200 + 1000).astype(np.uint16)), FeatureSettings(count=2000))
    assert len(a) > 200 and same_places(a, b, 0.5) > 0.93 and same_places(b, a, 0.5) > 0.93


def test_tiles_leave_no_trace() -> None:
    image = grey(texture(330, 300).astype(np.uint8))
    whole = extract_features(image, FeatureSettings(count=5000))
    tiled = extract_features(image, FeatureSettings(count=5000, tile=128))
    assert same_places(whole, tiled, 0.3) > 0.97 and same_places(tiled, whole, 0.3) > 0.97
    assert abs(len(whole) - len(tiled)) < 0.03 * len(whole)


def test_features_are_spread_although_one_corner_has_more_contrast() -> None:
    values = texture(600, 600)
    values = 127 + (values - 127) * np.where(np.add(*np.mgrid[:600, :600]) < 400, 1.0, 0.35)
    found = extract_features(grey(values.astype(np.uint8)), FeatureSettings(count=400))
    assert len(found) == 400
    quarter = np.histogram2d(*found.xy.T, bins=3, range=[[0, 600], [0, 600]])[0]
    assert quarter.min() > 0.5 * 400 / 9 and quarter.max() < 2 * 400 / 9


def test_margins_of_scans_and_invalid_pixels_have_no_features() -> None:
    values = texture().astype(np.uint8)
    area = (60.0, 40.0, 330.0, 250.0)
    found = extract_features(grey(values, area=area), FeatureSettings(count=2000))
    low, high = np.array(area[:2]), np.array(area[2:])
    room = np.minimum(found.xy - low, high - found.xy).min(axis=1)
    assert len(found) > 50 and (room > 5 * found.scale).all()
    valid = np.ones((300, 400), bool)
    valid[100:200, 150:250] = False
    found = extract_features(GreyImage(ArrayPixels(values[None], valid)), FeatureSettings(count=2000))
    inside = ((found.xy > (145, 95)) & (found.xy < (254, 204))).all(axis=1)
    assert len(found) > 100 and not inside.any()


def test_grey_is_the_one_of_the_stated_rule() -> None:
    rgb = np.stack([np.full((4, 5), v, np.uint8) for v in (200, 100, 50)])
    np.testing.assert_allclose(grey(rgb).read(Window(0, 0, 5, 4)), 0.299 * 200 + 0.587 * 100 + 0.114 * 50, rtol=1e-6)
    four = np.stack([np.full((4, 5), v, np.uint16) for v in (1000, 2000, 3000, 6000)])
    np.testing.assert_allclose(grey(four).read(Window(0, 0, 5, 4)), 3000)


def test_windows_beyond_the_image_have_no_values_there(monkeypatch: pytest.MonkeyPatch) -> None:
    image = grey(np.arange(20.0).reshape(4, 5))
    part = image.read(Window(-1, 2, 3, 4))
    np.testing.assert_array_equal(part, [[np.nan, 10, 11], [np.nan, 15, 16], [np.nan] * 3, [np.nan] * 3])
    corners = np.array([[-1, 2], [3, -2], [0, 0]])
    monkeypatch.setattr("photoplan.matching.features.TILE", 4)
    for patch, corner in zip(patches_at(image, corners, 3), corners):
        np.testing.assert_array_equal(patch, image.read(Window(*corner.tolist(), 3, 3)))


def test_reduced_image_holds_means() -> None:
    values = np.random.default_rng(2).uniform(0, 100, (9, 11))
    small = ReducedImage(grey(values), 2)
    assert small.size == (5, 4)
    want = values[:8, :10].reshape(4, 2, 5, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(small.read(Window(0, 0, 5, 4)), want, rtol=1e-5)


def test_bytes_of_an_empty_window() -> None:
    assert not to_bytes(np.full((2, 2), np.nan, np.float32), 0.0, 1.0).any()


def test_without_opencv_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UsageError, match=r"pip install 'photoplan\[match\]'"):
        opencv()

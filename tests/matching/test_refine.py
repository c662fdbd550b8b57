"""Refinement of tracks on rendered pictures whose geometry is known, and the accuracy that it states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from tools.ties import ArrayPixels

from photoplan.kernels.jit import COMPILED
from photoplan.matching.features import GreyImage, Tracks
from photoplan.matching.refine import (
    ASSUMED,
    RefineSettings,
    close_loops,
    disc,
    latin_weights,
    local_affines,
    reference_points,
    refine_tracks,
)

pytestmark = pytest.mark.skipif(not COMPILED, reason="many patches")

SIDE = 360
TURNS = (0.0, 0.6, -1.2)
SCALES = (1.0, 0.95, 1.04)


def affine(k: int) -> tuple[NDArray, NDArray]:
    """From the first picture to picture k."""
    c, s = SCALES[k] * np.cos(TURNS[k]), SCALES[k] * np.sin(TURNS[k])
    A = np.array([[c, -s], [s, c]]) @ np.array([[1.0, 0.03 * k], [0.0, 1.0]])
    middle = np.full(2, (SIDE - 1) / 2)
    return A, middle - A @ middle + np.array([3.3, -2.6]) * k


def pictures(noise: float, blur: float = 0.0, seed: int = 1) -> list[GreyImage]:
    """Three views of waves, known everywhere; noise of standard deviation `noise`, correlated by `blur`."""
    rng, out = np.random.default_rng(seed), []
    rng.uniform(size=450)  # of the waves
    for view, values in enumerate(waves(seed)):
        grains = rng.normal(size=(SIDE, SIDE))
        if blur:
            grains = ndimage.gaussian_filter(grains, blur)
            grains /= grains.std()
        seen = values + noise * grains
        out.append(GreyImage(ArrayPixels((seen * (1 - 0.1 * view) + 5 * view)[None].astype(np.float32))))
    return out


@cache
def waves(seed: int) -> tuple[NDArray, ...]:
    """The three views without noise."""
    rng = np.random.default_rng(seed)
    length, angle = rng.uniform(6, 30, 150), rng.uniform(0, 2 * np.pi, 150)
    k = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    phase = rng.uniform(0, 2 * np.pi, 150)
    row, col = np.mgrid[:SIDE, :SIDE].astype(float)
    views = []
    for view in range(3):
        A, t = affine(view)
        at = np.linalg.inv(A) @ (np.stack([col, row]).reshape(2, -1) - t[:, None])
        values = sum(np.cos(a * at[0] + b * at[1] + p) for (a, b), p in zip(k, phase))
        views.append(120 + 30 * values.reshape(SIDE, SIDE) / np.sqrt(75))
    return tuple(views)


def tracks(count: int, spoil: float, seed: int = 2) -> tuple[Tracks, NDArray]:
    """Tracks in three views with places and frames spoilt, and their true offsets from the first view's place."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(110, SIDE - 110, (count, 2))
    xy = np.stack([first @ affine(k)[0].T + affine(k)[1] for k in range(3)], axis=1)
    scale = np.array(SCALES)[None] * 2.0 * np.exp(rng.normal(0, 0.1, (count, 3)))
    angle = np.array(TURNS)[None] + rng.normal(0, 0.1, (count, 3)) + rng.uniform(0, 6, (count, 1))
    rows = np.repeat(np.arange(count), 3)
    spoilt = (xy + rng.normal(0, spoil, xy.shape)).reshape(-1, 2)
    none = np.full((3 * count, 2), np.nan)
    return Tracks(rows, np.tile(np.arange(3), count), spoilt, scale.ravel(), angle.ravel(), none), xy.reshape(-1, 2)


def errors(found: Tracks) -> NDArray:
    """Position minus the true one that belongs to the track's point in the first view, by pairs of views, pixels."""
    gap = []
    for t in range(found.count):
        here = np.flatnonzero(found.track == t)
        back = [np.linalg.solve(affine(found.image[k])[0], found.xy[k] - affine(found.image[k])[1]) for k in here]
        gap += [(back[j] - back[0]) for j in range(1, len(here))]
    return np.array(gap)


def test_refined_points_are_better_by_far_than_what_they_start_from() -> None:
    start, _ = tracks(120, 0.6)
    found = refine_tracks(start, pictures(1.0), RefineSettings())
    assert found.tracks.count >= 118 and len(found.tracks) >= 350
    assert np.sqrt((errors(found.tracks) ** 2).mean()) < 0.02
    assert np.sqrt((errors(start) ** 2).mean()) > 0.7
    assert found.correlation > 0.98
    whole = (found.tracks.xy == np.rint(found.tracks.xy)).all(axis=1)
    assert np.bincount(found.tracks.track[whole], minlength=found.tracks.count).tolist() == [1] * found.tracks.count


def test_wrong_matches_are_left_out() -> None:
    start, _ = tracks(60, 0.3)
    xy = start.xy.copy()
    wrong = (start.image == 1) & (start.track % 3 == 0)
    xy[wrong] += 37.0
    found = refine_tracks(replace(start, xy=xy), pictures(1.0), RefineSettings())
    assert found.unlike + found.unsettled + found.uncertain >= 18
    gross = np.abs(errors(found.tracks)).max(axis=1) > 0.1
    assert gross.sum() <= 1  # of 20: a place that happens to look alike


def test_patches_that_are_not_alike_enough_are_left_out() -> None:
    start, _ = tracks(40, 0.3)
    images = pictures(8.0)
    all_ = refine_tracks(start, images, RefineSettings())
    assert all_.unlike == 0 and 0.85 < all_.correlation < 0.97
    some = refine_tracks(start, images, RefineSettings(correlation=all_.correlation))
    assert 30 <= some.unlike <= 50 and some.tracks.count < 40
    none = refine_tracks(start, images, RefineSettings(sigma=0.01))
    assert none.tracks.count == 0 and none.uncertain >= 60 and none.uncertain + none.unsettled == 80


def test_patches_at_the_edge_and_on_invalid_pixels_are_left_out() -> None:
    images = pictures(1.0)
    values = images[1].pixels.values
    valid = np.ones(values.shape[1:], bool)
    valid[:, : SIDE // 2] = False
    holed = [images[0], GreyImage(ArrayPixels(values, valid)), images[2]]
    found = refine_tracks(tracks(80, 0.3)[0], holed, RefineSettings())
    left = found.tracks.xy[found.tracks.image == 1]
    assert len(left) > 15 and left[:, 0].min() > SIDE // 2 + 8
    assert np.abs(errors(found.tracks)).max() < 0.1


def test_image_by_image_in_any_order_gives_the_same() -> None:
    start, _ = tracks(40, 0.4)
    images = pictures(2.0)
    a = refine_tracks(start, images, RefineSettings())
    b = refine_tracks(start, images, RefineSettings(), run=lambda f, tasks: iter([f(t) for t in tasks]))
    np.testing.assert_array_equal(a.tracks.xy, b.tracks.xy)


def test_frames_of_neighbours_tell_how_images_are_turned() -> None:
    start, _ = tracks(100, 0.3)
    first, second = (np.flatnonzero(start.image == k) for k in (0, 2))
    found = local_affines(start, first, second)
    turn = np.arctan2(found[:, 1, 0], found[:, 0, 0])
    assert np.abs(turn - TURNS[2]).max() < 0.15
    assert np.abs(np.sqrt(np.linalg.det(found)) - SCALES[2]).max() < 0.15


def test_three_parts_of_a_patch_are_all_of_it_and_balanced() -> None:
    eye = np.eye(2)[None]
    parts = np.array([latin_weights(15, eye, k)[0] for k in range(3)])
    np.testing.assert_array_equal(parts.sum(axis=0), disc(15))
    share = parts.sum(axis=(1, 2)) / disc(15).sum()
    assert share.min() > 0.3 and share.max() < 0.37
    v, u = np.mgrid[-15:16, -15:16]
    for part in parts:
        assert abs((part * u).sum() / part.sum()) < 1.0 and abs((part * v).sum() / part.sum()) < 1.0


@pytest.mark.parametrize(("blur", "low", "high"), [(0.0, 1.2, 1.9), (0.8, 2.0, 3.0)], ids=["white", "correlated"])
def test_loops_tell_by_how_much_the_fit_is_too_sure(blur: float, low: float, high: float) -> None:
    """Noise of neighbouring pixels that is alike, as film grain and JPEG have it, makes fits too sure of themselves."""
    start, _ = tracks(150, 0.4)
    images = pictures(4.0, blur)
    reference = reference_points(start, [(SIDE, SIDE)] * 3)
    loops = close_loops(start, reference, images, RefineSettings())
    assert loops.measured and loops.count > 120
    assert low <= loops.factor <= high
    found = refine_tracks(start, images, RefineSettings(), loops.factor)
    sigma = np.sqrt(2) * np.median(found.tracks.sigma)
    ratio = np.sqrt((errors(found.tracks) ** 2).mean()) / sigma
    assert 0.75 <= ratio <= 1.3, ratio


def test_without_loops_a_factor_is_assumed_and_said_so() -> None:
    start, _ = tracks(40, 0.4)
    pairs = start.where(start.image != 2)
    loops = close_loops(pairs, reference_points(pairs, [(SIDE, SIDE)] * 3), pictures(1.0), RefineSettings())
    assert loops.factor == ASSUMED and not loops.measured

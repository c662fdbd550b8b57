"""Choice of pairs, likeness of features, geometry of pairs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.matching.features import (
    Calibration,
    Features,
    Guide,
    VerifySettings,
    all_pairs,
    match_features,
    pairs_by_distance,
    pairs_by_footprints,
    pairs_by_likeness,
    verify_pair,
)


def features(descriptors: NDArray, xy: NDArray | None = None, scale: NDArray | None = None) -> Features:
    n = len(descriptors)
    unit = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    xy = np.random.default_rng(0).uniform(0, 1000, (n, 2)) if xy is None else xy
    scale = np.ones(n) if scale is None else scale
    return Features(xy, scale, np.zeros(n), np.ones(n), np.rint(unit * 512).clip(0, 255).astype(np.uint8))


def strip(count: int, base: float) -> list[NDArray]:
    return [np.array([[x, 0], [x + 100, 0], [x + 100, 60], [x, 60]]) for x in base * np.arange(count)]


def test_images_with_common_ground_are_paired() -> None:
    assert pairs_by_footprints(strip(5, 40.0)) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4)]
    assert pairs_by_footprints(strip(5, 90.0)) == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert pairs_by_footprints(strip(5, 96.0)) == []
    assert pairs_by_footprints([strip(1, 1.0)[0], strip(1, 1.0)[0] + 1000]) == []


def test_neighbours_by_position_are_paired(monkeypatch: pytest.MonkeyPatch) -> None:
    X = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [1000, 0, 0.0]])
    assert pairs_by_distance(X) == [(0, 1), (0, 2), (1, 2)]
    monkeypatch.setattr("photoplan.matching.features.NEIGHBOURS", 1)
    assert pairs_by_distance(X) == [(0, 1), (1, 2)]
    assert pairs_by_distance(X[:1]) == [] and all_pairs(3) == [(0, 1), (0, 2), (1, 2)]


def test_likeness_finds_the_images_that_share_features() -> None:
    rng = np.random.default_rng(3)
    common = rng.random((40, 128)) ** 4
    images = [features(np.vstack([common + 0.02 * rng.random((40, 128)), rng.random((100, 128)) ** 4])) for _ in "ab"]
    stranger = features(rng.random((140, 128)) ** 4)
    assert pairs_by_likeness([images[0], stranger, images[1]]) == [(0, 2)]


def test_matches_are_mutual_and_clear() -> None:
    rng = np.random.default_rng(4)
    base = rng.random((30, 128)) ** 4
    a, b = features(base), features(base[::-1] + 0.03 * rng.random((30, 128)))
    found = match_features(a, b)
    assert found.tolist() == [[i, 29 - i] for i in range(30)]
    # Two features of a that are most like the same one of b: the more similar one has it.
    rival = features(np.vstack([base, base[:1] + 0.15 * rng.random((1, 128))]))
    assert match_features(rival, b).tolist() == [[i, 29 - i] for i in range(30)]
    # The same thing twice in b is no match any more, unless it is one place with two directions.
    twice = np.vstack([b.descriptors, b.descriptors[:1]]).astype(float)
    apart = features(twice, np.vstack([b.xy, b.xy[:1] + 50]))
    assert 29 not in match_features(a, apart)[:, 0]
    together = features(twice, np.vstack([b.xy, b.xy[:1] + 0.5]))
    assert 29 in match_features(a, together)[:, 0]


def test_a_guide_makes_likeness_far_away_irrelevant() -> None:
    rng = np.random.default_rng(5)
    base = rng.random((20, 128)) ** 4
    xy = rng.uniform(0, 1000, (20, 2))
    a = features(base, xy)
    # Every feature has a double 400 pixels away.
    b = features(np.vstack([base, base]), np.vstack([xy + np.array([5, -3]), xy + np.array([400, 0])]))
    assert len(match_features(a, b)) == 0
    found = match_features(a, b, guide=Guide(xy, 30.0))
    assert found.tolist() == [[i, i] for i in range(20)]
    nowhere = np.full((20, 2), np.nan)
    assert len(match_features(a, b, guide=Guide(nowhere, 30.0))) == 0


INTERIOR = Interior.digital((2000, 1500), (1500.0, 1500.0), (12.0, -8.0))
LENS = Brown(-0.08, 0.02, 0.0, 0.001, -0.0005)


def view(relief: float, seed: int, outliers: int, noise: float = 0.3) -> tuple[NDArray, NDArray, NDArray]:
    """Points of a stereo pair, the last ones wrong; which are right."""
    rng = np.random.default_rng(seed)
    cameras = [
        FrameCamera(INTERIOR, LENS, Pose(np.array([x, 0, 500.0]), rotation_opk(*rng.normal(0, 0.05, 2), k)))
        for x, k in ((0.0, 0.3), (180.0, 3.3))
    ]
    XYZ = rng.uniform([-100, -150, -relief - 1e-9], [280, 150, relief], (400, 3))
    xy = [project(camera, XYZ) for camera in cameras]
    inside = np.logical_and.reduce([((p > 0) & (p < (1999, 1499))).all(axis=1) for p in xy])
    a, b = (p[inside][:150] + rng.normal(0, noise, (150, 2)) for p in xy)
    b[150 - outliers :] = rng.uniform(0, [2000, 1500], (outliers, 2))
    return a, b, np.arange(150) < 150 - outliers


@pytest.mark.parametrize("relief", [0.0, 2.0, 60.0], ids=["flat", "nearly flat", "hills"])
def test_right_matches_survive_and_wrong_ones_go(relief: float) -> None:
    for seed in range(4):
        a, b, right = view(relief, seed, 60)
        known = Calibration(INTERIOR, LENS)
        fits = verify_pair((a, b), (known, known), VerifySettings())
        assert fits[right].mean() > (0.9 if relief == 2.0 else 0.95)
        assert fits[~right].sum() <= 4  # those that happen to lie on their epipolar line


@pytest.mark.parametrize("relief", [0.0, 60.0], ids=["flat", "hills"])
def test_without_cameras_too(relief: float) -> None:
    a, b, right = view(relief, 7, 50, noise=0.2)
    fits = verify_pair((a, b), (None, None), VerifySettings(threshold=4.0))
    assert fits[right].mean() > 0.9 and fits[~right].sum() <= 5


def test_on_flat_ground_matches_shifted_along_their_epipolar_line_go_too() -> None:
    """No epipolar line shows them; the homography of flat ground does, where cameras are not known."""
    rng = np.random.default_rng(6)
    a = rng.uniform(0, [2000, 1500], (120, 2))
    b = a - (400.0, 0.0) + rng.normal(0, 0.2, a.shape)
    b[:20, 0] += rng.uniform(30, 200, 20)
    fits = verify_pair((a, b), (None, None), VerifySettings())
    assert fits[20:].mean() > 0.95 and fits[:20].sum() == 0


def test_unrelated_images_are_not_verified() -> None:
    known = Calibration(INTERIOR, LENS)
    rng = np.random.default_rng(8)
    for count in (10, 60, 200):
        a, b = rng.uniform(0, [2000, 1500], (2, count, 2))
        assert not verify_pair((a, b), (known, known), VerifySettings()).any()
        assert not verify_pair((a, b), (None, None), VerifySettings()).any()


def test_threshold_is_in_pixels() -> None:
    a, b, right = view(60.0, 9, 40, noise=3.0)
    known = Calibration(INTERIOR, LENS)
    few = verify_pair((a, b), (known, known), VerifySettings(threshold=2.0, share=0.0))
    many = verify_pair((a, b), (known, known), VerifySettings(threshold=12.0))
    assert few[right].mean() < 0.6 < 0.95 < many[right].mean()

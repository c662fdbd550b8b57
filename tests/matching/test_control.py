"""Patches of an orthophoto found again, and points that agree on one orientation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.matching.register import (
    FoundPatch,
    OrthoPatch,
    agree,
    best_place,
    correlation_scores,
    find_patch,
    ground_covariances,
)


def texture(side: int = 120, seed: int = 1) -> NDArray:
    noise = np.random.default_rng(seed).normal(size=(side, side))
    return 100 + 60 * ndimage.gaussian_filter(noise, 2.0)


def test_correlation_is_that_of_the_common_cells() -> None:
    rng = np.random.default_rng(2)
    patch, picture = rng.normal(size=(9, 9)), rng.normal(size=(16, 16))
    patch[rng.random((9, 9)) < 0.2] = np.nan
    picture[rng.random((16, 16)) < 0.1] = np.nan
    found = correlation_scores(patch, picture)
    for row, col in ((0, 0), (3, 5), (7, 7)):
        part = picture[row : row + 9, col : col + 9]
        both = np.isfinite(patch) & np.isfinite(part)
        assert found[row, col] == pytest.approx(np.corrcoef(patch[both], part[both])[0, 1], abs=1e-9)


def test_correlation_of_cells_with_little_in_common_does_not_count() -> None:
    patch, picture = texture(9), texture(20)
    picture[:, :12] = np.nan
    found = correlation_scores(patch, picture)
    assert (found[:, :7] == -1).all() and (found[:, -1] > -1).all()


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_a_patch_is_found_to_a_small_part_of_a_cell(holes: float) -> None:
    rng = np.random.default_rng(3)
    scene = texture(200)
    errors = []
    for _ in range(12):
        row, col = rng.integers(60, 140, 2)
        patch = scene[row - 12 : row + 13, col - 12 : col + 13].copy()
        patch[rng.random(patch.shape) < holes] = np.nan
        dx, dy = rng.uniform(-8, 8, 2)
        moved = ndimage.shift(scene, (dy, dx), order=5, mode="nearest") * 0.7 + 20
        found = find_patch(patch + rng.normal(0, 0.5, patch.shape), moved[row - 25 : row + 26, col - 25 : col + 26])
        assert isinstance(found, FoundPatch) and found.correlation > 0.95
        errors.append(np.array(found.at) - 25 - (dx, dy))
    assert np.abs(errors).max() < 0.06


def test_what_is_not_there_is_not_found() -> None:
    scene = texture(120)
    patch = scene[50:75, 50:75]
    assert isinstance(find_patch(patch, texture(60, seed=9)), str)
    assert find_patch(patch, scene[50:95, 40:85]) == "at the edge of the search"
    wave = 100 + 20 * np.sin(np.arange(120) / 2.0)[None] * np.sin(np.arange(120) / 2.0)[:, None]
    assert find_patch(wave[40:65, 40:65], wave[20:85, 20:85]) == "ambiguous"


def test_best_place_has_texture_in_both_directions_and_values() -> None:
    values = np.full((100, 100), 50.0)
    values[:, 10:40] += 30 * np.sin(np.arange(10, 40))  # slopes in one direction only
    values[60:80, 60:80] = texture(20)
    col, row = best_place(values.astype(np.float32), 7, 8)
    assert 55 <= col <= 85 and 55 <= row <= 85
    values[50:90, 50:90] = np.nan
    hole = best_place(values.astype(np.float32), 7, 8)
    assert hole is None or not (52 <= hole[0] <= 88 and 52 <= hole[1] <= 88)
    assert best_place(np.full((50, 50), np.nan, np.float32), 7, 8) is None


INTERIOR = Interior.digital((2000, 1500), (1600.0, 1600.0))


def case(seed: int, wrong: int) -> tuple[FrameCamera, NDArray, NDArray, NDArray]:
    """Approximate camera, ground points, image points measured with noise of half a pixel; the first are wrong."""
    rng = np.random.default_rng(seed)
    true = FrameCamera(INTERIOR, NoLens(), Pose(np.array([0, 0, 500.0]), rotation_opk(0.01, -0.02, 0.4)))
    # 0.6° and 15 m off.
    off = rotation_opk(*rng.choice([-0.01, 0.01], 3)) @ true.pose.R_ground_camera
    near = FrameCamera(INTERIOR, NoLens(), Pose(true.pose.center + rng.choice([-15, 15], 3), off))
    XYZ = rng.uniform([-220, -160, -20], [220, 160, 20], (50, 3))
    xy = project(true, XYZ) + rng.normal(0, 0.5, (50, 2))
    xy[:wrong] += rng.uniform(-40, 40, (wrong, 2)) + 10
    C = np.broadcast_to(np.eye(3) * 1e-6, (50, 3, 3))
    return near, XYZ, xy, C


def test_wrong_points_do_not_agree_although_the_orientation_is_far_off() -> None:
    kept_wrong = kept_right = 0
    for seed in range(10):
        near, XYZ, xy, C = case(seed, 15)
        fit = np.broadcast_to(np.eye(2) * 0.01, (50, 2, 2))
        found = agree(near, XYZ, xy, (fit, C), 30.0)
        kept_wrong += int(found.keep[:15].sum())
        kept_right += int(found.keep[15:].sum())
        assert np.linalg.norm(found.shift) > 5
        assert np.abs(found.residuals[15:]).max() < 4
    assert kept_right >= 0.97 * 350 and kept_wrong <= 6, (kept_right, kept_wrong)


def test_standard_deviations_are_raised_to_what_the_residuals_show() -> None:
    factors = []
    for seed in range(10):
        near, XYZ, xy, C = case(seed, 0)
        fit = np.broadcast_to(np.eye(2) * 0.1**2, (50, 2, 2))
        factors.append(agree(near, XYZ, xy, (fit, C), 30.0).factor)
    assert 4.2 < np.mean(factors) < 5.8  # 0.5 / 0.1


def test_too_few_points_are_none() -> None:
    near, XYZ, xy, C = case(1, 0)
    fit = np.broadcast_to(np.eye(2) * 0.01, (50, 2, 2))
    found = agree(near, XYZ[:5], xy[:5], (fit[:5], C[:5]), 30.0)
    assert not found.keep.any()


def test_errors_of_the_place_are_errors_of_the_height_on_slopes() -> None:
    """Covariance of what is read at places that err, against a simulation."""
    patch = OrthoPatch(np.zeros((3, 3)), (0.0, 0.0, 0.0), (0.4, -0.2), 0.0)
    rng = np.random.default_rng(4)
    xy = rng.normal(0, 0.5, (200_000, 2))
    z = xy @ (0.4, -0.2) + rng.normal(0, 0.3, len(xy))
    np.testing.assert_allclose(ground_covariances([patch], 0.5, 0.3)[0], np.cov(np.column_stack([xy, z]).T), atol=2e-3)

"""Relative orientation of image pairs: five points in closed form, and with gross errors."""

from __future__ import annotations

import numpy as np
import pytest
from tools.photos import turned_by
from tools.thinned import thinned

from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.orientation.start import five_point_essentials, relate

SIGMA = 5e-5


def pair(rng: np.random.Generator, n: int, relief: float, base: float = 0.6) -> tuple[Pose, np.ndarray]:
    """Second pose (base 1) in the first's axes, and points of the overlap, in units of the base."""
    height = 1.0 / base
    center = np.array([1.0, rng.normal(0, 0.05), rng.normal(0, 0.03)])
    pose = Pose(center / np.linalg.norm(center), rotation_opk(*rng.normal(0, 0.03, 2), rng.normal(0, 0.1)))
    half = 0.75 * height
    X = np.column_stack(
        [rng.uniform(1.0 - half, half, n), rng.uniform(-half, half, n), -height * (1 + relief * rng.uniform(-1, 1, n))]
    )
    return pose, X


def seen(pose: Pose, X: np.ndarray) -> np.ndarray:
    p = pose.to_camera(X)
    return p[:, :2] / -p[:, 2:]


ORIGIN = Pose(np.zeros(3), np.eye(3))


@pytest.mark.parametrize("relief", [0.0, 0.1])
def test_five_points_give_the_essential_matrix(relief: float) -> None:
    rng = np.random.default_rng(1)
    first, second, truth = [], [], []
    for _ in range(300):
        pose, X = pair(rng, 5, relief)
        first.append(X)
        second.append(pose.to_camera(X))
        x, y, z = pose.center
        E = pose.R_ground_camera.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        truth.append(E / np.linalg.norm(E))
    found = five_point_essentials(first, second)
    E = np.array(truth)[:, None]
    miss = np.minimum(np.abs(found - E).max(axis=(2, 3)), np.abs(found + E).max(axis=(2, 3)))
    assert np.median(np.nanmin(miss, axis=1)) < 1e-12
    assert (np.nanmin(miss, axis=1) < 1e-6).mean() > 0.99
    good = found[np.isfinite(found[..., 0, 0])]
    square = good @ np.swapaxes(good, 1, 2)
    cubic = 2 * square @ good - np.trace(square, axis1=1, axis2=2)[:, None, None] * good
    assert np.quantile(np.abs(cubic).max(axis=(1, 2)), 0.99) < 1e-8
    assert np.quantile(np.abs(np.linalg.det(good)), 0.99) < 1e-8


@pytest.mark.parametrize("relief", [0.0, pytest.param(0.002, marks=pytest.mark.slow), 0.1])
@pytest.mark.parametrize("wrong", [0.0, 0.5])
@thinned("pairs", 1, 8)
def test_pairs_with_gross_errors_flat_and_hilly(relief: float, wrong: float, pairs: int) -> None:
    rng = np.random.default_rng(2)
    for _ in range(pairs):
        pose, X = pair(rng, 150, relief)
        a, b = seen(ORIGIN, X), seen(pose, X)
        a, b = (t + rng.normal(0, SIGMA, t.shape) for t in (a, b))
        bad = rng.random(len(X)) < wrong
        b[bad] = rng.uniform(-0.7, 0.7, (bad.sum(), 2))
        found = relate(a, b, SIGMA)
        assert turned_by(found.pose, pose) < 2e-3
        assert np.linalg.norm(found.pose.center - pose.center) < 3e-3
        assert found.inliers[~bad].mean() > 0.97
        assert found.inliers[bad].mean() < 0.05 if bad.any() else True
        off = np.linalg.norm(found.points - X, axis=1)[found.inliers & ~bad]
        assert np.median(off) < 5e-3
        assert np.isnan(found.points[~found.inliers]).all()
        assert found.rms < 1.5 * SIGMA


def test_fault_16_images_from_one_place() -> None:
    rng = np.random.default_rng(3)
    pose, X = pair(rng, 100, 0.1)
    turned = Pose(1e-4 * pose.center, pose.R_ground_camera)
    a, b = seen(ORIGIN, X), seen(turned, X)
    with pytest.raises(GeometryError):
        relate(a + rng.normal(0, SIGMA, a.shape), b, SIGMA)


def test_fault_16_too_few_or_unrelated_points() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-0.7, 0.7, (2, 60, 2))
    with pytest.raises(GeometryError, match="7 common points"):
        relate(a[:7], b[:7])
    with pytest.raises(GeometryError, match="of 60 common points fit"):
        relate(a, b, 1e-6)

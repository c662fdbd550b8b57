"""Intersection of many points: exactness, covariances, gross errors, rays that determine nothing."""

from __future__ import annotations

import numpy as np
import pytest
from tools.effort import at_most
from tools.photos import at

from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.orientation.intersection import REASONS, Intersected, MeasuredRays, intersect

SIGMA = 5e-5


def block(rng: np.random.Generator, count: int = 5) -> list[Pose]:
    return [
        Pose(at(600.0 * k, 80.0 * rng.normal(), 1500.0 + 20 * rng.normal()), rotation_opk(*rng.normal(0, 0.03, 2), 0.3))
        for k in range(count)
    ]


def rays_of(poses: list[Pose], X: np.ndarray, rng: np.random.Generator, sigma: float = SIGMA) -> MeasuredRays:
    image, point, t = [], [], []
    for k, pose in enumerate(poses):
        p = pose.to_camera(X)
        image.append(np.full(len(X), k))
        point.append(np.arange(len(X)))
        t.append(p[:, :2] / -p[:, 2:] + rng.normal(0, 1, (len(X), 2)) * sigma)
    return MeasuredRays(np.concatenate(image), np.concatenate(point), np.concatenate(t), np.full((1, 2), SIGMA))


def ground(rng: np.random.Generator, n: int) -> np.ndarray:
    return at(1200, 0, 0) + rng.uniform(-1, 1, (n, 3)) * (600, 600, 150)


def test_exact_rays_give_the_points() -> None:
    rng = np.random.default_rng(1)
    poses, X = block(rng), ground(rng, 200)
    found = intersect(poses, rays_of(poses, X, rng, 0.0))
    np.testing.assert_allclose(found.XYZ, X, atol=1e-7)
    assert (found.rays == 5).all() and found.used.all()
    assert found.counts() == {}


def test_errors_are_as_large_as_the_covariance_says() -> None:
    rng = np.random.default_rng(2)
    poses, X = block(rng), ground(rng, 4000)
    found = intersect(poses, rays_of(poses, X, rng), critical=6.0)
    error = found.XYZ - X
    square = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance, error[..., None])[..., 0])
    assert abs(square.mean() / 3 - 1) < 0.05
    z = error[:, 2] / np.sqrt(found.covariance[:, 2, 2])
    assert 0.95 < z.std() < 1.05


@pytest.mark.parametrize("count", [3, 4, 5])
def test_fault_17_one_wrong_ray_is_found_or_the_point_is_refused(count: int) -> None:
    rng = np.random.default_rng(3)
    # A triangle of cameras: with all on one line, errors along it stay unseen.
    places = [(0, 0), (900, 100), (400, 800), (1000, 900), (-100, 700)][:count]
    poses = [Pose(at(x, y, 1500), rotation_opk(0.02, -0.03, k * 0.7)) for k, (x, y) in enumerate(places)]
    X = at(500, 400, 0) + rng.uniform(-1, 1, (500, 3)) * (300, 300, 80)
    rays = rays_of(poses, X, rng)
    wrong = rng.integers(0, count, 500) * 500 + np.arange(500)
    t = rays.tangents.copy()
    size = 10 ** rng.uniform(-2.5, 0.0, 500)
    angle = rng.uniform(0, 2 * np.pi, 500)
    t[wrong] += size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = intersect(poses, MeasuredRays(rays.image, rays.point, t, rays.sigma))
    good = found.reason == 0
    assert good.mean() > {3: 0.75, 4: 0.95, 5: 0.97}[count]
    assert (~found.used[wrong][good]).mean() > 0.99
    off = np.linalg.norm(found.XYZ - X, axis=1)[good]
    assert np.quantile(off, 0.99) < 1.5
    assert set(found.counts()) <= set(REASONS[2:])
    assert np.isnan(found.XYZ[~good]).all()


def test_fault_17_an_error_that_any_ray_could_have_is_not_guessed() -> None:
    """Three cameras on a line and an error along it: every two rays meet, and nothing tells which pair is right."""
    rng = np.random.default_rng(8)
    poses = [Pose(at(x, 0, 1500), np.eye(3)) for x in (0.0, 500.0, 1000.0)]
    X = at(500, 0, 0) + rng.uniform(-1, 1, (200, 3)) * (200, 400, 80)
    rays = rays_of(poses, X, rng)
    t = rays.tangents.copy()
    wrong = rng.integers(0, 3, 200) * 200 + np.arange(200)
    t[wrong, 0] += 0.01
    found = intersect(poses, MeasuredRays(rays.image, rays.point, t, rays.sigma))
    assert (found.reason == 4).mean() > 0.97
    assert found.counts()["rays do not meet"] > 190


def test_many_rays_lose_several() -> None:
    rng = np.random.default_rng(4)
    poses = [Pose(at(150 * (k % 5), 150 * (k // 5), 1000), rotation_opk(0, 0, k)) for k in range(25)]
    X = at(300, 300, 0) + rng.uniform(-1, 1, (40, 3)) * (100, 100, 20)
    rays = rays_of(poses, X, rng)
    t = rays.tangents.copy()
    wrong = np.concatenate([k * 40 + np.arange(40) for k in (2, 7, 19)])
    t[wrong] += 0.02
    found = intersect(poses, MeasuredRays(rays.image, rays.point, t, rays.sigma))
    assert not found.used[wrong].any()
    assert (found.reason == 0).all()
    assert (found.rays >= 21).all()


def test_fault_16_points_that_are_not_determined() -> None:
    poses = [Pose(at(0, 0, 1000), np.eye(3)), Pose(at(0.5, 0, 1000), np.eye(3)), Pose(at(600, 0, 1000), np.eye(3))]
    t = np.array([[0.1, 0.1], [0.1, 0.0], [0.0995, 0.0], [0.0, 0.0], [0.3, 0.0], [0.1, 0.0], [-0.5, 0.3], [np.nan, 0]])
    image = np.array([0, 0, 1, 0, 2, 0, 2, 2])
    point = np.array([0, 1, 1, 2, 2, 3, 3, 0])
    found = intersect(poses, MeasuredRays(image, point, t, np.full((1, 2), SIGMA)), 5)
    said = [REASONS[k] for k in found.reason]
    assert said[0] == "fewer than two rays"
    assert said[1] == "rays nearly parallel"
    assert said[2] == "behind a camera"
    assert said[3] == "rays do not meet"
    assert said[4] == "fewer than two rays"
    assert np.isnan(found.XYZ).all() and np.isnan(found.covariance).all()
    assert found.counts() == {
        "fewer than two rays": 2,
        "rays nearly parallel": 1,
        "behind a camera": 1,
        "rays do not meet": 1,
    }


def test_no_rays_no_points() -> None:
    empty = MeasuredRays(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.ones((1, 2)))
    found = intersect([], empty)
    assert isinstance(found, Intersected) and len(found.XYZ) == 0


def test_chunks_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    poses, X = block(rng), ground(rng, 101)
    rays = rays_of(poses, X, rng)
    whole = intersect(poses, rays)
    monkeypatch.setattr("photoplan.orientation.intersection._CHUNK", 7)
    parts = intersect(poses, rays)
    np.testing.assert_allclose(parts.XYZ, whole.XYZ, atol=1e-7)
    assert (parts.used == whole.used).all()


@pytest.mark.slow
def test_a_hundred_thousand_points_take_seconds() -> None:
    rng = np.random.default_rng(6)
    poses, X = block(rng, 4), ground(rng, 100_000)
    rays = rays_of(poses, X, rng)
    with at_most(20):
        intersect(poses, rays)

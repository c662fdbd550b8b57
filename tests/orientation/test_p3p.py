"""Three-point resection in closed form, against poses that are known."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.geometry.pose import rotation_opk
from photoplan.orientation.resection import bearings, three_point_poses


def scenes(rng: np.random.Generator, n: int, tilt: float, flat: bool) -> tuple[np.ndarray, ...]:
    center = rng.normal(size=(n, 3)) * [300, 300, 100] + [0, 0, 1500]
    R = np.stack([rotation_opk(*(rng.normal(size=2) * tilt), rng.uniform(-3, 3)) for _ in range(n)])
    t = rng.uniform(-0.7, 0.7, (n, 3, 2))
    depth = 1500 * np.exp((0.0 if flat else 0.3) * rng.normal(size=(n, 3)))
    seen = np.concatenate([t * depth[..., None], -depth[..., None]], axis=-1)
    return t, np.einsum("nij,nkj->nki", R, seen) + center[:, None], R, center


@pytest.mark.parametrize(("tilt", "flat"), [(0.03, True), (0.03, False), (1.2, False)])
def test_the_true_pose_is_among_the_solutions(tilt: float, flat: bool) -> None:
    t, X, R, center = scenes(np.random.default_rng(1), 3000, tilt, flat)
    Rs, Cs = three_point_poses(t, X)
    miss = np.nanmin(np.linalg.norm(Cs - center[:, None], axis=-1), axis=1)
    turn = np.nanmin(np.abs(Rs - R[:, None]).max(axis=(2, 3)), axis=1)
    assert np.median(miss) < 1e-9
    assert (miss < 1e-3).mean() > 0.999
    assert (turn < 1e-6).mean() > 0.999
    assert miss.max() < 5.0


def test_every_solution_sees_the_points_as_they_were_measured() -> None:
    t, X, _, _ = scenes(np.random.default_rng(2), 2000, 0.5, False)
    Rs, Cs = three_point_poses(t, X)
    p = np.einsum("nkpj,nkji->nkpi", X[:, None] - Cs[:, :, None], Rs)
    good = np.isfinite(Cs[..., 0])
    assert (p[good][..., 2] < 0).all(), "in front of the camera"
    again = p[..., :2] / -p[..., 2:]
    assert np.nanmedian(np.abs(again - t[:, None])) < 1e-13
    assert np.nanmax(np.abs(again - t[:, None])) < 1e-6
    assert np.allclose(np.linalg.det(Rs[good]), 1.0)
    count = good.sum(axis=1)
    assert count.min() >= 1 and count.max() == 4, "a quartic: up to four"


def test_symmetric_triangles_where_other_formulas_divide_by_zero() -> None:
    center = np.array([0.0, 0.0, 1000.0])
    angles = np.array([0.0, 2 * np.pi / 3, 4 * np.pi / 3])
    round_ = np.stack([500 * np.cos(angles), 500 * np.sin(angles), np.zeros(3)], axis=1)
    corner = np.array([[500.0, 500, 0], [-500, 500, 0], [-500, -500, 0]])
    for X in (round_, corner):
        p = X - center
        _, Cs = three_point_poses((p[:, :2] / -p[:, 2:])[None], X[None])
        assert np.nanmin(np.linalg.norm(Cs[0] - center, axis=-1)) < 1e-6


def test_fault_16_points_on_a_line_give_no_pose() -> None:
    X = np.array([[500.0, 500, 0], [0, 0, 0], [-500, -500, 0]])
    p = X - (0, 0, 1000)
    R, C = three_point_poses((p[:, :2] / -p[:, 2:])[None], X[None])
    assert np.isnan(R).all() and np.isnan(C).all()


def test_bearings_look_away_from_the_viewer() -> None:
    assert bearings([0.0, 0.0]).tolist() == [0.0, 0.0, -1.0]
    np.testing.assert_allclose(bearings([1.0, 0.0]), [np.sqrt(0.5), 0.0, -np.sqrt(0.5)])

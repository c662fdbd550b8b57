"""Points near infinity, as raw tracks of street images have them: set aside by name, and the block settles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tools.plain_block import FOCAL, SIZE, Make, pixels, plain_block

from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.lenses import NoLens
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedPositions
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.model import AdjustSettings, Block, BlockCamera, BlockImage

PLANE = Affine2D(1.0, 0.0, (SIZE[0] - 1) / 2, 0.0, -1.0, (SIZE[1] - 1) / 2)


def street(seed: int, far: int = 60, start: tuple[float, float] = (0.1, 0.003)) -> tuple[Block, np.ndarray]:
    """Twelve images along 40 m that look across a street at 200 points, and over it at points of 0.3 to 3000 km."""
    rng = np.random.default_rng(seed)
    C = np.column_stack([rng.uniform(0, 40, 12), rng.uniform(-1, 1, 12), rng.uniform(1.5, 2.5, 12)])
    look = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    R = np.array([look @ Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix() for _ in C])
    near = np.column_stack([rng.uniform(-10, 50, 200), rng.uniform(15, 60, 200), rng.uniform(-2, 15, 200)])
    d, a = 10 ** rng.uniform(2.5, 6.5, far), rng.uniform(-0.4, 0.4, far)
    X = np.vstack([near, np.column_stack([20 + d * np.sin(a), d * np.cos(a), d * rng.uniform(0, 0.2, far)])])
    names = [f"N{k}" for k in range(200)] + [f"F{k}" for k in range(far)]
    rows = []
    for k in range(12):
        xy = pixels(X, C[k], R[k])
        seen = ((X - C[k]) @ R[k][:, 2] < 0) & ((xy > 0) & (xy < np.array(SIZE) - 1)).all(axis=1)
        xy = xy + rng.normal(0, 0.5, xy.shape)
        rows += [(names[p], f"I{k}", float(xy[p, 0]), float(xy[p, 1])) for p in np.flatnonzero(seen)]
    images = tuple(
        BlockImage(
            f"I{k}",
            "cam",
            PLANE,
            Pose(
                C[k] + rng.normal(0, start[0], 3), R[k] @ Rotation.from_rotvec(rng.normal(0, start[1], 3)).as_matrix()
            ),
        )
        for k in range(12)
    )
    ground = GroundPoints(("N0",), X[:1], np.full((1, 3), 0.01), np.zeros(1, bool))
    observed = C + rng.normal(0, 0.05, C.shape)
    names_of = tuple(i.name for i in images)
    positions = ObservedPositions(names_of, observed, np.full(C.shape, 0.05), ("a",) * 12, np.arange(12.0))
    camera = {"cam": BlockCamera(FOCAL, (0.0, 0.0), NoLens(), ("c",))}
    return Block(camera, images, ImagePoints.from_rows(rows, 0.5), ground, positions), C


@pytest.mark.parametrize("start", [(0.1, 0.003), (0.3, 0.02)])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_points_near_infinity_are_set_aside_by_name(seed: int, start: tuple[float, float]) -> None:
    block, C = street(seed, start=start)
    result = adjust_block(block)
    assert np.abs(np.array([p.center for p in result.poses]) - C).max() < 0.1
    assert result.sigma0 == pytest.approx(1.0, abs=0.1)
    far = [name for name, reason in result.left_out if "rays are parallel" in reason]
    assert len(far) >= 20 and sum(not name.startswith("F") for name in far) <= 1
    # What is kept has a distance, of which a part of the accuracy is that of the orientations.
    sigma = np.sqrt(np.linalg.eigvalsh(result.point_covariance)[:, 2])
    away = np.linalg.norm(result.XYZ - C.mean(axis=0), axis=1)
    assert (sigma < away).all() and np.median(sigma / away) < 0.01
    # Their measurements are right, and few are called wrong (far points that cameras near each other see: 6 %).
    assert result.rejected.mean() < 0.07


def test_without_a_search_for_gross_errors_too() -> None:
    block, C = street(1)
    result = adjust_block(block, AdjustSettings(robust=False))
    assert np.abs(np.array([p.center for p in result.poses]) - C).max() < 0.1
    assert any("rays are parallel" in reason for _, reason in result.left_out)


def test_ordinary_blocks_lose_nothing() -> None:
    truth = plain_block(Make(seed=2, gnss=0.05))
    result = adjust_block(truth.block)
    assert not [reason for _, reason in result.left_out if "parallel" in reason]
    free = replace(truth.block, positions=None)
    assert not [reason for _, reason in adjust_block(free).left_out if "parallel" in reason]

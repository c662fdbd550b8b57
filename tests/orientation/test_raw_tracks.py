"""Raw tracks of street images, as structure from motion leaves them: each image its own camera, points at infinity.

Of the kind of the Ladybug blocks of "Bundle adjustment in the large" (Agarwal et al. 2010), simulated: a vehicle on a
street, constant and two coefficients of distortion free for every image, tracks of two images and more, one in seven
points 0.2 to 1000 km away.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tools.thinned import some, thinned

from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.lenses import Brown
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.adjust import _selected, _started, adjust_block
from photoplan.orientation.bundle.equations import linearise, points_at_infinity
from photoplan.orientation.bundle.model import Active, AdjustSettings, Block, BlockCamera, BlockImage, build_model
from photoplan.orientation.bundle.robust import _left, weights_of

SIZE, IMAGES, NEAR, FAR = (1024, 768), 12, 350, 60
PLANE = Affine2D(1.0, 0.0, (SIZE[0] - 1) / 2, 0.0, -1.0, (SIZE[1] - 1) / 2)
AHEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
Floats = np.ndarray


def pixels(X: Floats, C: Floats, R: Floats, f: float, k1: float, k2: float) -> tuple[Floats, Floats]:
    """Columns and rows by p' = f (1 + k1 r² + k2 r⁴) p, and which of them are in the image."""
    p = (X - C) @ R
    t = -p[:, :2] / p[:, 2:]
    r2 = (t**2).sum(axis=1, keepdims=True)
    xy = f * t * (1 + k1 * r2 + k2 * r2**2)
    xy = np.column_stack([xy[:, 0] + (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2 - xy[:, 1]])
    inside = (xy > 0).all(axis=1) & (xy < np.array(SIZE) - 1).all(axis=1)
    return xy, inside & (p[:, 2] < -1) & (np.linalg.norm(p, axis=1) > 3)


def raw(seed: int, starts: bool = True, gross: float = 0.02) -> tuple[Block, Floats]:
    """A block with start values 0.1 m, 0.3°, 0.5 % of the constant off, and its true projection centres."""
    rng = np.random.default_rng(seed)
    C = np.column_stack([rng.normal(0, 0.3, IMAGES), np.arange(IMAGES), 2 + rng.normal(0, 0.05, IMAGES)])
    heading = np.array([-35.0, 0.0, 35.0])[np.arange(IMAGES) % 3] + rng.normal(0, 3, IMAGES)
    turned = Rotation.from_rotvec(rng.normal(0, 0.02, (IMAGES, 3))).as_matrix()
    R = Rotation.from_euler("z", heading[:, None], degrees=True).as_matrix() @ AHEAD @ turned
    cameras = np.column_stack(
        [rng.normal(400, 4, IMAGES), rng.normal(-0.05, 0.01, IMAGES), rng.normal(0.01, 0.003, IMAGES)]
    )
    side = rng.choice([-1, 1], NEAR) * rng.uniform(5, 20, NEAR)
    near = np.column_stack([side, rng.uniform(-10, 120, NEAR), rng.uniform(-2, 15, NEAR)])
    d, a = 10 ** rng.uniform(2.3, 6, FAR), rng.uniform(-0.9, 0.9, FAR)
    X = np.vstack([near, np.column_stack([d * np.sin(a), d * np.cos(a), d * rng.uniform(0, 0.3, FAR)])])
    names = [f"N{k}" for k in range(NEAR)] + [f"F{k}" for k in range(FAR)]
    seen = [pixels(X, C[k], R[k], *cameras[k]) for k in range(IMAGES)]
    rows: list[tuple[str, str, float, float]] = []
    for j, name in enumerate(names):
        images = [k for k in range(IMAGES) if seen[k][1][j]]
        length = min(len(images), 2 + int(rng.geometric(0.35)))
        if length < 2:
            continue
        first = int(rng.integers(0, len(images) - length + 1))
        for k in images[first : first + length]:
            x, y = seen[k][0][j] + rng.normal(0, 0.6, 2) + rng.normal(0, 15.0, 2) * (rng.random() < gross)
            rows.append((name, f"I{k}", float(x), float(y)))
    there = {row[0] for row in rows}
    at = [k for k in range(NEAR) if names[k] in there][:: NEAR // 8]
    ground = GroundPoints(tuple(names[k] for k in at), X[at], np.full((len(at), 3), 0.02), np.zeros(len(at), bool))
    off = cameras + rng.normal(0, [2.0, 0.003, 0.001], cameras.shape)
    described = {
        f"c{k}": BlockCamera(f, (0.0, 0.0), Brown(k1=k1, k2=k2), ("c", "k1", "k2")) for k, (f, k1, k2) in enumerate(off)
    }
    moved = Rotation.from_rotvec(rng.normal(0, 0.005, (IMAGES, 3))).as_matrix()
    shifted = C + rng.normal(0, 0.1, C.shape)
    block_images = tuple(BlockImage(f"I{k}", f"c{k}", PLANE, Pose(shifted[k], R[k] @ moved[k])) for k in range(IMAGES))
    middle = C.mean(axis=0)
    known = {n: middle + (X[j] - middle) * np.exp(rng.normal(0, 0.03)) for j, n in enumerate(names) if n in there}
    known = {n: point for n, point in known.items() if starts and n not in ground.names}
    return Block(described, block_images, ImagePoints.from_rows(rows, 0.6), ground, start_points=known), C


@pytest.mark.parametrize("robust", some([True, False], 1))
@thinned("count", 1, 12)
def test_raw_tracks_settle(count: int, robust: bool) -> None:
    for seed in range(count):
        block, C = raw(seed, gross=0.02 if robust else 0.0)
        result = adjust_block(block, AdjustSettings(robust=robust))
        assert result.sigma0 == pytest.approx(1.0, abs=0.06)
        centers = C[[int(name[1:]) for name in result.images]]
        assert np.abs(np.array([pose.center for pose in result.poses]) - centers).max() < 0.5
        far = [name for name, reason in result.left_out if "rays are parallel" in reason]
        assert len(far) > 20


@pytest.mark.parametrize("step", [6, pytest.param(1, marks=pytest.mark.slow)])
def test_a_point_that_comes_into_a_projection_centre_is_set_aside(step: int) -> None:
    """There it fits whatever was measured, and tells the image's orientation without end (BAL problem 49-7776)."""
    block, _ = raw(1, gross=0.0)
    active = Active.all_of(block)
    selection, XYZ, _ = _selected(block, active, frozenset())
    model = build_model(block, selection.images, selection.measured, selection.points)
    into = _started(model, XYZ).images.centers[4]
    for point in model.point[model.image == 4][::step]:
        fell = XYZ.copy()
        fell[point] = into + 1e-4 * (XYZ[point] - into) / np.linalg.norm(XYZ[point] - into)
        state = _started(model, fell)
        rows, _ = linearise(model, state, np.sqrt(weights_of(model, active)))
        assert model.point_names[point] in points_at_infinity(model, state, rows)


def test_what_has_nothing_left_to_go_is_a_result() -> None:
    """One iteration is lacking; the last steps tell that it would change nothing."""
    block, _ = raw(1, gross=0.0)
    short, long = (adjust_block(block, AdjustSettings(robust=False, iterations=most)) for most in (4, 40))
    assert short.iterations < long.iterations
    assert short.sigma0 == pytest.approx(long.sigma0, rel=1e-6)
    with pytest.raises(GeometryError, match="has not converged after 3 iterations"):
        adjust_block(block, AdjustSettings(robust=False, iterations=3))


def test_what_is_left_to_go() -> None:
    assert _left([1.0, 0.5, 0.25, 0.125]) == pytest.approx(0.125)
    assert _left([1.0, 1.0, 1.0, 1.0]) == np.inf
    assert _left([np.inf, 2.0, 1.0, 0.5]) == np.inf
    assert _left([0.1, 0.2, 0.1, 0.0]) == 0.0
    assert _left([0.1, 0.2, 0.3, 0.4]) == np.inf

"""Start values of blocks: no approximate orientation, some, or only positions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tools.photos import AERIAL, at, turned_by
from tools.thinned import some

from photoplan.cameras.lenses import Brown
from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedPositions
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose, rotation_opk
from photoplan.orientation.bundle.model import BlockCamera
from photoplan.orientation.start import Started, StartImage, fit_similarity, robust_similarity, start_block

LENS = Brown(k1=-0.02, k2=0.01)
CAMERA = {"RC30": BlockCamera(AERIAL.c, AERIAL.principal_point, LENS)}


@dataclasses.dataclass
class Simulated:
    poses: dict[str, Pose]
    observations: ImagePoints
    ground: GroundPoints

    def images(self, given: tuple[str, ...] = ()) -> list[StartImage]:
        plane = AERIAL.plane_to_pixel
        return [StartImage(n, "RC30", plane, p if n in given else None) for n, p in self.poses.items()]

    def check(self, found: Started, metres: float = 5.0, degrees: float = 0.5) -> None:
        for name, pose in found.poses.items():
            assert np.linalg.norm(pose.center - self.poses[name].center) < metres, name
            assert np.degrees(turned_by(pose, self.poses[name])) < degrees, name


def simulated(
    seed: int, relief: float, strips: int = 5, images: int = 8, wrong: float = 0.05, ties: int = 3000
) -> Simulated:
    """60 % forward and 30 % side overlap, strips flown there and back, five control points."""
    rng = np.random.default_rng(seed)
    h, side = 1500.0, 230.0 / 153.0 * 1500.0
    poses = {}
    for s in range(strips):
        for k in range(images):
            center = at(0.4 * side * k, 0.7 * side * s, h) + rng.normal(0, (20, 20, 10))
            kappa = (np.pi if s % 2 else 0.0) + rng.normal(0, 0.05)
            poses[f"{s + 1}_{k + 1}"] = Pose(center, rotation_opk(*rng.normal(0, 0.03, 2), kappa))
    size = (0.4 * side * (images - 1), 0.7 * side * (strips - 1))
    XY = rng.uniform(-0.5, 0.5, (ties, 2)) * (size[0] + 1.1 * side, size[1] + 1.1 * side) + np.array(size) / 2
    corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (0.5, 0.5)]) * size + (40.0, -30.0)
    XY = np.concatenate([corners, XY])
    Z = relief * (np.sin(XY[:, 0] / 700) + np.cos(XY[:, 1] / 900) + 0.3 * rng.normal(size=len(XY)))
    X = at(0, 0, 0) + np.column_stack([XY, Z])
    names = [f"K{k + 1}" if k < 5 else f"T{k}" for k in range(len(X))]
    rows = []
    for image, pose in poses.items():
        p = pose.to_camera(X)
        xy = AERIAL.tangent_to_pixel(LENS.distort(p[:, :2] / -p[:, 2:])) + rng.normal(0, 0.4, (len(X), 2))
        gross = rng.random(len(X)) < wrong
        gross[:5] = False
        xy[gross] += rng.normal(0, 400.0, (gross.sum(), 2))
        inside = ((xy > 100) & (xy < 11400)).all(axis=1)
        rows += [(names[k], image, float(xy[k, 0]), float(xy[k, 1])) for k in np.flatnonzero(inside)]
    control = GroundPoints(tuple(names[:5]), X[:5], np.full((5, 3), 0.05), np.zeros(5, bool))
    return Simulated(poses, ImagePoints.from_rows(rows, 0.5), control)


NOTHING = GroundPoints((), np.empty((0, 3)), np.empty((0, 3)), np.empty(0, bool))


@pytest.mark.parametrize(("strips", "relief"), some([(2, 60.0), (5, 60.0), (5, 0.0)], 0))
def test_a_block_of_forty_images_without_any_orientation(strips: int, relief: float) -> None:
    """Sixteen of them in `make test`."""
    block = simulated(1, relief, strips, ties=600 * strips)
    found = start_block(CAMERA, block.images(), block.observations, block.ground)
    assert len(found.poses) == 8 * strips
    assert found.left_out == ()
    assert set(found.how.values()) == {"tie points"}
    block.check(found)
    assert len(found.points) > 400 * strips


def test_given_poses_are_kept_and_the_rest_follows() -> None:
    block = simulated(2, 40.0, strips=2, images=5, ties=800)
    given = ("1_2", "1_3", "2_4")
    found = start_block(CAMERA, block.images(given), block.observations, NOTHING)
    assert all(found.poses[n] is block.poses[n] for n in given)
    assert [n for n, how in found.how.items() if how == "given"] == list(given)
    assert len(found.poses) == 10
    block.check(found)


def test_observed_positions_place_the_model() -> None:
    block = simulated(3, 40.0, strips=2, images=4, ties=700)
    rng = np.random.default_rng(3)
    names = tuple(block.poses)
    centers = np.array([p.center for p in block.poses.values()]) + rng.normal(0, 0.5, (8, 3))
    seen = ObservedPositions(names, centers, np.full((8, 3), 0.5), ("s",) * 8, np.arange(8.0))
    found = start_block(CAMERA, block.images(), block.observations, NOTHING, seen)
    assert len(found.poses) == 8
    block.check(found)


def test_images_with_enough_control_are_resected() -> None:
    block = simulated(4, 40.0, strips=1, images=3, ties=400, wrong=0.0)
    names = block.observations.points
    some = [n for n in names if n.startswith("T")][::20][:15]
    rng = np.random.default_rng(4)
    whole = start_block(CAMERA, block.images(tuple(block.poses)), block.observations, NOTHING)
    control = [n for n in some if n in whole.points]
    XYZ = np.array([whole.points[n] for n in control]) + rng.normal(0, 0.02, (len(control), 3))
    ground = GroundPoints(tuple(control), XYZ, np.full((len(control), 3), 0.02), np.zeros(len(control), bool))
    found = start_block(CAMERA, block.images(), block.observations, ground)
    assert "control points" in found.how.values()
    assert len(found.poses) == 3
    block.check(found, 2.0, 0.1)


def test_fault_16_what_cannot_be_connected_is_named() -> None:
    block = simulated(5, 40.0, strips=1, images=4, ties=500)
    # The third image loses its points but three; a fourth has none at all.
    keep = np.ones(len(block.observations), bool)
    for name, left in (("1_3", 3), ("1_4", 0)):
        mine = np.flatnonzero(block.observations.image == block.observations.images.index(name))
        keep[mine[left:]] = False
    found = start_block(CAMERA, block.images(("1_1", "1_2")), block.observations.where(keep), NOTHING)
    assert dict(found.left_out) == {
        "1_3": "its 3 points do not connect it to other images",
        "1_4": "no point is measured in it",
    }
    # Nothing known on the ground: a model, but no place for it.
    found = start_block(CAMERA, block.images(), block.observations, NOTHING)
    assert len(found.left_out) == 4 and not found.poses
    assert "0 control points: 0 points known in both systems" in found.left_out[0][1]
    nothing = ImagePoints.from_rows([])
    assert len(start_block(CAMERA, block.images(), nothing, NOTHING).left_out) == 4


def test_similarity_in_closed_form() -> None:
    rng = np.random.default_rng(6)
    a = rng.normal(size=(20, 3)) * 10
    R = rotation_opk(2.0, -0.7, 1.0)
    b = 37.0 * a @ R.T + at(1, 2, 3)
    found = fit_similarity(a, b)
    assert abs(found.scale - 37.0) < 1e-8
    np.testing.assert_allclose(found.R, R, atol=1e-10)
    np.testing.assert_allclose(found(a), b, atol=1e-6)
    # Points on a plane leave the sign of the third axis to the determinant.
    a[:, 2] = 0.0
    for k in range(20):
        turned = rotation_opk(*rng.uniform(-3, 3, 3))
        flat = fit_similarity(a[k:], 37.0 * a[k:] @ turned.T) if k < 17 else fit_similarity(a, a @ turned.T)
        np.testing.assert_allclose(flat.R, turned, atol=1e-8)
    b = 37.0 * a @ R.T
    b[[2, 5, 8, 11, 14]] += rng.normal(size=(5, 3)) * 100
    found, agree = robust_similarity(a, b, 1e-3)
    assert np.flatnonzero(~agree).tolist() == [2, 5, 8, 11, 14]
    np.testing.assert_allclose(found.R, R, atol=1e-9)
    with pytest.raises(GeometryError, match="2 points"):
        fit_similarity(a[:2], b[:2])
    with pytest.raises(GeometryError, match="one line"):
        fit_similarity(a[:1] * np.arange(4.0)[:, None], a[:1] * np.arange(4.0)[:, None])

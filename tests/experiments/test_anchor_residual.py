"""Residual of homogeneous anchors with a distorted lens: figures, order, and the compiler's own bound."""

import anchor_residual as experiment
import numpy as np
import pytest
from tools.pinhole import Pinhole

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.anchors import AnchorRule, compile_anchors
from photoplan.plan.ground import TileGround
from photoplan.targets.map import MapTarget


@pytest.mark.parametrize(
    ("side", "height", "quoted"),
    [(32.0, 5.0, 0.0048), (64.0, 5.0, 0.0146), (32.0, 20.0, 0.027), (32.0, 60.0, 0.220)],
)
def test_figures_quoted_on_the_page(side, height, quoted):
    assert experiment.worst_residual(side, height) == pytest.approx(quoted, rel=0.02)


def test_order_two_in_the_side():
    e = [experiment.worst_residual(s, 0.0) for s in (128.0, 64.0, 32.0)]
    np.testing.assert_allclose([e[0] / e[1], e[1] / e[2]], 4.0, rtol=1e-3)


def test_order_two_in_the_height_range():
    e = [experiment.worst_residual(0.5, h) for h in (20.0, 10.0, 5.0)]
    np.testing.assert_allclose([e[0] / e[1], e[1] / e[2]], 4.0, rtol=1e-2)


def test_leading_terms():
    plan, depth = experiment.leading_terms(64.0, 20.0)
    assert experiment.worst_residual(64.0, 0.0) == pytest.approx(plan, rel=1e-3)
    assert experiment.worst_residual(0.5, 20.0) == pytest.approx(depth, rel=1e-2)
    assert experiment.worst_residual(64.0, 20.0) == pytest.approx(plan + depth, rel=0.02)


def test_without_distortion_nothing_is_left(monkeypatch):
    monkeypatch.setattr(experiment, "K1", 0.0)
    assert experiment.worst_residual(512.0, 200.0) < 1e-10


def camera():
    """The experiment's camera as the package has it."""
    interior = Interior.digital((10_000, 7_500), (experiment.FOCAL, experiment.FOCAL))
    lens = Brown(k1=experiment.K1)
    return FrameCamera(interior, lens, Pose(np.array([0.0, 0.0, experiment.FLYING_HEIGHT]), np.eye(3)))


def test_the_packages_camera_is_the_experiments():
    XYZ = np.random.default_rng(3).uniform((-480, -360, -30), (480, 360, 30), (200, 3))
    h = experiment.homogeneous(XYZ)
    expected = h[:, :2] / h[:, 2:] * (1, -1) + (4_999.5, 3_749.5)
    np.testing.assert_allclose(project(camera(), XYZ), expected, atol=1e-9)


@pytest.mark.parametrize("tolerance", [0.02, 0.001])
def test_the_compiler_cuts_until_the_tolerance_is_met(tolerance):
    """A tile near the image's corner with a wall of 60 m: its cells are cut in the plan, those at the wall in h too."""
    window = Window(0, 0, 256, 256)
    grid = MapGrid(left=400.0, top=330.0, resolution=0.1, width=256, height=256, crs="EPSG:25832")
    relief = np.zeros((256, 256), np.float32)
    relief[:, 100:] = 60.0
    pose = Pose(np.array([0.0, 0.0, experiment.FLYING_HEIGHT]), np.eye(3))
    inside = Pinhole(pose, experiment.FOCAL, (10_000, 7_500), experiment.K1)  # its lens is in the anchors
    np.testing.assert_allclose(project(inside, [480.0, 360.0, 7.0]), project(camera(), [480.0, 360.0, 7.0]), atol=1e-9)
    anchors = compile_anchors(inside, TileGround.of(MapTarget(grid), window, relief), AnchorRule(tolerance, 2))
    assert 0 < anchors.residual <= tolerance
    layers = np.diff(anchors.box_start)
    wall = (anchors.rects[:, 0] < 100) & (anchors.rects[:, 2] > 100)
    assert (layers[wall] > 1).all()
    assert (layers[~wall] == 1).all()
    # The lens as a field: one box, and the residual is that of the nodes.
    anchors = compile_anchors(camera(), TileGround.of(MapTarget(grid), window, relief), AnchorRule(tolerance, 2))
    assert len(anchors.corners) == 1
    assert 0 < anchors.residual <= tolerance

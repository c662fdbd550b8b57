"""Cameras in the coordinates of a wall and of an image."""

from __future__ import annotations

import numpy as np
import pytest
from tools.small_block import X0, Y0

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.framed import FramedCamera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.brown import Brown
from photoplan.geometry.frames import Frame, ImageFrame, WallFrame
from photoplan.geometry.pose import Pose

CENTER = (X0 + 3.0, Y0 - 5.0, 300.0)
POSE = Pose.from_angles(CENTER, np.radians([4.0, -3.0, 20.0]))
CAMERA = FrameCamera(Interior.digital((160, 140), (400.0, 401.0), (2.0, -1.0)), Brown(k1=-0.05), POSE)
R = POSE.R_ground_camera
WALL = WallFrame.facing((X0, Y0, 100.0), 163.0, 80.0)
OWN = ImageFrame(CENTER, tuple(map(tuple, R.T)), 200.0)
BESIDE = ImageFrame((X0 - 40.0, Y0, 320.0), tuple(map(tuple, R.T)), 200.0)
FRAMES = pytest.mark.parametrize("frame", [WALL, OWN, BESIDE])


@FRAMES
def test_derivatives_and_rays(frame: Frame) -> None:
    camera = FramedCamera(CAMERA, frame)
    xy = np.random.default_rng(2).uniform((5, 5), (150, 130), (40, 2))
    origin, way = camera.rays(xy, 7.0)
    uvh = origin + (7.0 - origin[:, 2:]) / way[:, 2:] * way
    assert (way[:, 2] < 0).all() and project(camera, uvh) == pytest.approx(xy, abs=1e-6)
    assert project(camera, uvh + 9.0 * way) == pytest.approx(xy, abs=1e-6)
    J = camera.derivatives(uvh)
    for axis, step in enumerate(1e-3 * np.eye(3)):
        difference = (project(camera, uvh + step) - project(camera, uvh - step)) / 2e-3
        assert J[..., axis] == pytest.approx(difference, abs=1e-5)


def test_an_image_sees_its_own_frame_from_infinity() -> None:
    camera = FramedCamera(CAMERA, OWN)
    _, way = camera.rays([(3.0, 4.0), (150.0, 120.0)], -20.0)
    assert way == pytest.approx(np.array([(0.0, 0.0, -1.0)] * 2), abs=1e-9)
    vantage = camera.vantage
    assert not vantage.central and (vantage.floor, vantage.point[2]) == pytest.approx(OWN.heights)


def test_a_wall_is_seen_from_where_the_camera_is() -> None:
    vantage = FramedCamera(CAMERA, WALL).vantage
    assert vantage.central and WALL(vantage.point) == pytest.approx(np.array(CENTER))


def test_a_centre_in_front_of_an_image_bounds_what_is_seen() -> None:
    ahead = FrameCamera(CAMERA.interior, CAMERA.lens, Pose(np.array(CENTER) - 100.0 * R[:, 2], R))
    assert FramedCamera(ahead, OWN).vantage.point[2] == pytest.approx(200.0)

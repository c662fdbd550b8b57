"""Cameras in the coordinates of a wall and of an image."""

from __future__ import annotations

import numpy as np
import pytest
from tools.rpc_images import camera as rpc_camera
from tools.sim_strip import AHEAD, ORIGIN, line_camera, track
from tools.small_block import CRS, X0, Y0

from photoplan.cameras.base import Camera, project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.framed import FramedCamera, oriented_camera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.geometry.frames import CylinderFrame, Frame, ImageFrame, WallFrame
from photoplan.geometry.pose import Pose

CENTER = (X0 + 3.0, Y0 - 5.0, 300.0)
POSE = Pose.from_angles(CENTER, np.radians([4.0, -3.0, 20.0]))
CAMERA = FrameCamera(Interior.digital((160, 140), (400.0, 401.0), (2.0, -1.0)), Brown(k1=-0.05), POSE)
R = POSE.R_ground_camera
WALL = WallFrame.facing((X0, Y0, 100.0), 163.0, 80.0)
OWN = ImageFrame(CENTER, tuple(map(tuple, R.T)), 200.0)
BESIDE = ImageFrame((X0 - 40.0, Y0, 320.0), tuple(map(tuple, R.T)), 200.0)
AROUND = (-50.0, -50.0, 50.0, 50.0)
FRAMES = pytest.mark.parametrize("frame", [WALL, OWN, BESIDE])


@FRAMES
def test_derivatives_and_rays(frame: Frame) -> None:
    camera = FramedCamera(CAMERA, frame, AROUND)
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
    camera = FramedCamera(CAMERA, OWN, AROUND)
    _, way = camera.rays([(3.0, 4.0), (150.0, 120.0)], -20.0)
    assert way == pytest.approx(np.array([(0.0, 0.0, -1.0)] * 2), abs=1e-9)
    vantage = camera.vantage
    assert not vantage.central and (vantage.floor, vantage.point[2]) == pytest.approx(OWN.heights)


def test_a_wall_is_seen_from_where_the_camera_is() -> None:
    vantage = FramedCamera(CAMERA, WALL, AROUND).vantage
    assert vantage.central and WALL(vantage.point) == pytest.approx(np.array(CENTER))


def test_a_centre_in_front_of_an_image_bounds_what_is_seen() -> None:
    ahead = FrameCamera(CAMERA.interior, CAMERA.lens, Pose(np.array(CENTER) - 100.0 * R[:, 2], R))
    assert FramedCamera(ahead, OWN, AROUND).vantage.point[2] == pytest.approx(200.0)


def level() -> Camera:
    """Its rays go level, up and down from 2 m above the ground, 40 m north of a facade; they are bent."""
    pose = Pose.from_angles((X0, Y0 + 40.0, 102.0), np.radians([-90.0, 0.0, 180.0]))
    return oriented_camera(CAMERA.interior, CAMERA.lens, pose, crs=CRS, mean_ground=100.0, earth_curvature="strict")


STRIP = (*ORIGIN, 300.0)
BENT = {
    "frame": (level, WallFrame.facing((X0, Y0, 100.0), 0.0), (-6.0, -2.0, 7.0, 7.0)),
    "frame, vault": (level, CylinderFrame.vault((X0, Y0 - 20.0, 100.0), 0.0, 5.0), (-6.0, -8.0, 6.0, 8.0)),
    "line": (lambda: line_camera(AHEAD["backward"], track()), WallFrame.facing(STRIP, 80.0, 5.0), AROUND),
    "polynomials": (
        rpc_camera,
        WallFrame.facing((601_000.0, 5_339_000.0, 300.0), 150.0, 20.0),
        (0.0, 0.0, 900.0, 300.0),
    ),
}


@pytest.mark.parametrize("case", BENT)
def test_rays_that_are_bent_or_begin_nowhere(case: str) -> None:
    """They come to the places that are seen, with directions along which nothing moves in the image."""
    make, frame, around = BENT[case]
    camera = FramedCamera(make(), frame, around)
    uv = np.random.default_rng(4).uniform(around[:2], around[2:], (60, 2))
    uvh = np.column_stack([uv, np.full(60, 0.3)])
    xy = project(camera, uvh)
    assert np.isfinite(xy).all()
    point, way = camera.rays(xy, 0.3)
    assert point == pytest.approx(uvh, abs=1e-5 if case == "polynomials" else 1e-6)
    assert (np.abs(np.einsum("nij,nj->ni", camera.derivatives(uvh), way)) < 2e-3).all()
    sign = -1.0 if case == "frame, vault" else np.sign(way[0, 2])
    assert (np.sign(way[:, 2]) == sign).all() and np.linalg.norm(way, axis=1) == pytest.approx(1.0)
    assert np.isnan(camera.rays(np.full((1, 2), np.nan), 0.3)[0]).all()


def test_a_line_looks_from_as_far_as_the_target_is_long() -> None:
    make, frame, around = BENT["line"]
    vantage = FramedCamera(make(), frame, around).vantage
    assert not vantage.central and vantage.point == pytest.approx([0.0, 0.0, 100.0])

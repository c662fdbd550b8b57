"""Frames of walls and images: there and back, their derivatives, and which way they look."""

from __future__ import annotations

import numpy as np
import pytest
from tools.small_block import X0, Y0

from photoplan.geometry.frames import CylinderFrame, Frame, ImageFrame, WallFrame

WALL = WallFrame.facing((X0, Y0, 100.0), 163.0, -4.0)
IMAGE = ImageFrame((X0, Y0, 300.0), WallFrame.facing((0.0, 0.0, 0.0), 200.0, 71.0).axes, 200.0)
VAULT = CylinderFrame.vault((X0, Y0, 100.0), 24.0, 110.0, 12.0)
COLUMN = CylinderFrame.column((X0, Y0, 100.0), 200.0, 95.0)
FRAMES = pytest.mark.parametrize("frame", [WALL, IMAGE, VAULT, COLUMN])


@pytest.fixture(scope="module")
def uvh() -> np.ndarray:
    return np.random.default_rng(1).uniform((-90, -60, -40), (90, 60, 80), (5, 7, 3))


@FRAMES
def test_there_and_back(frame: Frame, uvh: np.ndarray) -> None:
    assert frame.inverse(frame(uvh)) == pytest.approx(uvh, abs=1e-8)
    assert {frame: 1}[frame] == 1


@FRAMES
def test_derivatives_are_those_of_differences(frame: Frame, uvh: np.ndarray) -> None:
    J = frame.jacobian(uvh)
    for axis, step in enumerate(1e-3 * np.eye(3)):
        difference = (frame(uvh + step) - frame(uvh - step)) / 2e-3
        assert J[..., axis] == pytest.approx(difference, abs=1e-6)


@pytest.mark.parametrize("frame", [WALL, IMAGE])
def test_rays_stay_straight(frame: Frame, uvh: np.ndarray) -> None:
    """Points of a ray of the ground lie on the line that it is in the frame, and directions are units."""
    origin = np.array([X0 - 30.0, Y0 + 20.0, 310.0])
    XYZ = frame(uvh)
    way = XYZ - origin
    point, direction = frame.lines(np.broadcast_to(origin, way.shape), way, 12.0)
    assert np.linalg.norm(direction, axis=-1) == pytest.approx(np.linalg.norm(way, axis=-1) if frame is WALL else 1.0)
    along = (uvh[..., 2:] - point[..., 2:]) / direction[..., 2:]
    assert point + along * direction == pytest.approx(uvh, abs=1e-6)


@pytest.mark.parametrize(("frame", "camera"), [(VAULT, (30.0, 10.0, 90.0)), (COLUMN, (-20.0, 10.0, 300.0))])
def test_rays_meet_a_height_of_a_cylinder_where_they_are_seen(frame: CylinderFrame, camera: tuple) -> None:
    """From inside the far side, from outside the near one; the direction is that of the ray there."""
    uvh = np.random.default_rng(2).uniform((-60, -40, 20), (60, 60, 20.000001), (40, 3))
    origin = frame(camera)
    way = frame(uvh) - origin
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    point, direction = frame.lines(np.broadcast_to(origin, way.shape), way, 20.0)
    assert point == pytest.approx(uvh, abs=1e-4) and (direction[:, 2] < 0).all()
    after = frame.inverse(frame(point) + 1e-3 * way) - point
    assert after / np.linalg.norm(after, axis=1, keepdims=True) == pytest.approx(direction, abs=1e-4)
    away = frame.lines(np.broadcast_to(origin, way.shape), -way, 20.0)[0]
    assert np.isnan(away).all() if frame is COLUMN else np.isfinite(away).all()


def test_which_way_cylinders_lie() -> None:
    vault = CylinderFrame.vault((1.0, 2.0, 3.0), 0.0, 5.0)
    # Lying on one's back with the feet to the south and looking up, east is on the left.
    assert vault((0.0, 0.0, 0.0)) == pytest.approx((1, 2, 8)) and vault((0.0, 4.0, 1.0)) == pytest.approx((1, 6, 7))
    assert vault((2.5 * np.pi, 0.0, 0.0)) == pytest.approx((-4, 2, 3)) and vault.heights[1] < 5
    column = CylinderFrame.column((1.0, 2.0, 3.0), 180.0, 5.0)
    assert column((0.0, 1.0, 2.0)) == pytest.approx((1, -5, 4)) and column((2.5 * np.pi, 0, 0)) == pytest.approx(
        (6, 2, 3)
    )


@pytest.mark.parametrize(
    ("azimuth", "tilt", "right", "up"),
    [
        (180, 0, (1, 0, 0), (0, 0, 1)),
        (0, 0, (-1, 0, 0), (0, 0, 1)),
        (90, 0, (0, 1, 0), (0, 0, 1)),
        (180, 90, (1, 0, 0), (0, 1, 0)),
        (-180, -90, (1, 0, 0), (0, -1, 0)),
    ],
)
def test_a_wall_is_seen_from_outside(azimuth: float, tilt: float, right: tuple, up: tuple) -> None:
    frame = WallFrame.facing((1.0, 2.0, 3.0), azimuth, tilt)
    assert (np.array(frame.axes) == [right, up, np.cross(right, up)]).all()
    assert (frame((0.0, 0.0, 0.0)) == (1.0, 2.0, 3.0)).all()


def test_heights_along_an_image_are_even_in_parallax() -> None:
    """Depth 1 / (1 + h / D), nothing at infinity and beyond, and nothing behind the centre."""
    towards = np.array(IMAGE.axes)[2]
    depths = (np.array(IMAGE.origin) - IMAGE([(5.0, 7.0, h) for h in (-100.0, 0.0, 200.0)])) @ towards
    assert depths == pytest.approx([400.0, 200.0, 100.0])
    assert np.isnan(IMAGE([(0.0, 0.0, -200.0), (0.0, 0.0, -300.0)])).all()
    assert np.isnan(IMAGE.inverse(np.array([IMAGE.origin, np.array(IMAGE.origin) + towards]))).all()
    low, high = IMAGE.heights
    assert low == pytest.approx(-196.0) and high == pytest.approx(600.0)

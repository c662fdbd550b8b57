"""Rational polynomials fitted to other cameras."""

from __future__ import annotations

import numpy as np
import pytest
from tools.pinhole import Pinhole
from tools.rpc_images import CRS, camera, functions

from photoplan.cameras.base import project
from photoplan.cameras.rpc import RpcCamera, fit_rpc, fitted_functions
from photoplan.errors import GeometryError
from photoplan.geometry.local import GeodeticGround
from photoplan.geometry.pose import Pose

GROUND = GeodeticGround(CRS)


def aerial(tilt: float = 0.0) -> Pinhole:
    """A frame image from 3000 m near Vienna."""
    return Pinhole(Pose.from_angles((600_000.0, 5_340_000.0, 3000.0), (tilt, 0.02, 0.7)), 12500.0, (8000, 6000))


def test_polynomials_are_found_again() -> None:
    rpc = functions()
    at = np.random.default_rng(1).uniform(-1, 1, (3000, 3)) * rpc.ground_scale + rpc.ground_offset
    found = fitted_functions(at[:2000], rpc(at[:2000]))
    assert np.abs(found(at[2000:]) - rpc(at[2000:])).max() < 1e-6


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_frame_image_as_polynomials(tilt: float) -> None:
    """What they leave is told, and is what is left at other places."""
    frame = aerial(tilt)
    found = fit_rpc(frame, GROUND, (100.0, 600.0))
    assert found.worst < 1e-3
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 1, (500, 2)) * frame.size - 0.5
    origin, d = frame.rays(xy)
    XYZ = origin + ((rng.uniform(100, 600, 500) - origin[:, 2]) / d[:, 2])[:, None] * d
    seen = RpcCamera(found.functions, GROUND, frame.size)
    miss = np.hypot(*(project(seen, XYZ) - xy).T)
    assert miss.max() <= 1.2 * found.worst + 1e-9
    assert max(found.rms) <= found.worst


@pytest.mark.parametrize("kappa", [-2.0, 0.1, 1.5])
def test_a_low_flight_gives_no_pole(kappa: float) -> None:
    """Over 300 m many quotients are the same function: what rounding leaves of them had poles in the image."""
    frame = Pinhole(Pose.from_angles((500_300.0, 5_300_200.0, 400.0), (0.014, -0.02, kappa)), 200.0, (200, 150))
    found = fit_rpc(frame, GROUND, (86.0, 114.0))
    assert found.worst < 1e-6
    XYZ = np.stack(frame.rays(np.array([[0.0, 0.0], [199.0, 149.0], [100.0, 75.0]])), axis=0)
    ground = XYZ[0] + ((80.0 - XYZ[0, :, 2]) / XYZ[1, :, 2])[:, None] * XYZ[1]
    seen = RpcCamera(found.functions, GROUND, frame.size)
    assert np.abs(project(seen, ground) - project(frame, ground)).max() < 1e-3


def test_polynomials_of_polynomials_over_a_part_of_the_heights() -> None:
    found = fit_rpc(camera(), GROUND, (100.0, 500.0))
    assert found.worst < 1e-6


def test_fault_16_no_volume_or_no_view_of_it() -> None:
    with pytest.raises(GeometryError, match="spread over a volume"):
        fit_rpc(aerial(), GROUND, (200.0, 200.0))
    with pytest.raises(GeometryError, match="looks down"):
        fit_rpc(aerial(1.4), GROUND, (100.0, 600.0))
    with pytest.raises(GeometryError, match="39 and more"):
        fitted_functions(np.zeros((10, 3)), np.zeros((10, 2)))

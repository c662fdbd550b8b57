"""Rays onto hybrid terrain: planes to a tenth of a millimetre, walls on their face, ridges however thin."""

from __future__ import annotations

import numpy as np
import pytest
from tools.hybrid_models import line, model
from tools.pinhole import Pinhole

from photoplan.cameras.base import project
from photoplan.geometry.pose import Pose
from photoplan.surfaces.shifted import intersect
from photoplan.surfaces.units import UnitLayout

LAYOUT = UnitLayout(0.0, 40.0, 20.0, 2, 2)


def oblique(height: float = 280.0) -> Pinhole:
    return Pinhole(Pose.from_angles((20.0, -30.0, height), (0.8, 0.05, 0.1)), 1500.0, (800, 600))


def test_rays_onto_a_plane() -> None:
    def plane(X, Y):
        return 250 + 0.125 * X - 0.25 * Y

    surface, _ = model(LAYOUT, 8, [line([(3, 2, plane(3, 2)), (36, 37, plane(36, 37))])], plane)
    camera = oblique()
    rng = np.random.default_rng(2)
    XY = rng.uniform(2, 38, (40, 2))
    truth = np.column_stack([XY, plane(*XY.T)])
    xy = project(camera, truth)
    height_range = surface.height_range(LAYOUT.bounds)
    np.testing.assert_allclose(intersect(camera, xy, surface, height_range), truth, atol=1e-5)


def test_rays_onto_a_wall_end_on_its_face() -> None:
    # The terrain north of the wall is 4 m higher; the camera looks north.
    wall = line([(-1, 20.3, 254.0), (41, 20.3, 254.0)], [250.0, 250.0])
    surface, _ = model(LAYOUT, 8, [wall], lambda X, Y: np.where(Y > 20.3, 254.0, 250.0))
    camera = oblique()
    truth = np.array([(10, 20.3, 252.0), (30, 20.3, 250.5), (20, 20.3, 253.9), (15, 10, 250), (25, 30, 254)])
    found = intersect(camera, project(camera, truth), surface, (249.0, 255.0))
    np.testing.assert_allclose(found, truth, atol=1e-5)


def test_a_thin_ridge_is_not_missed() -> None:
    ridge = [line([(-1, y, z), (41, y, z)]) for y, z in ((20.0, 250.0), (20.05, 256.0), (20.1, 250.0))]
    surface, _ = model(LAYOUT, 4, ridge, lambda X, Y: 250 + 0 * X)
    camera = oblique()
    behind = project(camera, np.array([(20.0, 20.06, 255.0), (20, 24.0, 250.0)]))
    found = intersect(camera, behind, surface, (240.0, 260.0))
    assert (found[:, 2] > 250.5).all() and (np.abs(found[:, 1] - 20.025) < 0.03).all()


def test_rays_that_miss() -> None:
    surface, _ = model(LAYOUT, 4, [], lambda X, Y: np.where((X > 8) & (X < 22), np.nan, 250.0))
    up = Pinhole(Pose.from_angles((20.0, 20.0, 200.0), (np.pi, 0, 0)), 1500.0, (800, 600))
    down = Pinhole(Pose.from_angles((5.0, 20.0, 300.0), (0, 0, 0)), 1500.0, (801, 601))
    assert np.isnan(intersect(up, [(400, 300)], surface, (240, 260))).all()
    assert intersect(down, [(400, 300)], surface, (240, 260))[0] == pytest.approx([5, 20, 250], abs=1e-6)
    assert np.isnan(intersect(down, [(400 + 300, 300)], surface, (240, 260))).all()  # into the gap
    assert np.isnan(intersect(oblique(240), [(400, 300)], surface, (245, 260))).all()  # from below

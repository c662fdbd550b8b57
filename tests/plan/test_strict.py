"""Tolerance 0, and tolerances that anchors cannot meet with fewer boxes than pixels: every pixel strictly."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.kernels.positions import positions
from photoplan.plan.anchors import AnchorRule, compile_anchors, field_grid
from photoplan.plan.ground import TileGround
from photoplan.targets.map import MapTarget

SIDE = 96
CAMERA = FrameCamera(
    Interior.digital((2736, 1824), (2000.0, 2000.0)),
    Brown(k1=-0.11, k2=0.03),
    Pose.from_angles((0.0, -100.0, 120.0), np.radians((40.0, 3.0, 10.0))),
)
TARGET = MapTarget(MapGrid(-30.0, 30.0, 0.4, 150, 150, "EPSG:25832"))


def ground() -> TileGround:
    relief = np.random.default_rng(1).uniform(-10, 10, (SIDE, SIDE)).astype(np.float32)
    relief[3:6, 10:30] = np.nan
    return TileGround.of(TARGET, Window(0, 0, SIDE, SIDE), relief)


@pytest.mark.parametrize("tolerance", [0.0, 1e-6])
def test_pixels_lie_where_the_camera_says(tolerance: float) -> None:
    tile = ground()
    anchors = compile_anchors(CAMERA, tile, AnchorRule(tolerance, 2))
    assert anchors is not None
    row, col = np.mgrid[:SIDE, :SIDE].astype(float)
    strict = project(CAMERA, TARGET.to_ground(np.stack([col, row, tile.relief.astype(float)], axis=-1)))
    found = positions(anchors.arrays, tile.relief) + np.array([anchors.source_window.col, anchors.source_window.row])
    there = np.isfinite(tile.relief)
    assert np.isnan(found[~there]).all()
    assert np.abs(found[there] - strict[there]).max() < 3e-4  # single precision at 2000 pixels
    exact = anchors.corners[..., :2].mean(axis=1) + np.array([anchors.source_window.col, anchors.source_window.row])
    np.testing.assert_allclose(exact, strict[there], atol=1e-9)
    assert anchors.residual == 0 and len(anchors.corners) <= SIDE**2 and anchors.field.size == 0


def test_scales_are_those_of_the_anchors() -> None:
    tile = ground()
    strict, usual = (compile_anchors(CAMERA, tile, AnchorRule(tolerance, 2)) for tolerance in (0.0, 0.02))
    assert strict is not None and usual is not None
    # The anchors' scales are those of corners of blocks, with all heights of their relief.
    assert usual.scales[0] <= strict.scales[0] < strict.scales[1] <= usual.scales[1]
    a, b = strict.source_window, usual.source_window
    assert np.abs(np.subtract([a.col, a.row, *a.stop], [b.col, b.row, *b.stop])).max() < 80


def test_nodes_are_never_finer_than_pixels() -> None:
    grid = field_grid(CAMERA.field, CAMERA.size, 1e-9)
    assert min(grid.spacing) == 1


def test_what_a_source_is_not_wanted_for_is_not_read() -> None:
    tile = ground()
    wanted = tile.ranges.copy()
    wanted[0], wanted[1] = np.inf, -np.inf
    assert compile_anchors(CAMERA, tile, AnchorRule(0.0, 2), wanted) is None
    wanted[:, 0, 0] = tile.ranges[:, 0, 0]
    part, whole = (compile_anchors(CAMERA, tile, AnchorRule(0.0, 2), some) for some in (wanted, None))
    assert part is not None and whole is not None
    assert part.source_window.size < 0.9 * whole.source_window.size

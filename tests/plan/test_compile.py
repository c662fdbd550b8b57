"""Anchors meet their tolerance everywhere, and cost few projections."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.pinhole import Pinhole, vertical

from photoplan.cameras.base import project
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.anchors import AnchorRule, Anchors, compile_anchors
from photoplan.plan.ground import TileGround
from photoplan.targets.map import MapTarget

GRID = MapGrid(760, 2310, 0.06, 9400, 9300, "EPSG:32615")
TARGET = MapTarget(GRID)
RULE = AnchorRule(0.02, 2)


def positions(anchors: Anchors, relief: np.ndarray) -> np.ndarray:
    """Trilinear homogeneous interpolation, written out for one pixel at a time; NaN outside all rectangles."""
    xy = np.full((*relief.shape, 2), np.nan)
    for i, (c0, r0, c1, r1) in enumerate(anchors.rects):
        boxes = range(anchors.box_start[i], anchors.box_start[i + 1])
        for row in range(r0, r1):
            for col in range(c0, c1):
                h = float(relief[row, col])
                if not np.isfinite(h):
                    continue
                box = next((b for b in boxes if h <= anchors.box_heights[b, 1]), boxes[-1])
                low, high = anchors.box_heights[box]
                f = np.array([(h - low) / (high - low), (row - r0 + 0.5) / (r1 - r0), (col - c0 + 0.5) / (c1 - c0)])
                corner = anchors.corners[box].reshape(2, 2, 2, 3)
                for t in f:
                    corner = corner[0] * (1 - t) + corner[1] * t
                xy[row, col] = corner[:2] / corner[2] + (anchors.source_window.col, anchors.source_window.row)
    return xy


def strict(camera: Pinhole, window: Window, relief: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    return project(camera, TARGET.to_ground(np.stack([u, v, relief.astype(float)], axis=-1)))


def rough(shape: tuple[int, int], seed: int, wall: float) -> np.ndarray:
    """Relief with noise and a wall through its middle."""
    relief = 100 + 5 * np.random.default_rng(seed).random(shape)
    relief[:, shape[1] // 2 :] += wall
    return relief.astype(np.float32)


@pytest.mark.parametrize("side", [16, 96])
def test_pinhole_is_exact_in_one_cell_of_any_size(side: int) -> None:
    camera, window = vertical(), Window(4000, 4000, side, side)
    relief = rough((side, side), 1, 40)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), RULE)
    assert anchors is not None and len(anchors.rects) == len(anchors.corners) == 1
    assert anchors.residual < 1e-9
    assert np.abs(positions(anchors, relief) - strict(camera, window, relief)).max() < 1e-9


@settings(max_examples=15, deadline=None)
@given(
    col=st.integers(0, 9300),
    row=st.integers(0, 9200),
    wall=st.sampled_from([0.0, 20.0, 60.0]),
    seed=st.integers(0, 9),
    tolerance=st.sampled_from([0.02, 0.005]),
)
def test_distorted_lens_meets_the_tolerance_at_every_pixel(
    col: int, row: int, wall: float, seed: int, tolerance: float
) -> None:
    camera, window = vertical(k1=-0.08), Window(col, row, 80, 64)
    relief = rough((64, 80), seed, wall)
    anchors = compile_anchors(
        camera, TileGround.of(TARGET, window, relief), dataclasses.replace(RULE, tolerance=tolerance)
    )
    truth = strict(camera, window, relief)
    inside = ((truth >= -0.5) & (truth <= np.array(camera.size) - 0.5)).all(axis=-1)
    if anchors is None:
        assert not inside.any()
        return
    miss = np.abs(positions(anchors, relief) - truth)[inside]
    assert np.isfinite(miss).all(), "a pixel inside the image has no anchors"
    assert miss.max(initial=0) <= tolerance
    assert anchors.residual <= tolerance


def test_residual_falls_with_the_square_of_the_cell() -> None:
    """Convergence order 2 in u and v: what the splitting relies on."""
    camera = vertical(k1=-0.08)
    misses = []
    for side in (128, 64, 32, 16):
        window, relief = Window(6628 - side // 2, 4128 - side // 2, side, side), np.full((side, side), 100, np.float32)
        anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), AnchorRule(1e3, 2))
        assert anchors is not None and len(anchors.rects) == 1
        misses.append(anchors.residual)
    orders = np.log2(np.array(misses[:-1]) / misses[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.15)


def test_a_wall_is_split_in_height_and_boxes_leave_no_gap() -> None:
    camera = vertical(k1=-0.3, focal=6000)
    relief = rough((64, 64), 3, 150)
    anchors = compile_anchors(camera, TileGround.of(TARGET, Window(2000, 2000, 64, 64), relief), AnchorRule(0.005, 2))
    assert anchors is not None
    piles = np.diff(anchors.box_start)
    assert piles.max() > 1
    for start, end in zip(anchors.box_start[:-1], anchors.box_start[1:]):
        np.testing.assert_allclose(anchors.box_heights[start : end - 1, 1], anchors.box_heights[start + 1 : end, 0])


def test_rectangles_cover_the_tile_once() -> None:
    camera = vertical(k1=-0.08)
    relief = rough((128, 200), 5, 30)
    anchors = compile_anchors(camera, TileGround.of(TARGET, Window(5000, 5000, 200, 128), relief), RULE)
    assert anchors is not None
    hits = np.zeros(relief.shape, int)
    for c0, r0, c1, r1 in anchors.rects:
        hits[r0:r1, c0:c1] += 1
    assert (hits == 1).all()


def test_the_source_window_holds_every_position_with_the_kernel() -> None:
    camera, window = vertical(k1=-0.08), Window(3000, 6000, 64, 64)
    relief = rough((64, 64), 7, 25)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), RULE)
    assert anchors is not None
    xy = strict(camera, window, relief)
    w = anchors.source_window
    assert (xy >= np.array([w.col + 2, w.row + 2])).all()
    assert (xy <= np.array(w.stop) - 3).all()


def test_scale_is_that_of_the_mapping() -> None:
    camera, window = vertical(), Window(3000, 6000, 64, 64)
    relief = np.full((64, 64), 100, np.float32)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), RULE)
    assert anchors is not None
    assert anchors.scales == pytest.approx((12500 / 700 * 0.06,) * 2, rel=0.05)


def test_nothing_behind_the_camera_and_nothing_beside_the_image() -> None:
    relief = np.full((64, 64), 100, np.float32)
    assert compile_anchors(vertical(), TileGround.of(TARGET, Window(-90000, 0, 64, 64), relief), RULE) is None
    upward = Pinhole(Pose.from_angles((1000, 2000, 800), (np.pi, 0, 0)), 12500, (800, 600))
    assert compile_anchors(upward, TileGround.of(TARGET, Window(4000, 5000, 64, 64), relief), RULE) is None
    assert compile_anchors(vertical(), TileGround.of(TARGET, Window(4000, 4000, 64, 64), relief * np.nan), RULE) is None


def test_horizontal_view_divides_nothing_behind_the_camera() -> None:
    """A tile below a camera that looks at the horizon: what lies in front is exact, the rest is left out (fault 21)."""
    camera = Pinhole(Pose.from_angles((1000, 2000, 110), (np.pi / 2 - 0.2, 0, 0)), 500, (800, 600))
    grid = MapGrid(968, 2032, 0.5, 128, 128, "EPSG:32615")
    relief = np.full((128, 128), 100, np.float32)
    anchors = compile_anchors(camera, TileGround.of(MapTarget(grid), Window(0, 0, 128, 128), relief), RULE)
    assert anchors is not None
    assert (anchors.corners[..., 2] > 0).all()
    v, u = np.mgrid[:128, :128].astype(float)
    truth = project(camera, MapTarget(grid).to_ground(np.stack([u, v, relief.astype(float)], axis=-1)))
    got = positions(anchors, relief)
    seen = np.isfinite(got).all(axis=-1)
    assert np.abs(got - truth)[seen].max() < 1e-6
    inside = ((truth >= -0.5) & (truth <= (799.5, 599.5))).all(axis=-1)
    assert inside.sum() > 2000 and (inside & ~seen).sum() == 0


def test_tolerance_must_not_be_negative() -> None:
    with pytest.raises(UsageError, match="tolerance"):
        AnchorRule(-0.02, 2)


def test_the_rule_of_a_kernel_has_half_its_support_and_nearest_keeps_grey_values() -> None:
    rules = [AnchorRule.of(name, 0.5) for name in ("nearest", "bilinear", "bicubic", "bicubic-1", "lanczos3")]
    assert [rule.radius for rule in rules] == [1, 1, 2, 2, 3]
    assert [rule.reduces for rule in rules] == [False, True, True, True, True]
    assert {rule.tolerance for rule in rules} == {0.5}

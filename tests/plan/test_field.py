"""The field of a projection: tabulated within its half of the tolerance, and added by the kernels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.arrays import noise, product
from tools.thinned import examples, some
from tools.twin import TwinSource, twin_compose

from photoplan.cameras.base import project
from photoplan.cameras.fiducials import Bilinear2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Brown, Fisheye, Interior, Lens, NoLens, RadialTable, Reversed
from photoplan.engine.execute import ArrayReader, Source, render
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.kernels.positions import positions
from photoplan.plan.anchors import AnchorRule, Anchors, compile_anchors, field_grid
from photoplan.plan.footprint import Tile
from photoplan.plan.ground import TileGround
from photoplan.plan.product import compile_tile
from photoplan.surfaces.base import LevelSurface
from photoplan.targets.map import MapTarget

SIZE = (4000, 3000)
LENSES = {
    "barrel": Brown(k1=-0.12, k2=0.02, p1=0.001, p2=-0.0007, b1=0.0003),
    "pincushion": Brown(k1=0.08, k2=0.01),
    "table": RadialTable((0.1, 0.2, 0.3, 0.4, 0.55, 0.7), (1e-5, 3e-5, -2e-5, -9e-5, 1e-4, 2e-4)),
    "reversed": Reversed(Brown(k1=0.05)),
    "fisheye": Fisheye(0.02, -0.01),
}
TARGET = MapTarget(MapGrid(0, 600, 0.1, 8000, 6000, "EPSG:25832"))


def oblique(lens: Lens, tilt: float = 40.0) -> FrameCamera:
    """An oblique drone image of ground pixels from 0.06 to 0.15 m."""
    pose = Pose.from_angles((400.0, 150.0, 260.0), np.radians((tilt, 4.0, 12.0)))
    return FrameCamera(Interior.digital(SIZE, (3100.0, 3095.0), (8.0, -5.0)), lens, pose)


def rough(window: Window, seed: int = 0) -> np.ndarray:
    relief = 20 + 15 * np.random.default_rng(seed).random((window.height, window.width))
    relief[:, window.width // 2 :] += 25
    return relief.astype(np.float32)


def strict(camera: FrameCamera, window: Window, relief: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    return project(camera, TARGET.to_ground(np.stack([u, v, relief.astype(float)], axis=-1)))


def engine_positions(anchors: Anchors, relief: np.ndarray) -> np.ndarray:
    """What the kernels work with, in pixels of the image."""
    w = anchors.source_window
    return positions(anchors.arrays, relief).astype(float) + np.array([w.col, w.row])


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("tolerance", some([0.02, 0.002], 1))
def test_one_box_a_tile_and_the_engines_positions_keep_the_reported_residual(name: str, tolerance: float) -> None:
    camera = oblique(LENSES[name])
    seen = 0
    for col, row in ((3600, 2600), (2000, 3600), (5600, 1400)):
        window = Window(col, row, 512, 512)
        relief = rough(window)
        anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), AnchorRule(tolerance, 2))
        truth = strict(camera, window, relief)
        inside = ((truth >= -0.5) & (truth <= np.array(SIZE) - 0.5)).all(axis=-1)
        if anchors is None:
            assert not inside.any()
            continue
        assert len(anchors.corners) == 1
        assert anchors.residual <= tolerance
        found = engine_positions(anchors, relief)
        miss = np.hypot(*np.moveaxis(found - truth, -1, 0))[inside]
        assert np.isfinite(miss).all(), "a pixel inside the image has no position"
        # The engine works in single precision: 1e-4 px beside what is reported.
        assert miss.max(initial=0) <= anchors.residual + 1e-4
        w, pixel = anchors.source_window, np.clip(truth[inside], 0, np.array(SIZE) - 1)
        assert (pixel >= (w.col, w.row)).all() and (pixel <= np.array(w.stop) - 1).all()
        seen += int(inside.sum())
    assert seen > 200_000


def test_without_a_lens_there_is_no_field_and_nothing_is_left() -> None:
    camera, window = oblique(NoLens()), Window(3600, 2600, 512, 512)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, rough(window)), AnchorRule(0.02, 2))
    assert camera.field is None and anchors is not None
    assert anchors.field.size == 0 and len(anchors.corners) == 1
    assert anchors.residual < 1e-11 * max(SIZE)


def test_bilinear_interior_orientation_is_a_field() -> None:
    plane = Bilinear2D(50.0, 0.3, 2e-3, 2000.0, 0.2, -50.0, -3e-3, 1500.0)
    pose = Pose.from_angles((400.0, 300.0, 260.0), np.radians((3, 4.0, 12.0)))
    camera = FrameCamera(Interior(60.0, (0.02, -0.01), plane, SIZE), NoLens(), pose)
    window = Window(3600, 2600, 256, 256)
    relief = rough(window)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), AnchorRule(0.02, 2))
    assert anchors is not None and len(anchors.corners) == 1 and anchors.residual <= 0.02
    found = engine_positions(anchors, relief)
    assert np.abs(found - strict(camera, window, relief)).max() <= anchors.residual + 1e-4


def test_a_fisheye_beyond_the_widest_field_keeps_its_lens_in_the_anchors() -> None:
    pose = Pose.from_angles((400.0, 300.0, 160.0), np.radians((10.0, 4.0, 12.0)))
    camera = FrameCamera(Interior.digital(SIZE, (1400.0, 1400.0)), Fisheye(), pose)
    assert camera.field is None
    window = Window(3600, 2600, 128, 128)
    relief = np.full((128, 128), 20, np.float32)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), AnchorRule(0.02, 2))
    assert anchors is not None and 0 < anchors.residual <= 0.02
    found = engine_positions(anchors, relief)
    assert np.abs(found - strict(camera, window, relief)).max() <= 0.02 + 1e-4


@pytest.mark.parametrize("name", LENSES)
def test_the_spacing_of_nodes_keeps_to_the_tolerance_and_is_not_wasteful(name: str) -> None:
    field = oblique(LENSES[name]).field
    assert field is not None
    grid = field_grid(field, SIZE, 0.01)
    x0, y0, x1, y1 = grid.bounds
    whole = grid.table(np.array([x0, y0]), np.array([x1, y1]))
    assert 0.01 / 8 < whole.residual <= 0.0125
    # Tiles that overlap have their nodes in common, whatever is cut out.
    part = grid.table(np.array([700.0, 800.0]), np.array([1500.0, 1300.0]))
    col, row = np.round((np.array(part.first) - np.array(whole.first)) / grid.spacing).astype(int)
    rows, cols = part.nodes.shape[:2]
    same = whole.nodes[row : row + rows, col : col + cols].astype(float) + whole.origin
    np.testing.assert_allclose(part.nodes.astype(float) + part.origin, same, atol=1e-4)


def test_a_crop_of_a_tile_has_the_same_positions_bit_by_bit() -> None:
    camera, window = oblique(LENSES["barrel"]), Window(3600, 2600, 300, 300)
    relief = rough(window)
    anchors = compile_anchors(camera, TileGround.of(TARGET, window, relief), AnchorRule(0.02, 2))
    assert anchors is not None
    whole = positions(anchors.arrays, relief)
    part = positions(anchors.arrays, np.ascontiguousarray(relief[40:200, 270:300]), (270, 40))
    np.testing.assert_array_equal(part, whole[40:200, 270:300])


@pytest.mark.parametrize("kernel", some(["bilinear", "bicubic", "lanczos3"], 1))
@settings(max_examples=examples(3, 10), deadline=None)
@given(
    name=st.sampled_from(sorted(LENSES)),
    kappa=st.floats(-3.1, 3.1),
    resolution=st.sampled_from([0.6, 1.0, 1.3, 2.4, 9.0]),
)
def test_every_pixel_as_the_twin_says(kernel: str, name: str, kappa: float, resolution: float) -> None:
    """Positions, source window, reduction and widening of the kernel count the field."""
    pose = Pose.from_angles((0.123, 0.377, 100), (0.3, -0.1, kappa))
    camera = FrameCamera(Interior.digital((180, 140), (162.0, 162.0)), LENSES[name], pose)
    half = 24 * min(resolution, 2.4)
    grid = MapGrid.covering((-half, 10 - half, half, 10 + half), resolution, "EPSG:1")
    plan, tile, surface = product(grid, tolerance=1e-3), Tile(0, grid.window), LevelSurface(0.0)
    reader = ArrayReader(noise(3, 140, 180, "float32"))
    got = render(plan, tile, [Source(camera, reader)], surface, kernel)
    level = compile_tile(plan, tile, {0: camera}, surface).layers[0].level
    assert (level > 0) == (resolution == 9.0)
    twin = TwinSource(reader.image, None, camera, level)
    want, good = twin_compose(plan.target, tile.window, surface, [twin], None, kernel)
    assert got.valid is not None and got.values is not None
    assert np.count_nonzero(got.valid != good) <= 3
    # 1e-3 px of position, and differences of positions instead of derivatives for the twin's scales.
    assert np.abs(got.values - want)[:, got.valid & good].max() <= 0.03

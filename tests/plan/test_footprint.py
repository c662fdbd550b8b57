"""Footprints: what an image sees of the ground; never too small, and found without reading far terrain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from cameras.camera_examples import BROWN
from numpy.typing import NDArray
from tools.large_block import LEFT, TOP, relief
from tools.pinhole import Pinhole, vertical
from tools.thinned import some, thinned

from photoplan.cameras.base import CentralCamera, project
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Interior, Lens, NoLens
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.footprint import FAR, covered_tiles, footprint, image_border
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.raster import RasterSurface

GROUND = LevelSurface(100.0)
SEARCH = (0.0, 0.0, 4000.0, 4000.0)
MESH = 25.0


def test_outline_projects_back_onto_the_border() -> None:
    camera = vertical()
    seen = footprint(camera, GROUND, SEARCH)
    back = project(camera, seen.outline)
    np.testing.assert_allclose(back, image_border(camera.size), atol=0.01)
    assert seen.on_surface == 1.0


def test_bounds_hold_the_footprint_and_little_more() -> None:
    seen = footprint(vertical(), GROUND, SEARCH)
    assert seen.bounds is not None
    low, high = seen.outline[:, :2].min(axis=0), seen.outline[:, :2].max(axis=0)
    xmin, ymin, xmax, ymax = seen.bounds
    assert xmin <= low[0] and ymin <= low[1] and xmax >= high[0] and ymax >= high[1]
    assert (xmax - xmin) * (ymax - ymin) < 1.05 * np.prod(high - low)


def test_a_small_footprint_on_a_large_terrain_is_found() -> None:
    seen = footprint(vertical(size=(80, 60)), GROUND, (-4e4, -4e4, 4e4, 4e4))
    assert seen.bounds is not None
    assert seen.bounds[2] - seen.bounds[0] < 12


def test_nothing_is_seen_upwards_or_beside_the_terrain() -> None:
    up = Pinhole(Pose.from_angles((1000, 2000, 800), (np.pi, 0, 0)), 12500, (800, 600))
    assert footprint(up, GROUND, SEARCH).bounds is None
    beside = footprint(vertical(), GROUND, (10000.0, 10000.0, 11000.0, 11000.0))
    assert beside.bounds is None


def test_the_usual_height_is_known_where_no_border_point_meets_the_surface() -> None:
    seen = footprint(vertical(), GROUND, SEARCH)
    assert seen.usual_height == 100.0
    assert replace(seen, outline=np.full((8, 3), np.nan), height_range=(80.0, 90.0)).usual_height == 85.0


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_tiles_that_hold_a_pixel_are_kept(tilt: float) -> None:
    camera = Pinhole(Pose.from_angles((1000, 2000, 800), (tilt, 0.1, 0.7)), 2000, (1600, 1200))
    seen = footprint(camera, GROUND, SEARCH)
    assert seen.bounds is not None
    grid = MapGrid.covering(seen.bounds, 2.0, "EPSG:32615")
    kept = covered_tiles(camera, GROUND, grid, 32)
    tiles = list(grid.window.tiles(32))
    for index, tile in enumerate(tiles):
        v, u = np.mgrid[tile.row : tile.stop[1], tile.col : tile.stop[0]]
        XY = grid.to_map(np.stack([u, v], axis=-1))
        xy = project(camera, np.concatenate([XY, np.full((*XY.shape[:2], 1), 100.0)], axis=-1))
        inside = ((xy >= -0.5) & (xy <= np.array(camera.size) - 0.5)).all(axis=-1).any()
        assert index in kept.indices or not inside
    assert [tile.window for tile in kept] == [tiles[index] for index in kept.indices]
    assert 0 < len(kept) < len(tiles)


@dataclass(eq=False)
class Grid:
    """Heights in memory that remember how much of them was read at once."""

    values: NDArray[np.float32]
    largest: int = 0
    asked: list[Window] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        return self.values.shape[1], self.values.shape[0]

    def read(self, window: Window) -> NDArray[np.float32]:
        self.largest = max(self.largest, window.size)
        self.asked.append(window)
        return self.values[window.row : window.stop[1], window.col : window.stop[0]]


def terrain(seed: int, side: int = 400, roughness: float = 250.0) -> tuple[Grid, RasterSurface]:
    """Hills and a steep mountain around the origin."""
    rng = np.random.default_rng(seed)
    k = np.arange(side)
    phase = rng.uniform(0, 6, 4)
    waves = np.sin(k / 17 + phase[0]) * np.cos(k[:, None] / 23 + phase[1]) + np.sin((k + k[:, None]) / 9 + phase[2])
    u, v = rng.uniform(0.3, 0.7, 2) * side
    mountain = 900 * np.exp(-((k - u) ** 2 + (k[:, None] - v) ** 2) / 60)
    grid = Grid((500 + roughness * waves + mountain).astype(np.float32))
    return grid, RasterSurface(grid, (-side / 2 * MESH, side / 2 * MESH), (MESH, MESH), part=(16, 16))


def edges(grid: Grid) -> tuple[float, float, float, float]:
    half = grid.size[0] / 2 * MESH
    return (-half - MESH / 2, -half + MESH / 2, half - MESH / 2, half + MESH / 2)


@pytest.mark.parametrize("seed", some(range(6), 0, 1, 2))
@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0, 80.0])
def test_all_ground_that_falls_into_the_image_is_inside(seed: int, tilt: float) -> None:
    """Also a mountain between the camera and what it looks at, and ground below the level of the camera's foot."""
    grid, surface = terrain(seed)
    rng = np.random.default_rng(seed + 100)
    center = (*rng.uniform(-1500, 1500, 2), 2200.0)
    camera = Pinhole(Pose.from_angles(center, np.radians((tilt, 5, 0))), 900.0, (800, 600))
    k = np.arange(0, 400, 2)
    XY = np.stack(np.meshgrid((k - 200) * MESH, (200 - k) * MESH), axis=-1)
    points = np.concatenate([XY, surface.heights(XY)[..., None]], axis=-1)
    xy = project(camera, points)
    inside = (xy >= -0.5).all(axis=-1) & (xy <= np.array(camera.size) - 0.5).all(axis=-1)
    assert inside.any()
    # 20 heights above the lowest ground: what is further is left out on purpose.
    near = (np.abs(XY - camera.center[:2]) < 20 * (2200 - 500)).all(axis=-1)
    seen = XY[inside & near]
    bounds = footprint(camera, surface, edges(grid)).bounds
    assert bounds is not None
    xmin, ymin, xmax, ymax = bounds
    assert (seen >= (xmin, ymin)).all()
    assert (seen <= (xmax, ymax)).all()


def test_a_vertical_image_is_bounded_tightly_and_reads_little() -> None:
    grid, surface = terrain(1, side=2000, roughness=20.0)
    camera = Pinhole(Pose.from_angles((300, -200, 1500), (0, 0, 0)), 900.0, (800, 600))
    bounds = footprint(camera, surface, edges(grid)).bounds
    assert bounds is not None
    xmin, ymin, xmax, ymax = bounds
    assert 800 < xmax - xmin < 1400
    assert 600 < ymax - ymin < 1000
    assert grid.largest < 60**2
    assert sum(w.size for w in grid.asked) < 50_000


def test_far_terrain_is_looked_through_in_pieces() -> None:
    """A horizontal view over 50 km of terrain holds a piece of 500 m in memory, and not all of it."""
    grid, surface = terrain(1, side=2000, roughness=20.0)
    camera = Pinhole(Pose.from_angles((300, -200, 1500), (np.pi / 2, 0, 0)), 900.0, (800, 600))
    bounds = footprint(camera, surface, edges(grid)).bounds
    assert bounds is not None
    xmin, _ymin, xmax, ymax = bounds
    assert xmax - xmin > 5000
    assert ymax > 15_000
    assert grid.largest < 30**2


def test_nothing_is_seen_from_below_far_away_and_beside() -> None:
    grid, surface = terrain(2)
    bounds = edges(grid)
    up = Pinhole(Pose.from_angles((0, 0, 2500), (np.pi, 0, 0)), 900.0, (800, 600))
    below = Pinhole(Pose.from_angles((0, 0, -3000), (0, 0, 0)), 900.0, (800, 600))
    away = Pinhole(Pose.from_angles((10 * FAR, 0, 2500), (0, 0, 0)), 900.0, (800, 600))
    beside = Pinhole(Pose.from_angles((bounds[2] + 4000, 0, 2500), (0, 0, 0)), 900.0, (800, 600))
    for camera in (up, below, away, beside):
        seen = footprint(camera, surface, bounds)
        assert seen.bounds is None and seen.on_surface == 0 and np.isnan(seen.outline).all()


def test_a_hole_below_the_camera() -> None:
    """Ground that begins beside the camera's foot is found."""
    grid, surface = terrain(3)
    grid.values[150:260, 150:260] = np.nan
    camera = Pinhole(Pose.from_angles((0, 0, 2500), np.radians((40, 0, 0))), 900.0, (800, 600))
    bounds = footprint(camera, surface, edges(grid)).bounds
    assert bounds is not None
    xmin, ymin, xmax, ymax = bounds
    assert ymax > 2000
    assert (xmax - xmin) * (ymax - ymin) > 1e6


def test_level_ground_everywhere() -> None:
    camera = Pinhole(Pose.from_angles((0, 0, 1000), (0, 0, 0)), 1000.0, (800, 600))
    bounds = footprint(camera, LevelSurface(0.0), None).bounds
    assert bounds is not None
    xmin, ymin, xmax, ymax = bounds
    assert -500 < xmin < -400 < 400 < xmax < 500
    assert -400 < ymin < -300 < 300 < ymax < 400


def oblique(seed: int, lens: Lens, curvature: str) -> CentralCamera:
    """A camera 2200 m above sea, anything from upright to half the horizon in the picture."""
    rng = np.random.default_rng(seed)
    center = (500_000 + rng.uniform(-1500, 1500), 5_300_000 + rng.uniform(-1500, 1500), 2200.0)
    pose = Pose.from_angles(center, np.radians((rng.uniform(0, 70), rng.uniform(-15, 15), rng.uniform(-180, 180))))
    interior = Interior.digital((800, 600), (float(rng.uniform(500, 1500)),) * 2, (3.0, -2.0))
    return oriented_camera(interior, lens, pose, crs="EPSG:32633", earth_curvature=curvature, mean_ground=500.0)


@pytest.mark.parametrize("seed", some(range(12), 2, 4, 8))
def test_every_pixel_that_falls_into_the_image_is_in_the_bounds_and_in_a_kept_tile(seed: int) -> None:
    """Random terrain with holes, oblique cameras with a lens, over a flat and over a round earth."""
    grid, local = terrain(seed + 20)
    grid.values[np.random.default_rng(seed).random(grid.values.shape) < 0.01] = np.nan
    surface = replace(local, origin=(local.origin[0] + 500_000, local.origin[1] + 5_300_000))
    camera = oblique(seed, BROWN if seed % 2 else NoLens(), "strict" if seed % 3 == 2 else "none")
    x, y = (500_000.0, 5_300_000.0)
    left, bottom, right, top = edges(grid)
    seen = footprint(camera, surface, (left + x, bottom + y, right + x, top + y))
    assert seen.bounds is not None
    target = MapGrid.covering((x - 4500, y - 4500, x + 4500, y + 4500), 20.0, "EPSG:32633")
    v, u = np.mgrid[: target.height, : target.width]
    XY = target.to_map(np.stack([u, v], axis=-1).astype(float))
    xy = project(camera, np.concatenate([XY, surface.heights(XY)[..., None]], axis=-1))
    inside = (xy >= -0.5).all(axis=-1) & (xy <= np.array(camera.size) - 0.5).all(axis=-1)
    assert inside.sum() > 500
    assert (XY[inside] >= seen.bounds[:2]).all() and (XY[inside] <= seen.bounds[2:]).all()
    kept = covered_tiles(camera, surface, target, 30)
    near = covered_tiles(camera, surface, target, 30, seen.bounds)
    for index, tile in enumerate(target.window.tiles(30)):
        shown = inside[tile.row : tile.stop[1], tile.col : tile.stop[0]].any()
        assert not shown or (index in kept.indices and index in near.indices)
    assert len(kept) < kept.total and np.isin(near.indices, kept.indices).all()


@thinned("images", 30, 100)
def test_a_hundred_ordinary_images_read_the_ground_below_them_once(images: int) -> None:
    """Tilts of 3° over mountains with hills on them: no search runs away, whatever the ground beside the image does."""
    side, mesh = 2000, 20.0
    X, Y = np.meshgrid(LEFT + np.arange(side) * mesh, TOP - np.arange(side) * mesh)
    grid = Grid(relief(X, Y).astype(np.float32))
    surface = RasterSurface(grid, (LEFT, TOP), (mesh, mesh), part=(64, 64))
    bounds = (LEFT, TOP - side * mesh, LEFT + side * mesh, TOP)
    rng = np.random.default_rng(7)
    for _ in range(images):
        center = (LEFT + rng.uniform(2000, 38_000), TOP - rng.uniform(2000, 38_000), 3200.0)
        camera = Pinhole(
            Pose.from_angles(center, np.radians((*rng.uniform(-3, 3, 2), rng.uniform(0, 360)))), 1000, (1058, 680)
        )
        grid.asked.clear()
        found = footprint(camera, surface, bounds).bounds
        assert found is not None
        # 2.6 × 1.7 km on the mean level, in any direction, and what 600 m of relief add.
        assert found[2] - found[0] < 4800 and found[3] - found[1] < 4800
        # Parts of 1280 m: 5 × 5 below the box of the levels, and windows for the rays.
        parts = [w for w in grid.asked if (w.width, w.height) == (64, 64)]
        assert len(parts) <= 36
        assert sum(w.size for w in grid.asked) < 400_000

"""Footprints: what an image sees of the ground."""

from __future__ import annotations

import numpy as np
import pytest
from tools.pinhole import Pinhole, vertical

from photoplan.cameras.base import project
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.pose import Pose
from photoplan.plan.coverage import cover, covered_tiles, image_border
from photoplan.surfaces.level import LevelSurface

GROUND = LevelSurface(100.0)
SEARCH = (0.0, 0.0, 4000.0, 4000.0)


def test_outline_projects_back_onto_the_border() -> None:
    camera = vertical()
    coverage = cover(camera, GROUND, SEARCH)
    back = project(camera, coverage.outline)
    np.testing.assert_allclose(back, image_border(camera.size), atol=0.01)
    assert coverage.on_surface == 1.0


def test_bounds_hold_the_footprint_and_little_more() -> None:
    coverage = cover(vertical(), GROUND, SEARCH)
    assert coverage.bounds is not None
    low, high = coverage.outline[:, :2].min(axis=0), coverage.outline[:, :2].max(axis=0)
    xmin, ymin, xmax, ymax = coverage.bounds
    assert xmin <= low[0] and ymin <= low[1] and xmax >= high[0] and ymax >= high[1]
    assert (xmax - xmin) * (ymax - ymin) < 1.05 * np.prod(high - low)


def test_a_footprint_smaller_than_the_first_lattice_is_found() -> None:
    coverage = cover(vertical(size=(80, 60)), GROUND, (-4e4, -4e4, 4e4, 4e4))
    assert coverage.bounds is not None
    assert coverage.bounds[2] - coverage.bounds[0] < 12


def test_nothing_is_seen_upwards_or_beside_the_terrain() -> None:
    up = Pinhole(Pose.from_angles((1000, 2000, 800), (np.pi, 0, 0)), 12500, (800, 600))
    assert cover(up, GROUND, SEARCH).bounds is None
    beside = cover(vertical(), GROUND, (10000.0, 10000.0, 11000.0, 11000.0))
    assert beside.bounds is None


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_tiles_that_hold_a_pixel_are_kept(tilt: float) -> None:
    camera = Pinhole(Pose.from_angles((1000, 2000, 800), (tilt, 0.1, 0.7)), 2000, (1600, 1200))
    coverage = cover(camera, GROUND, SEARCH)
    assert coverage.bounds is not None
    grid = MapGrid.covering(coverage.bounds, 2.0, "EPSG:32615")
    tiles = list(grid.window.tiles(32))
    kept = covered_tiles(camera, GROUND, grid, tiles)
    for tile, keep in zip(tiles, kept):
        v, u = np.mgrid[tile.row : tile.stop[1], tile.col : tile.stop[0]]
        XY = grid.to_map(np.stack([u, v], axis=-1))
        xy = project(camera, np.concatenate([XY, np.full((*XY.shape[:2], 1), 100.0)], axis=-1))
        inside = ((xy >= -0.5) & (xy <= np.array(camera.size) - 0.5)).all(axis=-1).any()
        assert keep or not inside
    assert not all(kept)

"""Footprints, tiles, visibility and anchors of images whose rays meet nowhere."""

from __future__ import annotations

import numpy as np
import pytest
from tools.rpc_images import CRS, camera

from photoplan.cameras.base import project
from photoplan.geometry.grid import MapGrid
from photoplan.plan.footprint import covered_tiles, footprint, mean_gsd
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.shifted import intersect


def test_what_an_image_with_polynomials_sees_of_a_level() -> None:
    seen = camera()
    found = footprint(seen, LevelSurface(250.0), None)
    assert found.on_surface == 1.0
    assert found.bounds is not None
    inside = np.random.default_rng(1).uniform(0, 1, (500, 2)) * (seen.size[0] - 1, seen.size[1] - 1)
    ground = seen.rays(inside, 250.0)[0]
    low, high = np.array(found.bounds[:2]), np.array(found.bounds[2:])
    assert (ground[:, :2] > low).all()
    assert (ground[:, :2] < high).all()
    edge = seen.rays(np.array([(x, y) for x in (-0.5, 2999.5) for y in (-0.5, 4399.5)]), 250.0)[0][:, :2]
    assert np.abs(edge.min(axis=0) - low).max() < 200
    assert np.abs(edge.max(axis=0) - high).max() < 200
    assert mean_gsd(seen, found) == pytest.approx(5.0, rel=0.05)
    hits = intersect(seen, inside, LevelSurface(250.0), (250.0, 250.0))
    assert np.abs(hits - ground).max() < 1e-3
    assert np.abs(project(seen, hits) - inside).max() < 1e-3


def test_tiles_that_an_image_with_polynomials_needs() -> None:
    seen = camera()
    terrain = LevelSurface(250.0)
    found = footprint(seen, terrain, None)
    xmin, ymin, xmax, ymax = found.bounds or (0, 0, 0, 0)
    grid = MapGrid.covering((xmin - 4000, ymin - 4000, xmax + 4000, ymax + 4000), 5.0, CRS)
    tiles = covered_tiles(seen, terrain, grid, 512)
    ground = seen.rays(np.random.default_rng(1).uniform(0, 1, (2000, 2)) * seen.size - 0.5, 250.0)[0]
    needed = set(map(tuple, (grid.to_pixel(ground[:, :2]) // 512).astype(int).tolist()))
    listed = {(tile.window.col // 512, tile.window.row // 512) for tile in tiles}
    assert needed <= listed
    assert len(listed) < 1.25 * len(needed)


@pytest.mark.parametrize("height", [-3000.0, 5000.0])
def test_ground_where_the_polynomials_do_not_hold_is_not_seen(height: float) -> None:
    found = footprint(camera(), LevelSurface(height), None)
    assert found.bounds is None
    assert found.on_surface == 0.0

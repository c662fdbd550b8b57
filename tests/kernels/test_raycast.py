"""Rays onto terrain: against a slow twin that walks along them, and where terrain has holes, walls and borders."""

from __future__ import annotations

import numpy as np
import pytest
from tools.function_surface import raster_surface
from tools.hybrid_models import line, model

from photoplan.errors import UsageError
from photoplan.geometry.crs import crs_step
from photoplan.kernels.jit import COMPILED
from photoplan.kernels.rays import MISS, SURFACE, WALL, pyramid_of
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.shifted import ShiftedSurface
from photoplan.surfaces.units import UnitLayout

RAYS = 200 if COMPILED else 12
SIDE = 60.0


def rough(seed: int, holes: float = 0.02, mesh: float = 1.0) -> RasterSurface:
    rng = np.random.default_rng(seed)
    heights = rng.normal(0, 1.5, (int(SIDE), int(SIDE))).astype(np.float32) + 10
    heights[rng.random(heights.shape) < holes] = np.nan
    return raster_surface(heights, 0.0, SIDE - 1, mesh)


def random_rays(seed: int, count: int = RAYS) -> np.ndarray:
    """Down, level and up; some start below ground, outside or far above, some are upright or run along grid lines."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform((-10, -10, 4), (SIDE + 10, SIDE + 10, 16), (count, 2, 3))
    ends[::7, 1, :2] = ends[::7, 0, :2]
    ends[1::7, :, 0] = np.round(ends[1::7, :1, 0])
    ends[2::7, :, 1] = np.round(ends[2::7, :1, 1])
    ends[3::7, 0, 2] += 1000
    ends[4::7, :, 2] = ends[4::7, :1, 2]
    return ends


def twin(surface, path, steps: int, bend: float = 0.0) -> float:
    """Part of the path at which the ray comes down from above ground, looked for in many places; NaN: nowhere."""
    t = np.linspace(0, 1, steps)
    at = path[0] + t[:, None] * (path[1] - path[0])
    at[:, 2] += bend * (np.hypot(*(path[1] - path[0])[:2]) * t) ** 2
    above = at[:, 2] - surface.heights(at[:, :2])
    down = np.flatnonzero((above[:-1] >= 0) & (above[1:] < 0))
    return float(t[down[0]]) if len(down) else np.nan


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("bend", [0.0, 2e-3])
def test_rays_in_any_direction_hit_where_the_twin_finds_it(seed: int, bend: float) -> None:
    surface, paths = rough(seed), random_rays(seed)
    hits = surface.first_hit(paths, bend)
    steps = 20_001 if COMPILED else 5_001
    step = np.linalg.norm(np.diff(paths, axis=1)[:, 0], axis=1) / (steps - 1)
    met = np.isfinite(hits.along)
    assert 0.2 < met.mean() < 0.9
    length = np.linalg.norm(np.diff(paths, axis=1)[:, 0], axis=1)
    for i, path in enumerate(paths):
        found = twin(surface, path, steps, bend)
        if np.isnan(found):
            # A summit that is grazed between two places of the twin.
            assert not met[i] or twin(surface, path, 400_001, bend) == pytest.approx(hits.along[i], abs=1e-4)
        else:
            assert met[i], i
            assert hits.along[i] * length[i] <= found * length[i] + step[i] * 1.01
    # What was hit is on the surface and on the ray.
    np.testing.assert_allclose(surface.heights(hits.XYZ[met, :2]), hits.XYZ[met, 2], atol=2e-5)
    assert (hits.result[met] == SURFACE).all() and (hits.result[~met] == MISS).all()


def test_before_the_hit_the_ray_is_above_ground_or_has_come_from_below() -> None:
    surface, paths = rough(5, holes=0.0), random_rays(6)
    hits = surface.first_hit(paths)
    for path, along in zip(paths, hits.along):
        part = np.linspace(0, 1 if np.isnan(along) else along, 2000)[:, None]
        at = path[0] + part * (path[1] - path[0])
        above = at[:, 2] - surface.heights(at[:, :2])
        above = above[np.isfinite(above)]
        down = (above[:-1] > 1e-6) & (above[1:] < -1e-6)
        assert not down.any()


def test_a_part_of_a_path_and_parts_of_other_sizes_give_the_same() -> None:
    surface, paths = rough(7), random_rays(8)
    whole = surface.first_hit(paths)
    middle = paths[:, :1] + np.array([0.2, 0.37, 0.9])[:, None] * (paths[:, 1:] - paths[:, :1])
    broken = surface.first_hit(np.concatenate([paths[:, :1], middle, paths[:, 1:]], axis=1))
    np.testing.assert_allclose(broken.XYZ, whole.XYZ, atol=1e-7)
    small = RasterSurface(surface.grid, surface.origin, surface.mesh, part=(16, 16)).first_hit(paths)
    np.testing.assert_allclose(small.XYZ, whole.XYZ, atol=1e-9)
    np.testing.assert_array_equal(small.below, whole.below)


def test_a_bilinear_mesh_is_met_exactly() -> None:
    """Over one twisted mesh h = x y / 10 the ray z = 5 − s over x = y = s meets 5 − s = s² / 10."""
    x = np.arange(11.0)
    surface = raster_surface(np.outer(x[::-1], x)[[0, -1]][:, [0, -1]] / 10, 0.0, 10.0, 10.0)
    hit = surface.first_hit([[(0, 0, 5), (10, 10, -5)]])
    s = -5 + np.sqrt(75)
    np.testing.assert_allclose(hit.XYZ[0], [s, s, 5 - s], atol=1e-12)


def test_holes_let_rays_through_and_below_ground_nothing_is_hit_from_below() -> None:
    heights = np.zeros((21, 41), np.float32)
    heights[:, 10:15] = np.nan
    surface = raster_surface(heights, 0.0, 20.0, 1.0)
    paths = np.array(
        [
            [(2.0, 10, 5), (20, 10, -5)],  # down through the hole
            [(2.0, 10, 5), (4, 10, -5)],  # beside it
            [(12.0, 10, 5), (12, 10, -5)],  # upright, into the hole
            [(2.0, 10, -3), (30, 10, -3)],  # level, below ground
            [(20.0, 10, -3), (20, 10, 5)],  # up from below
            [(-5.0, 10, -1), (60, 10, -1)],  # from outside, below ground all the way
            [(20.0, 10, 0), (25, 10, -1)],  # starts on the ground and goes down
            [(20.0, 10, 0), (25, 10, 1)],  # starts on the ground and goes up
            [(np.nan, 10, 5), (4, 10, -5)],
        ]
    )
    hits = surface.first_hit(paths)
    np.testing.assert_array_equal(np.isfinite(hits.along), [0, 1, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(hits.below[[0, 3, 4, 5]], [True, True, False, False])
    np.testing.assert_allclose(hits.XYZ[1], [3, 10, 0], atol=1e-12)
    assert hits.along[6] == 0
    # Along the posts at the border of the hole there is ground.
    on_border = surface.first_hit([[(9.0, 2, 1), (9, 18, -1)]])
    np.testing.assert_allclose(on_border.XYZ, [(9, 10, 0)], atol=1e-12)


@pytest.mark.parametrize("border", [20.0, 20.3, 22.5])
def test_walls_are_hit_on_their_face_wherever_they_stand(border: float) -> None:
    """Inside a mesh, on a grid line and on the border of two units; from the high side the ray falls past it."""
    layout = UnitLayout(0.0, 40.0, 20.0, 2, 2)
    wall = line([(-1, border, 254.0), (41, border, 254.0)], [250.0, 250.0])
    surface, _ = model(layout, 8, [wall], lambda X, Y: np.where(border < Y, 254.0, 250.0))
    paths = np.array(
        [
            [(10.0, 5, 253), (10, 35, 251)],  # from the low side
            [(10.0, 5, 240), (10, 35, 252)],  # from below ground, up, but never above it
            [(10.0, 5, 245), (10, 35, 275)],  # from below ground, comes out before the wall
            [(10.0, 35, 256), (10, 5, 245)],  # from the high side, onto the low ground
            [(11.0, 35, 253), (11, 5, 249)],  # starts inside the high ground, comes out of the wall
            [(11.0, 5, 253), (11, 35, 256)],  # rises over the wall
        ]
    )
    hits = surface.first_hit(paths)
    wall_first = 245 + (border - 5) < 254
    np.testing.assert_array_equal(hits.result, [WALL, MISS, WALL if wall_first else MISS, SURFACE, SURFACE, MISS])
    np.testing.assert_allclose(hits.XYZ[0], [10, border, 253 - (border - 5) / 15], atol=1e-6)
    np.testing.assert_allclose(hits.XYZ[3:5, 2], [254, 250], atol=1e-6)
    np.testing.assert_array_equal(hits.below, [False, True, False, False, False, False])
    # A ray along the wall sees the ground left of the line, which runs east: the northern, high side; on a border of
    # meshes the southern one.
    along = surface.first_hit([[(2.0, border, 252), (38, border, 252)], [(2.0, border, 256), (38, border, 253)]])
    assert np.isnan(along.along[0])
    if border == 20.3:
        np.testing.assert_allclose(along.XYZ[1], [26, border, 254], atol=1e-6)
    else:
        assert np.isnan(along.along[1])


def test_the_whole_ridge_of_triangles_is_seen_by_rays_from_many_sides() -> None:
    layout = UnitLayout(0.0, 40.0, 20.0, 2, 2)
    ridge = [line([(2, y, z), (38, y + 3, z)]) for y, z in ((18.0, 250.0), (18.4, 256.0), (18.8, 250.0))]
    surface, _ = model(layout, 4, ridge, lambda X, Y: 250 + 0.02 * X)
    rng = np.random.default_rng(3)
    count = 60 if COMPILED else 6
    starts = np.column_stack([rng.uniform(1, 39, (count, 2)), np.full(count, 262.0)])
    paths = np.stack([starts, np.column_stack([rng.uniform(1, 39, (count, 2)), np.full(count, 249.0)])], axis=1)
    hits = surface.first_hit(paths)
    assert np.isfinite(hits.along).all()
    np.testing.assert_allclose(surface.heights(hits.XYZ[:, :2]), hits.XYZ[:, 2], atol=1e-6)
    for path, along in zip(paths, hits.along):
        assert twin(surface, path, 4001) >= along - 1 / 4000 - 1e-9


def test_levels_shifts_and_other_reference_systems() -> None:
    paths = np.array([[(500_010.0, 5_300_000, 130), (500_310, 5_300_050, 70)]])
    level = LevelSurface(100.0).first_hit(paths)
    np.testing.assert_allclose(level.XYZ, [(500_160, 5_300_025, 100)], atol=1e-9)
    assert np.isnan(LevelSurface(100.0).first_hit(paths[:, ::-1]).along).all()

    def tilted(XY: np.ndarray) -> np.ndarray:
        return 0.01 * (XY[..., 0] - 500_000)

    shifted = ShiftedSurface(LevelSurface(100.0), tilted).first_hit(paths)
    # 130 − 0.2 s = 100 + 0.01 (10 + s).
    s = 29.9 / 0.21
    np.testing.assert_allclose(shifted.XYZ[0, [0, 2]], [500_010 + s, 130 - 0.2 * s], atol=1e-6)
    assert shifted.along[0] == pytest.approx(s / 300, abs=1e-9)
    carry = crs_step("EPSG:32632", "EPSG:32633")
    assert carry is not None
    heights = np.random.default_rng(1).normal(100, 2, (80, 80)).astype(np.float32)
    at = np.asarray(carry(paths[0, :, :2]))
    own = raster_surface(heights, at[:, 0].min() - 100, at[:, 1].max() + 200, 10.0)
    other = RasterSurface(own.grid, own.origin, own.mesh, carry)
    hits = other.first_hit(paths)
    np.testing.assert_allclose(other.heights(hits.XYZ[:, :2]), hits.XYZ[:, 2], atol=2e-3)
    np.testing.assert_allclose(np.cross(hits.XYZ[0] - paths[0, 0], paths[0, 1] - paths[0, 0]) / 310, 0, atol=2e-3)


def test_a_level_ray_over_a_round_earth_rises_by_the_square_of_its_way() -> None:
    """At distance s ground of height h = s² / 2R is met again by a level line of sight from height 0."""
    bend = 1 / (2 * 6_380_000.0)
    heights = np.zeros((3, 1200), np.float32)
    heights[:, 1000:] = 5.0
    surface = raster_surface(heights, 0.0, 20.0, 10.0)
    for height, seen in ((bend * 9995**2 - 0.01, 0), (5 - bend * 9995**2 - 0.01, 1)):
        hit = surface.first_hit([[(5.0, 10, height), (11_900, 10, height)]], bend)
        assert np.isfinite(hit.along[0]) == (seen or height < 5 - bend * 9990**2)


def test_bounds_of_the_pyramid() -> None:
    rng = np.random.default_rng(2)
    heights = rng.normal(0, 1, (12, 18)).astype(np.float32)
    heights[3:6, 7:10] = np.nan
    low, high, levels = pyramid_of(heights)
    for level, (start, rows, columns) in enumerate(levels):
        for j in range(rows):
            for i in range(columns):
                block = heights[j << level : ((j + 1) << level) + 1, i << level : ((i + 1) << level) + 1]
                there = block[np.isfinite(block)]
                bounds = (there.min(), there.max()) if there.size else (np.inf, -np.inf)
                assert (low[start + j * columns + i], high[start + j * columns + i]) == bounds


def test_paths_of_another_shape_are_refused() -> None:
    with pytest.raises(UsageError, match="paths of shape"):
        rough(1).first_hit(np.zeros((4, 3)))


def test_normals_are_those_of_the_mesh_the_triangle_and_the_wall() -> None:
    surface, paths = rough(4, holes=0.0, mesh=1.0), random_rays(4)
    hits = surface.first_hit(paths)
    met = np.isfinite(hits.along) & (np.abs(hits.XYZ[:, :2] - np.round(hits.XYZ[:, :2])) > 1e-3).all(axis=1)
    XY, h = hits.XYZ[met, :2], 2e-4
    slope = [(surface.heights(XY + d) - surface.heights(XY - d)) / (2 * h) for d in np.eye(2) * h]
    np.testing.assert_allclose(hits.normal[met, :2] / -hits.normal[met, 2:], np.stack(slope, axis=-1), atol=1e-2)
    np.testing.assert_allclose(np.linalg.norm(hits.normal[met], axis=1), 1)
    assert (hits.owner == np.where(np.isfinite(hits.along), 0, -1)).all()
    layout = UnitLayout(0.0, 40.0, 20.0, 2, 2)
    wall = line([(-1, 20.3, 254.0), (41, 26.3, 254.0)], [250.0, 250.0])
    tilted, _ = model(layout, 8, [wall], lambda X, Y: np.where(Y > 20.3 + (X + 1) / 7, 254.0, 250.0 + 0.1 * X))
    hit = tilted.first_hit([[(10.0, 5, 253.5), (12, 35, 252.5)], [(10.0, 5, 260), (10, 6, 240)]])
    np.testing.assert_array_equal(hit.result, [WALL, SURFACE])
    np.testing.assert_allclose(hit.normal[0], np.array([6, -42, 0]) / np.hypot(6, 42), atol=1e-5)
    np.testing.assert_allclose(hit.normal[1, :2] / hit.normal[1, 2], [-0.1, 0], atol=1e-4)
    other = RasterSurface(surface.grid, surface.origin, surface.mesh, lambda XY: XY[..., ::-1] * [1, 2])
    turned = other.first_hit(np.stack([paths[met][..., 1] / 2, paths[met][..., 0], paths[met][..., 2]], axis=-1))
    n = hits.normal[met][:, [1, 0, 2]] * [2, 1, 1]
    same = np.isfinite(turned.along)
    np.testing.assert_allclose(turned.normal[same], (n / np.linalg.norm(n, axis=1, keepdims=True))[same], atol=2e-3)

"""Hybrid terrain as a surface: one answer from single points and from whole windows, no pinholes, walls, holes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.hybrid_models import line, model, plain_unit, random_lines, rough

from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.units import MemoryUnits, UnitLayout, unit_range
from photoplan.targets.map import MapTarget

CRS = "EPSG:32633"
LAYOUT = UnitLayout(500_000.0, 5_300_000.0, 8.0, 3, 2)


def tilted(X, Y):
    return 250 + 0.25 * (X - 500_000) - 0.5 * (Y - 5_300_000)


def points(target: MapTarget, window: Window) -> np.ndarray:
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    return target.grid.to_map(np.stack([u, v], axis=-1))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    resolution=st.sampled_from([0.1, 0.5, 1.0, 2.0, 0.37]),
    shift=st.sampled_from([0.0, 0.5, 0.123]),
)
def test_relief_is_the_heights_at_pixel_centres(seed: int, resolution: float, shift: float) -> None:
    rng = np.random.default_rng(seed)
    surface, _ = model(LAYOUT, rng.choice([1, 2, 4, 8], (2, 3)), random_lines(rng, LAYOUT, 5, seed % 2 == 1))
    # With a shift of half a pixel, pixel centres fall onto posts and mesh edges.
    target = MapTarget(
        MapGrid(500_000 - 3 + shift * resolution, 5_300_000 + 2 - shift * resolution, resolution, 60, 50, CRS)
    )
    window = Window(2, 1, 57, 48)
    XY = points(target, window)
    relief, sigma = surface.relief_with_sigma(target, window)
    np.testing.assert_allclose(relief, surface.heights(XY), atol=1e-4)
    np.testing.assert_allclose(sigma, surface.sigmas(XY), atol=1e-6)
    np.testing.assert_array_equal(relief, surface.relief(target, window))
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    inside = (XY[..., 0] >= xmin) & (XY[..., 0] <= xmax) & (XY[..., 1] >= ymin) & (XY[..., 1] <= ymax)
    np.testing.assert_array_equal(np.isfinite(relief), inside)


@pytest.mark.parametrize("resolution", [0.07, 0.25, 1.0, 3.0])
def test_a_plane_stays_a_plane_with_lines_and_without(resolution: float) -> None:
    rng = np.random.default_rng(3)
    lines = [
        dataclasses.replace(each, xyz=np.column_stack([each.xyz[:, :2], tilted(*each.xyz.T[:2])]))
        for each in random_lines(rng, LAYOUT, 7, walls=False)
    ]
    surface, _ = model(LAYOUT, [[4, 2, 8], [8, 16, 2]], lines, tilted)
    target = MapTarget(MapGrid(500_000, 5_300_000, resolution, int(24 / resolution), int(16 / resolution), CRS))
    XY = points(target, target.window)
    np.testing.assert_allclose(surface.relief(target, target.window), tilted(XY[..., 0], XY[..., 1]), atol=5e-5)
    XY = rng.uniform([500_000, 5_300_000 - 16], [500_024, 5_300_000], (2000, 2))
    np.testing.assert_allclose(surface.heights(XY), tilted(*XY.T), atol=2e-6)
    expected = np.full(2000, 0.2)
    assert (surface.sigmas(XY) <= expected + 1e-6).all() and (surface.sigmas(XY) >= 0.05 - 1e-6).all()


def test_a_missing_post_takes_its_meshes_but_not_their_other_edges() -> None:
    unit = plain_unit(LAYOUT, 0, 0, 8, tilted)
    unit.heights[3, 4] = np.nan
    surface = HybridSurface(MemoryUnits(LAYOUT, {(0, 0): unit}))
    X, Y = 500_004.0, 5_300_000.0 - 3
    lost = [(X, Y), (X + 0.5, Y + 0.5), (X - 0.9, Y - 0.9), (X + 0.5, Y)]
    kept = [(X + 1, Y), (X + 1, Y + 0.5), (X - 0.5, Y + 1), (X - 1.1, Y)]
    assert np.isnan(surface.heights(lost)).all()
    np.testing.assert_allclose(surface.heights(kept), tilted(*np.array(kept).T), atol=1e-5)
    target = MapTarget(MapGrid(X - 0.5, Y + 0.5, 1.0, 2, 2, CRS))  # four posts, the first one missing
    assert np.isnan(surface.relief(target, target.window)).sum() == 1


def test_there_is_no_surface_beyond_the_outer_posts() -> None:
    surface, _ = model(LAYOUT, 4, [], tilted)
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    corners = np.array([(xmin, ymin), (xmin, ymax), (xmax, ymin), (xmax, ymax)])
    middle = np.array([(xmin + xmax) / 2, (ymin + ymax) / 2])
    np.testing.assert_allclose(surface.heights(corners), tilted(*corners.T), atol=1e-5)
    assert np.isnan(surface.heights(corners + np.sign(corners - middle) * 1e-4)).all()
    assert np.isnan(surface.heights([(np.nan, ymin), (np.inf, ymax)])).all()


def test_a_border_of_units_belongs_to_the_unit_that_has_a_surface() -> None:
    unit = plain_unit(LAYOUT, 1, 0, 4, tilted)
    surface = HybridSurface(MemoryUnits(LAYOUT, {(1, 0): unit}))
    edges = np.array([(500_008.0, 5_299_995.0), (500_016, 5_299_997), (500_012, 5_299_992), (500_016, 5_299_992)])
    np.testing.assert_allclose(surface.heights(edges), tilted(*edges.T), atol=1e-5)
    target = MapTarget(MapGrid(500_007.5, 5_300_000.5, 1.0, 9, 9, CRS))
    assert np.isfinite(surface.relief(target, target.window)).all()


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("at", [500_003.0, 500_003.25, 500_008.5])
def test_exactly_on_a_wall_the_left_height_counts(reverse: bool, at: float) -> None:
    Y = np.array([5_300_000 + 1, 5_300_000 - 17.0])
    xyz = np.column_stack([[at, at], Y, [253.0, 253.0]])
    wall = line(xyz[::-1] if reverse else xyz, [250.0, 250.0])
    surface, _ = model(LAYOUT, 8, [wall], lambda X, Y: np.where((at < X) != reverse, 253.0, 250.0))
    target = MapTarget(MapGrid(at - 1.5 * 0.5, 5_299_999, 0.5, 3, 24, CRS))
    relief = surface.relief(target, target.window)
    on, left, right = relief[:, 1], relief[:, 2 - 2 * reverse], relief[:, 2 * reverse]
    assert (on == 253).all() and (left == 253).all() and (right == 250).all()
    XY = points(target, target.window)
    np.testing.assert_array_equal(surface.heights(XY), relief)
    # A tenth of a millimetre beside the wall each side has its own height.
    beside = XY[:, 1] + np.array([1e-4 if not reverse else -1e-4, 0])
    assert (surface.heights(beside) == 253).all()
    assert (surface.heights(2 * XY[:, 1] - beside) == 250).all()


def test_height_range_is_never_narrower_than_the_surface() -> None:
    rng = np.random.default_rng(5)
    surface, _ = model(LAYOUT, 4, random_lines(rng, LAYOUT, 5, walls=True))
    for _ in range(20):
        low, high = np.sort(rng.uniform([500_000, 5_299_984], [500_024, 5_300_000], (2, 2)), axis=0)
        XY = rng.uniform(low, high, (300, 2))
        lowest, highest = surface.height_range((low[0], low[1], high[0], high[1]))
        heights = surface.heights(XY)
        assert lowest <= heights.min() and highest >= heights.max()
    assert np.isnan(surface.height_range((0, 0, 1, 1))).all()


def test_a_model_in_another_crs_lies_where_the_transformation_puts_it() -> None:
    carry = crs_step(CRS, "EPSG:32632")
    assert carry is not None
    at = carry(np.array([500_100.0, 5_300_100.0]))
    layout = UnitLayout(float(at[0]) - 60, float(at[1]) + 60, 40.0, 3, 3)
    wall = line([(at[0] - 50, at[1] + 1, 252.0), (at[0] + 50, at[1] - 3, 252.0)], [249.0, 249.0])
    inner, _ = model(layout, 8, [wall], rough)
    surface = dataclasses.replace(inner, to_model_crs=carry)
    target = MapTarget(MapGrid(500_070, 5_300_130, 0.7, 90, 80, CRS))
    XY = points(target, target.window)
    relief = surface.relief(target, target.window)
    strict = inner.heights(carry(XY))
    np.testing.assert_array_equal(np.isnan(relief), np.isnan(strict))
    # Positions are interpolated to micrometres, which only a pixel at the wall itself can notice.
    assert (np.abs(relief - strict) > 1e-3).sum() <= 2
    np.testing.assert_array_equal(surface.heights(XY), strict)
    low, high = surface.height_range((500_090, 5_300_090, 500_110, 5_300_110))
    assert low <= strict[40:50, 40:50].min() and high >= strict[40:50, 40:50].max()


def test_only_map_targets_have_relief() -> None:
    surface, _ = model(LAYOUT, 2, [])
    with pytest.raises(UsageError, match="map targets, not for str"):
        surface.relief("target", Window(0, 0, 1, 1))  # type: ignore[arg-type]


def test_units_in_memory_know_their_ranges() -> None:
    wall = line([(500_001, 5_299_998.5, 270.0), (500_005, 5_299_997, 270.0)], [240.0, 240.0])
    surface, _ = model(LAYOUT, 4, [wall], tilted)
    # The wall is the highest and lowest of its unit; its ends have the mean of both sides.
    np.testing.assert_array_equal(surface.source.ranges[0, 0], [240, 270])
    assert np.isnan(unit_range(plain_unit(LAYOUT, 0, 0, 4, lambda X, Y: X * np.nan))).all()
    with pytest.raises(InputError, match="column 3, row 0"):
        MemoryUnits(LAYOUT, {(3, 0): plain_unit(LAYOUT, 0, 0, 4, tilted)})

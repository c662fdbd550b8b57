"""Refined meshes: the fine model inside, the coarse one outside, and nothing but a smooth step between."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from tools.hybrid_models import line, model

from photoplan.errors import InputError
from photoplan.geometry.grid import MapGrid
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.refined_units import LinedUnits, RefinedSurface, clip_line, refine_units
from photoplan.surfaces.units import MemoryUnits, UnitLayout
from photoplan.targets.map import MapTarget

COARSE = UnitLayout(0.0, 100.0, 20.0, 5, 5)
FINE = UnitLayout(20.0, 90.0, 60.0, 1, 1)
AREA = shapely.Polygon([(31, 35), (72, 33), (68, 71), (34, 66)])


def hills(X, Y):
    return 250 + 3 * np.sin(X / 9) * np.cos(Y / 11)


def raised(X, Y):
    return hills(X, Y) + 0.8


def across(count: int = 4001) -> tuple[np.ndarray, np.ndarray]:
    """Points along a line through the area, and their distance inside its border (negative outside)."""
    XY = np.column_stack([np.linspace(20, 80, count), np.linspace(49, 53, count)])
    points = shapely.points(XY)
    inside = shapely.distance(AREA.boundary, points)
    return XY, np.where(shapely.contains(AREA, points), inside, -inside)


def test_a_raised_model_rises_once_and_smoothly() -> None:
    coarse, _ = model(COARSE, 4, [], hills)
    fine = dataclasses.replace(coarse, source=_raise(coarse.source, 0.8))
    surface = RefinedSurface(coarse, fine, AREA, 6.0)
    XY, inside = across()
    rise = surface.heights(XY) - coarse.heights(XY)
    t = np.clip(inside / 6, 0, 1)
    np.testing.assert_allclose(rise, 0.8 * t * t * (3 - 2 * t), atol=1e-5)
    middle = len(rise) // 2
    assert (np.diff(rise[:middle]) >= -1e-5).all() and (np.diff(rise[middle:]) <= 1e-5).all()
    # 1.5 times the mean slope is the steepest that a smooth step has.
    assert np.abs(np.diff(rise)).max() <= 1.5 * 0.8 / 6 * np.hypot(60, 4) / 4000 * 1.02


def _raise(source: MemoryUnits, height: float) -> MemoryUnits:
    return MemoryUnits(
        source.layout, {at: dataclasses.replace(u, datum=u.datum + height) for at, u in source.units.items()}
    )


def test_a_fine_model_of_the_same_terrain_makes_no_waves() -> None:
    coarse, _ = model(COARSE, 4, [], hills)
    fine, _ = model(FINE, 60, [], hills)
    surface = RefinedSurface(coarse, fine, AREA, 5.0)
    XY, inside = across()
    truth = hills(*XY.T)
    error, before, after = (np.abs(s.heights(XY) - truth) for s in (surface, coarse, fine))
    assert (error <= np.maximum(before, after) + 1e-6).all()
    assert error[inside > 5].max() < 0.1 * before[inside > 5].max()
    low, high = np.minimum(coarse.heights(XY), fine.heights(XY)), np.maximum(coarse.heights(XY), fine.heights(XY))
    there = inside > 0
    assert ((surface.heights(XY) >= low - 1e-9) & (surface.heights(XY) <= high + 1e-9))[there].all()
    np.testing.assert_array_equal(surface.heights(XY)[~there], coarse.heights(XY)[~there])


def test_relief_heights_and_range_agree() -> None:
    coarse, _ = model(COARSE, 4, [], hills)
    fine, _ = model(FINE, 30, [line([(30, 50, 256.0), (70, 52, 256.0)])], raised)
    surface = RefinedSurface(coarse, fine, AREA, 4.0)
    for left, top in ((0.0, 100.0), (40, 60), (25, 70), (80, 20)):
        target = MapTarget(MapGrid(left, top, 0.5, 40, 36, "EPSG:32633"))
        v, u = np.mgrid[:36, :40].astype(float)
        XY = target.grid.to_map(np.stack([u, v], axis=-1))
        relief = surface.relief(target, target.window)
        np.testing.assert_allclose(relief, surface.heights(XY), atol=1e-4)
        low, high = surface.height_range(target.grid.bounds)
        assert low <= relief.min() and high >= relief.max()


def test_where_one_surface_is_missing_the_other_counts() -> None:
    half = model(COARSE, 4, [], lambda X, Y: np.where(X <= 50, 250.0, np.nan))[0]
    level = LevelSurface(260.0)
    at = [(40.0, 50.0), (60, 50), (90, 50)]
    np.testing.assert_array_equal(RefinedSurface(half, level, AREA, 0).heights(at), [260, 260, np.nan])
    np.testing.assert_array_equal(RefinedSurface(level, half, AREA, 0).heights(at), [250, 260, 260])


def test_units_are_refined_and_continuous() -> None:
    ditch = line([(5, 50.3, 246.0), (95, 53.7, 246.0)])
    wall = line([(45, 25, 256.0), (47.2, 90, 256.0)], [252.0, 252.0])
    coarse, cut = model(COARSE, 4, [ditch], hills)
    fine, fine_cut = model(FINE, 60, [wall], raised)
    source, fine_source = coarse.source, fine.source
    new, lines = refine_units(LinedUnits(source, cut), LinedUnits(fine_source, fine_cut), AREA, 4.0, 1.25)
    assert {n for (c, r), u in new.items() if 1 <= c <= 3 and 1 <= r <= 3 for n in [u.meshes]} == {16}
    # Around them only the unit changes whose edge the ditch crosses: elsewhere the finer posts lie on the coarse edges.
    assert {(c, r) for c in (1, 2, 3) for r in (1, 2, 3)} <= set(new)
    assert {at: new[at].meshes for at in new if at in ((0, 2), (4, 2))} == {(0, 2): 4, (4, 2): 4}
    assert len(new) == 11 and new[0, 2].faces is not None
    refined = HybridSurface(MemoryUnits(COARSE, {**source.units, **new}))
    exact = RefinedSurface(coarse, fine, AREA, 4.0)
    rng = np.random.default_rng(4)
    XY = rng.uniform(0, 100, (4000, 2))
    away = shapely.distance(shapely.MultiLineString([each.xyz[:, :2] for each in lines]), shapely.points(XY)) > 2
    away &= shapely.distance(shapely.LineString(ditch.xyz[:, :2]), shapely.points(XY)) > 2
    # Meshes that the border crosses keep the coarse heights.
    away &= shapely.distance(AREA.boundary, shapely.points(XY)) > 1.8
    # Posts 1.25 m apart miss the curvature of the step: 0.8 · 6/16 · 1.25²/8 m, and the coarse model's own bends.
    assert np.abs(refined.heights(XY[away]) - exact.heights(XY[away])).max() < 0.15
    assert np.abs(refined.heights(XY[away]) - exact.heights(XY[away])).mean() < 0.01
    outside = away & (shapely.distance(AREA, shapely.points(XY)) > 2)
    # Triangles replace bilinear meshes where finer posts adjoin; elsewhere the coarse surface is kept.
    change = np.abs(refined.heights(XY[outside]) - coarse.heights(XY[outside]))
    assert change.max() < 0.1 and (change > 1e-4).mean() < 0.2
    # The wall stands inside, the ditch runs outside only, and edges of units and meshes leave no gap.
    inner = shapely.LineString(wall.xyz[:, :2]).intersection(AREA.buffer(-5))
    mid = np.array(inner.interpolate(0.4, normalized=True).coords[0])
    step = np.array([1e-3, 0])
    jump = refined.heights(mid - step) - refined.heights(mid + step)
    assert jump == pytest.approx(4.0, abs=0.02)
    t, k = rng.uniform(0, 100, 6000), rng.integers(1, 80, 6000) * 1.25
    for at, step in ((np.stack([k, t], 1), (3e-9, 0)), (np.stack([t, k], 1), (0, 3e-9))):
        assert np.abs(refined.heights(at + step) - refined.heights(at - np.array(step))).max() < 1e-4


def test_standard_deviations_are_those_of_the_models() -> None:
    coarse, _ = model(COARSE, 4, [], hills)
    fine, _ = model(FINE, 60, [], hills)
    for unit in fine.source.units.values():
        unit.sigmas[:] = 0.05
    new, _ = refine_units(LinedUnits(coarse.source), LinedUnits(fine.source), AREA, 4.0, 1.25)
    sigmas = HybridSurface(MemoryUnits(COARSE, {**coarse.source.units, **new})).sigmas(
        [(50, 50), (5, 5), (35.0, 51.25)]
    )
    np.testing.assert_allclose(sigmas[:2], [0.05, 0.2], atol=1e-6)
    assert 0.05 < sigmas[2] < 0.2  # in the band


def test_clipped_parts_make_up_the_line() -> None:
    one = line([(20, 50, 1.0), (50, 52, 3.0), (80, 40, 5.0), (50, 60, 2)], [0.0, 1, 2, 0])
    inside, outside = clip_line(one, AREA, True), clip_line(one, AREA, False)
    assert len(inside) == 2 and len(outside) == 2
    length = sum(shapely.LineString(part.xyz[:, :2]).length for part in inside + outside)
    assert length == pytest.approx(shapely.LineString(one.xyz[:, :2]).length)
    first = inside[0]
    assert shapely.distance(AREA.boundary, shapely.Point(first.xyz[0, :2])) < 1e-9
    assert first.xyz[0, 2] == pytest.approx(1 + 2 * (first.xyz[0, 0] - 20) / 30) and first.right is not None
    assert first.right[0] == pytest.approx((first.xyz[0, 0] - 20) / 30)
    assert clip_line(line([(0, 0, 1.0), (1, 1, 1)]), AREA, True) == []


def test_refinements_without_meaning_are_refused() -> None:
    level = LevelSurface(1.0)
    for polygons, transition, message in (
        (AREA, -1.0, "transition of -1"),
        (shapely.Point(1, 2), 1.0, "inside a Point"),
        (shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)]), 1.0, "Self-intersection"),
    ):
        with pytest.raises(InputError, match=message):
            RefinedSurface(level, level, polygons, transition)
    coarse, _ = model(COARSE, 1, [], hills)
    for width in (0.0, 1e-6):
        with pytest.raises(InputError, match="grid width"):
            refine_units(LinedUnits(coarse.source), LinedUnits(coarse.source), AREA, 1.0, width)

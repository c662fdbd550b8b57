"""Cut and fill against solids that geometry knows, and against exact volumes of real triangulations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import shapely.ops
from scipy.ndimage import uniform_filter
from tools.function_surface import FunctionSurface, raster_surface
from tools.tin_volume import exact_volume, faces_near, read_landxml_tin, tin_heights, tin_outline, tin_posts

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.units import Tin
from photoplan.terrain.volume import VolumeSettings, cover, volume_between

X0, Y0 = 456_000.0, 5_340_000.0
"""Map coordinates have seven digits before the point."""


def plane(a: float, b: float, c: float) -> FunctionSurface:
    return FunctionSurface(lambda x, y: a * (x - X0) + b * (y - Y0) + c)


def odd_polygon() -> shapely.Polygon:
    shell = np.array([(3.13, 2.07), (37.4, 5.2), (44.9, 31.3), (20.2, 22.1), (6.6, 41.8)]) + np.array([X0, Y0])
    hole = np.array([(20, 10), (25.3, 11), (22, 16.7)]) + np.array([X0, Y0])
    return shapely.Polygon(shell, [hole])


@pytest.mark.parametrize("cell", [0.7, 3.0, 50.0])
def test_planes_over_any_polygon_are_exact_at_any_cell(cell):
    """The integral of a linear function is area times its value at the centroid."""
    polygon = odd_polygon()
    v = volume_between(plane(0.02, -0.03, 100), plane(0.05, 0.04, 101), polygon, VolumeSettings(cell))
    cx, cy = polygon.centroid.x - X0, polygon.centroid.y - Y0
    assert v.fill == pytest.approx(polygon.area * (0.03 * cx + 0.07 * cy + 1), rel=1e-5)
    assert v.cut == 0 and v.missing == 0
    assert v.area == pytest.approx(polygon.area, rel=1e-9)


def test_area_of_the_coverage_is_exact():
    polygon = odd_polygon()
    grid = MapGrid.covering(polygon.bounds, 0.5, "")
    covered = cover(polygon, grid, grid.window)
    assert covered.whole.sum() * 0.25 + covered.areas.sum() == pytest.approx(polygon.area, rel=1e-9)


def test_two_planes_that_cross_are_split_into_cut_and_fill():
    box = shapely.box(X0, Y0, X0 + 40, Y0 + 10)
    v = volume_between(LevelSurface(0.0), plane(0.1, 0.0, -1.0), box, VolumeSettings(0.8, 1e-4))
    assert v.cut == pytest.approx(0.5 * 10 * 1.0 * 10, rel=2e-4)
    assert v.fill == pytest.approx(0.5 * 30 * 3.0 * 10, rel=2e-4)
    assert v.net == pytest.approx(400.0, rel=1e-5)


SOLIDS = {
    "cone": (lambda x, y: np.maximum(0, 5 * (1 - np.hypot(x, y) / 12)), math.pi * 144 * 5 / 3),
    "pyramid": (lambda x, y: np.maximum(0, 6 - 0.75 * np.maximum(abs(x), abs(y))), 16 * 16 * 6 / 3),
    "prism": (lambda x, y: np.where((abs(x + y / 3) < 7.3) & (abs(y - x / 3) < 3.1), 2.5, 0.0), 14.6 * 6.2 * 2.25),
    "paraboloid": (lambda x, y: np.maximum(0, 4 - (x * x + y * y) / 25), math.pi * 100 * 4 / 2),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids(name):
    shape, volume = SOLIDS[name]
    heap = FunctionSurface(lambda x, y: 250.0 + shape(x - X0, y - Y0))
    box = shapely.box(X0 - 15, Y0 - 15, X0 + 15, Y0 + 15)
    v = volume_between(LevelSurface(250.0), heap, box, VolumeSettings(0.5, 1e-3))
    assert v.settled and v.fill == pytest.approx(volume, rel=2e-3)
    assert abs(v.fill - volume) <= 1.5 * v.error_fill + 1e-4 * volume


def test_midpoint_rule_converges_with_the_square_of_the_cell():
    wave = FunctionSurface(lambda x, y: 3 + np.sin((x - X0) / 2.1) * np.cos((y - Y0) / 1.7))
    box = shapely.box(X0, Y0, X0 + 9, Y0 + 7)
    truth = 3 * 63 + 2.1 * (1 - math.cos(9 / 2.1)) * 1.7 * math.sin(7 / 1.7)
    errors = [
        abs(volume_between(LevelSurface(0.0), wave, box, VolumeSettings(c, 0)).fill - truth) for c in (2.0, 1.0, 0.5)
    ]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2) and errors[1] / errors[2] == pytest.approx(4, rel=0.2)


def test_exchange_of_the_surfaces_exchanges_cut_and_fill_and_parts_add_up():
    rng = np.random.default_rng(5)
    a = raster_surface(rng.normal(100, 1, (40, 50)), X0, Y0 + 39, 1.0)
    b = raster_surface(rng.normal(100, 1, (20, 25)), X0 + 1, Y0 + 38, 2.0)
    box = shapely.box(X0 + 3, Y0 + 3, X0 + 40.3, Y0 + 33.7)
    settings = VolumeSettings(0.5, 0)
    there, back = volume_between(a, b, box, settings), volume_between(b, a, box, settings)
    assert (there.cut, there.fill, there.net) == pytest.approx((back.fill, back.cut, -back.net), rel=1e-12)
    cut = shapely.LineString([(X0 - 5, Y0 + 20.1), (X0 + 60, Y0 + 11.7)])
    parts = [volume_between(a, b, p, settings) for p in shapely.ops.split(box, cut).geoms]
    assert len(parts) == 2
    assert sum(p.net for p in parts) == pytest.approx(there.net, abs=2e-3 * (there.cut + there.fill))
    assert sum(p.area for p in parts) == pytest.approx(there.area, rel=1e-9)


def test_holes_are_reported_and_not_filled():
    surface = FunctionSurface(lambda x, y: np.where(np.hypot(x - X0, y - Y0) < 4, np.nan, 1.0))
    box = shapely.box(X0 - 10, Y0 - 10, X0 + 10, Y0 + 10)
    v = volume_between(LevelSurface(0.0), surface, box, VolumeSettings(0.1, 0))
    assert v.missing == pytest.approx(16 * math.pi, rel=5e-3)
    assert v.area + v.missing == pytest.approx(400, rel=1e-9)
    assert v.fill == pytest.approx(v.area, rel=1e-6)


def test_settings_are_checked():
    with pytest.raises(UsageError, match="positive"):
        VolumeSettings(0.0)
    with pytest.raises(UsageError, match="tolerance"):
        VolumeSettings(1.0, 2.0)


def test_the_exact_reference_knows_a_roof_over_a_sloping_plane():
    """Reference: a plane z = x over the unit square against the level 1/2: 1/8 on each side, whatever the diagonals."""
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    level = Tin(np.column_stack([square, np.full(4, 0.5)]), np.array([[0, 1, 2], [0, 2, 3]]))
    slope = Tin(np.column_stack([square, square[:, 0]]), np.array([[0, 1, 3], [1, 2, 3]]))
    assert exact_volume(level, slope) == pytest.approx((0.125, 0.125, 1.0), abs=1e-12)
    half = shapely.box(0.5, 0, 2, 2)
    assert exact_volume(level, slope, half) == pytest.approx((0.0, 0.125, 0.5), abs=1e-12)
    assert tin_heights(slope, np.array([[0.25, 0.6], [2, 2]])) == pytest.approx([0.25, np.nan], nan_ok=True)


@pytest.mark.slow
def test_rock_under_a_road_agrees_with_the_exact_volume_of_the_triangulations(shared):
    """Real survey: rock surface against terrain, both as grids of 0.4 m over their TINs; within 0.5 %."""
    folder = shared / "data" / "m3_road_survey"
    rock = read_landxml_tin(folder / "M3_Rockbed_survey.mm.xml")
    outline = tin_outline(rock)
    terrain = faces_near(read_landxml_tin(folder / "M3_Terrain.mm.xml"), outline, 2.0)
    cut, fill, area = exact_volume(terrain, rock)
    (xmin, ymin), (xmax, ymax) = rock.xyz[:, :2].min(axis=0), rock.xyz[:, :2].max(axis=0)
    shape = int((ymax - ymin) / 0.4) + 2, int((xmax - xmin) / 0.4) + 2
    a, b = (
        raster_surface(continued(tin_posts(tin, xmin, ymax, 0.4, shape)), xmin, ymax, 0.4) for tin in (terrain, rock)
    )
    v = volume_between(a, b, outline, VolumeSettings(0.4, 0))
    assert v.cut == pytest.approx(cut, rel=5e-3)
    assert v.net == pytest.approx(fill - cut, rel=5e-3)
    assert v.area == pytest.approx(area, rel=5e-3)


def continued(posts: np.ndarray) -> np.ndarray:
    """Posts with one ring more around them: meshes on the outline need all four posts."""
    known = np.isfinite(posts)
    weight = uniform_filter(known.astype(float), 3)
    mean = uniform_filter(np.where(known, posts, 0.0), 3) / np.maximum(weight, 1e-9)
    return np.where(known, posts, np.where(weight > 0.05, mean, np.nan))

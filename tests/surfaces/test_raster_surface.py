"""Terrain grids: bilinear inside a mesh, placed to the millimetre, carried between reference and height systems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tools.pinhole import Pinhole

from photoplan.cameras.base import project
from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.shifted import ShiftedSurface, intersect
from photoplan.targets.map import MapTarget

CRS = "EPSG:32633"


@dataclass(frozen=True, eq=False)
class Posts:
    """A height grid in memory."""

    heights: NDArray[np.float32]

    @property
    def size(self) -> tuple[int, int]:
        return self.heights.shape[1], self.heights.shape[0]

    def read(self, window: Window) -> NDArray[np.float32]:
        assert window & Window(0, 0, *self.size) == window and window.size
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]]


def bilinear(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """A surface that bilinear interpolation reproduces exactly."""
    x, y = (X - 500_000) / 100, (Y - 5_300_000) / 100
    return 100 + 3 * x - 2 * y + 0.5 * x * y


def surface(columns: int = 30, rows: int = 20, mesh: tuple[float, float] = (25.0, 20.0)) -> RasterSurface:
    X = 500_000 + np.arange(columns) * mesh[0]
    Y = 5_300_000 - np.arange(rows) * mesh[1]
    heights = bilinear(*np.meshgrid(X, Y)).astype(np.float32)
    return RasterSurface(Posts(heights), (500_000, 5_300_000), mesh)


@settings(max_examples=40, deadline=None)
@given(
    left=st.floats(500_010, 500_400),
    top=st.floats(5_299_700, 5_299_990),
    resolution=st.sampled_from([0.1, 1.0, 7.3]),
    col=st.integers(0, 9),
)
def test_relief_is_the_surface_at_pixel_centres(left: float, top: float, resolution: float, col: int) -> None:
    target = MapTarget(MapGrid(left, top, resolution, 40, 30, CRS))
    window = Window(col, 3, 11, 7)
    v, u = np.mgrid[3:10, col : col + 11].astype(float)
    XYZ = target.to_ground(np.stack([u, v, np.zeros_like(u)], axis=-1))
    np.testing.assert_allclose(surface().relief(target, window), bilinear(XYZ[..., 0], XYZ[..., 1]), atol=2e-4)
    np.testing.assert_allclose(surface().heights(XYZ[..., :2]), bilinear(XYZ[..., 0], XYZ[..., 1]), atol=2e-4)


def test_the_edge_is_continued_by_half_a_mesh_and_no_more() -> None:
    s = surface()
    inside = s.heights([(500_000 - 12.4, 5_300_000), (500_000, 5_300_000 + 9.9)])
    outside = s.heights([(500_000 - 12.6, 5_300_000), (500_000, 5_300_000 + 10.1)])
    np.testing.assert_allclose(inside, 100.0, atol=1e-4)
    assert np.isnan(outside).all()


def test_a_missing_post_takes_its_four_meshes_and_nothing_else() -> None:
    posts = surface().grid
    holed = posts.heights.copy()  # type: ignore[attr-defined]
    holed[5, 7] = np.nan
    s = RasterSurface(Posts(holed), (500_000, 5_300_000), (25.0, 20.0))
    X, Y = 500_000 + 7 * 25.0, 5_300_000 - 5 * 20.0
    assert np.isnan(s.heights([(X + 24, Y + 19), (X - 24, Y - 19), (X, Y)])).all()
    assert np.isfinite(s.heights([(X + 26, Y), (X, Y + 21), (X - 26, Y), (X, Y - 21)])).all()


def test_nothing_is_read_where_there_is_nothing() -> None:
    target = MapTarget(MapGrid(100, 100, 1, 8, 8, CRS))
    assert np.isnan(surface().relief(target, Window(0, 0, 8, 8))).all()
    assert np.isnan(surface().height_range((0, 0, 10, 10))).all()
    assert np.isnan(surface().heights([(0, 0), (np.nan, 1)])).all()


def test_height_range_holds_every_height_inside() -> None:
    s = surface()
    bounds = (500_111, 5_299_800, 500_333, 5_299_950)
    rng = np.random.default_rng(1)
    XY = rng.uniform(bounds[:2], bounds[2:], (500, 2))
    low, high = s.height_range(bounds)
    h = s.heights(XY)
    assert low <= h.min() and h.max() <= high
    assert high - low < 3 * (h.max() - h.min())


def test_terrain_in_another_crs_lies_where_its_own_coordinates_say() -> None:
    """The same terrain seen from the neighbouring zone: relief equals the height at the transformed pixel."""
    to_terrain = crs_step("EPSG:32632", CRS)
    s = RasterSurface(surface().grid, (500_000, 5_300_000), (25.0, 20.0), to_terrain)
    middle = crs_step(CRS, "EPSG:32632")(np.array([500_300.0, 5_299_800.0]))
    grid = MapGrid(middle[0] - 30, middle[1] + 30, 0.5, 120, 120, "EPSG:32632")
    relief = s.relief(MapTarget(grid), grid.window)
    v, u = np.mgrid[:120, :120].astype(float)
    XY = to_terrain(grid.to_map(np.stack([u, v], axis=-1)))
    np.testing.assert_allclose(relief, bilinear(XY[..., 0], XY[..., 1]), atol=5e-3)


def test_far_heights_are_read_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same heights when a look may read a few posts at once only."""
    s = surface()
    XY = np.random.default_rng(3).uniform((500_000, 5_299_640), (500_720, 5_300_000), (300, 2))
    heights = s.heights(XY)
    sizes: list[int] = []
    read = Posts.read

    def watched(self: Posts, window: Window) -> NDArray[np.float32]:
        sizes.append(window.size)
        return read(self, window)

    monkeypatch.setattr(Posts, "read", watched)
    monkeypatch.setattr("photoplan.surfaces.raster.MOST_POSTS", 40)
    np.testing.assert_array_equal(s.heights(XY), heights)
    assert len(sizes) > 20 and max(sizes) <= 40


def test_ranges_are_read_in_parts_once_and_where_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    heights = rng.normal(0, 10, (90, 130)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.3] = np.nan
    heights[16:48, 32:64] = np.nan
    read_windows: list[Window] = []
    read = Posts.read

    def watched(self: Posts, window: Window) -> NDArray[np.float32]:
        read_windows.append(window)
        return read(self, window)

    monkeypatch.setattr(Posts, "read", watched)
    small, large = (RasterSurface(Posts(heights), (0, 0), (1, 1), part=(side, side)) for side in (16, 1000))
    low, high = np.sort(rng.uniform((-20, -100), (140, 20), (2, 60, 2)), axis=0)
    boxes = np.concatenate([low, high], axis=1)
    found = small.height_range(boxes[:1])
    touched = len(read_windows)
    assert max(w.size for w in read_windows) <= 256 and len(set(read_windows)) == touched
    found = np.concatenate([found, small.height_range(boxes[1:])])
    assert len(set(read_windows)) == len(read_windows) > touched
    np.testing.assert_array_equal(found, large.height_range(boxes))
    assert len(read_windows[-1:]) == 1 and read_windows[-1] == Window(0, 0, 130, 90)
    for (x0, y0, x1, y1), (lowest, highest) in zip(boxes, found):
        inside = small.heights(rng.uniform((x0, y0), (x1, y1), (200, 2)))
        inside = inside[np.isfinite(inside)]
        assert not len(inside) or lowest <= inside.min() <= inside.max() <= highest
    assert np.isnan(small.height_range((34, -44, 45, -20))).all()


def test_only_map_targets_and_north_up_grids() -> None:
    with pytest.raises(InputError, match="mesh"):
        RasterSurface(surface().grid, (0, 0), (1.0, -1.0))
    with pytest.raises(UsageError, match="map targets"):
        surface().relief(object(), Window(0, 0, 1, 1))  # type: ignore[arg-type]


def test_a_shift_of_heights_is_added_everywhere() -> None:
    def geoid(XY: NDArray[np.float64]) -> NDArray[np.float64]:
        return 45 + 1e-4 * (XY[..., 0] - 500_000) - 2e-4 * (XY[..., 1] - 5_300_000)

    plain, shifted = surface(), ShiftedSurface(surface(), geoid)
    target = MapTarget(MapGrid(500_100, 5_299_900, 0.5, 300, 200, CRS))
    window = Window(10, 20, 257, 130)
    v, u = np.mgrid[20:150, 10:267].astype(float)
    XY = target.grid.to_map(np.stack([u, v], axis=-1))
    np.testing.assert_allclose(shifted.relief(target, window), plain.relief(target, window) + geoid(XY), atol=1e-4)
    np.testing.assert_allclose(shifted.heights(XY), plain.heights(XY) + geoid(XY), atol=1e-9)
    low, high = shifted.height_range(target.grid.bounds)
    assert low <= np.min(shifted.heights(XY)) and high >= np.max(shifted.heights(XY))


def test_rays_meet_the_surface_they_see_first() -> None:
    s = surface()
    camera = Pinhole(Pose.from_angles((500_350, 5_299_800, 700), (0.1, -0.05, 0.3)), 800.0, (400, 300))
    xy = np.random.default_rng(2).uniform((0, 0), (399, 299), (60, 2))
    points = intersect(camera, xy, s, s.height_range((500_000, 5_299_000, 501_000, 5_300_100)))
    assert np.isfinite(points).all()
    np.testing.assert_allclose(points[:, 2], s.heights(points[:, :2]), atol=1e-3)
    np.testing.assert_allclose(project(camera, points), xy, atol=1e-6)


def test_rays_into_the_sky_and_beyond_the_terrain_meet_nothing() -> None:
    up = Pinhole(Pose.from_angles((500_350, 5_299_800, 700), (np.pi, 0, 0)), 800.0, (400, 300))
    assert np.isnan(intersect(up, [(200, 150)], surface(), (50.0, 200.0))).all()
    beside = Pinhole(Pose.from_angles((600_000, 5_299_800, 700), (0, 0, 0)), 800.0, (400, 300))
    assert np.isnan(intersect(beside, [(200, 150)], surface(), (50.0, 200.0))).all()
    below = Pinhole(Pose.from_angles((500_350, 5_299_800, 10), (0, 0, 0)), 800.0, (400, 300))
    assert np.isnan(intersect(below, [(200, 150)], LevelSurface(100.0), (100.0, 100.0))).all()

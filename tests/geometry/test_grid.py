"""Pixels on the map: half pixels, covering grids, crops, tiles."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from rasterio.crs import CRS

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid, Placement, Window
from photoplan.geometry.pose import Pose

finite = st.floats(-1e6, 1e6)


def test_the_first_pixels_centre_is_half_a_pixel_inside() -> None:
    grid = MapGrid(1000.0, 2000.0, 0.5, 10, 8, "EPSG:32633")
    np.testing.assert_allclose(grid.to_map((0, 0)), (1000.25, 1999.75))
    np.testing.assert_allclose(grid.to_map((-0.5, -0.5)), (1000.0, 2000.0))
    assert grid.bounds == (1000.0, 1996.0, 1005.0, 2000.0)


@given(x=finite, y=finite, resolution=st.floats(0.01, 100))
def test_map_and_pixel_are_inverse(x: float, y: float, resolution: float) -> None:
    grid = MapGrid(1000.0, 2000.0, resolution, 10, 8, "EPSG:32633")
    np.testing.assert_allclose(grid.to_map(grid.to_pixel((x, y))), (x, y), atol=1e-8)


@given(
    left=finite,
    bottom=finite,
    size=st.floats(1, 5000),
    resolution=st.sampled_from([0.1, 0.25, 0.3, 1.0, 7.0]),
    shift=st.floats(-100, 100),
)
def test_grids_of_one_resolution_share_their_pixels(
    left: float, bottom: float, size: float, resolution: float, shift: float
) -> None:
    first = MapGrid.covering((left, bottom, left + size, bottom + size), resolution, "EPSG:32633")
    second = MapGrid.covering(
        (left + shift, bottom - shift, left + shift + size, bottom - shift + size), resolution, "EPSG:32633"
    )
    between = (np.array([second.left - first.left, second.top - first.top])) / resolution
    np.testing.assert_allclose(between, np.round(between), atol=1e-4)
    xmin, ymin, xmax, ymax = first.bounds
    slack = 1e-5 * resolution
    assert xmin <= left + slack and ymin <= bottom + slack
    assert xmax >= left + size - slack and ymax >= bottom + size - slack


def test_bounds_on_multiples_are_kept() -> None:
    grid = MapGrid.covering((576661.8, 5188114.0, 576768.4, 5188211.8), 0.1, "EPSG:32615")
    assert (grid.width, grid.height) == (1066, 978)


def test_tiles_cover_a_window_once() -> None:
    window = Window(3, 5, 1000, 700)
    hits = np.zeros((705, 1003), int)
    for tile in window.tiles(256):
        hits[tile.row : tile.stop[1], tile.col : tile.stop[0]] += 1
    assert (hits[5:, 3:] == 1).all() and hits.sum() == window.size


def test_common_part_of_windows() -> None:
    assert Window(0, 0, 10, 10) & Window(4, 6, 10, 10) == Window(4, 6, 6, 4)
    assert (Window(0, 0, 10, 10) & Window(20, 0, 5, 5)).size == 0


@pytest.mark.parametrize("bad", [(1, 0, 0, 1), (0, 0, np.nan, 1), (0, 1, 1, 1)])
def test_empty_bounds_are_refused(bad: tuple[float, float, float, float]) -> None:
    with pytest.raises(UsageError, match="bounds"):
        MapGrid.covering(bad, 1.0, "EPSG:32633")


def test_resolution_must_be_positive() -> None:
    with pytest.raises(UsageError, match="resolution"):
        MapGrid.covering((0, 0, 1, 1), 0.0, "EPSG:32633")


def test_poses_are_motions() -> None:
    a = Pose.from_angles((10, 20, 30), (0.1, -0.2, 0.3))
    b = Pose.from_angles((-5, 4, 2), (1.0, 0.4, -2.0))
    XYZ = np.random.default_rng(0).normal(size=(7, 3)) * 100
    np.testing.assert_allclose((a @ b).to_ground(XYZ), a.to_ground(b.to_ground(XYZ)))
    np.testing.assert_allclose((~a).to_ground(a.to_ground(XYZ)), XYZ)
    np.testing.assert_allclose(a.to_camera(a.to_ground(XYZ)), XYZ)
    assert Pose.from_angles((0, 0, 0), (0.3, 0, 2.0)).tilt == pytest.approx(0.3)


def test_a_mirror_is_no_pose() -> None:
    with pytest.raises(InputError, match="rotation"):
        Pose(np.zeros(3), np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match="centre"):
        Pose(np.array([0, np.nan, 0]), np.eye(3))


def test_placement_of_a_grid_is_where_the_grid_is() -> None:
    grid = MapGrid(500_000.5, 5_200_000.25, 0.5, 70, 30, "EPSG:32633")
    place = grid.placement
    assert (place.bounds, place.crs, place.size, place.unit) == (grid.bounds, grid.crs, (70, 30), "metre")
    uv = np.array([(0.0, 0.0), (69.0, 29.0), (12.25, -3.5)])
    np.testing.assert_array_equal(place.to_plane(uv), grid.to_map(uv))
    part = Window(3, 5, 20, 10)
    assert place.part(part).bounds == grid.bounds_of(part)


def test_placement_goes_to_an_affine_and_back() -> None:
    turned = Affine.translation(10, 20) * Affine.rotation(30) * Affine.scale(0.5, -0.25)
    place = Placement.from_affine(turned, CRS.from_epsg(32633), size=(40, 20))
    assert (place.affine, place.crs) == (turned, "EPSG:32633")
    # An affine counts from the corner of a pixel, pixel coordinates from its centre.
    np.testing.assert_allclose(place.to_plane((7, 3)), turned * (7.5, 3.5), atol=1e-12)
    assert Placement((40, 20)).unit == "pixel"
    np.testing.assert_array_equal(Placement((40, 20)).to_plane((0, 0)), (0.5, 0.5))
    for wrong in ({"transform": (1.0, 2.0, 0.0, 2.0, 4.0, 0.0)}, {"transform": (np.nan,) * 6}, {"size": (0, 4)}):
        with pytest.raises(UsageError):
            Placement(**({"size": (4, 4)} | wrong))

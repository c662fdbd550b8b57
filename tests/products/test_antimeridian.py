"""Longitude is a circle: terrain, polynomials and products across 180°, however longitudes are counted."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from pyproj import Transformer
from rasterio.transform import from_origin
from tools.command import inside
from tools.rpc_files import as_text

import photoplan as pp
from photoplan.cameras.base import project
from photoplan.cameras.rpc import RationalFunctions, RpcCamera, fit_rpc
from photoplan.geometry.crs import crs_step, nearest_turn, topocentric_poses, turn_of
from photoplan.geometry.local import GeodeticGround, geocentric_of_geodetic, geocentric_poses, map_poses
from photoplan.io.image_metadata import ImageMetadata, map_positions
from photoplan.io.orientation.block import OrientationTable, OrientedImage
from photoplan.products.init import placed
from photoplan.project.ground import open_terrain

#: Zones of UTM that meet at 180°, and where on the earth the image lies.
ZONES, LATITUDE = ("EPSG:32701", "EPSG:32760"), -17.0
SIZE = (120, 80)


def slope(latitude: np.ndarray) -> np.ndarray:
    return (100.0 + 2000.0 * (latitude - LATITUDE)).astype(np.float32)


def raster(path: Path, heights: np.ndarray, corner: tuple[float, float], mesh: tuple[float, float], crs: str) -> Path:
    rows, columns = heights.shape
    with rasterio.open(path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", crs=crs,
                       transform=from_origin(*corner, *mesh)) as file:  # fmt: skip
        file.write(heights, 1)
    return path


def in_degrees(path: Path, west: float, columns: int, width: float, shift: float = 0.0) -> Path:
    """Terrain that slopes to the north; columns of `width` degrees from `west` on, of cells or (half a cell) posts."""
    latitude = LATITUDE + 0.02 - 1e-4 * (np.arange(400) + 0.5)
    heights = np.repeat(slope(latitude)[:, None], columns, axis=1)
    return raster(path, heights, (west - shift, LATITUDE + 0.02), (width, 1e-4), "EPSG:4326")


TERRAINS = {
    "counted from 0 to 360": (179.98, 400, 1e-4, 0.0),
    "counted from -180": (-180.02, 400, 1e-4, 0.0),
    "round the earth from -180": (-180.0, 720, 0.5, 0.0),
    "round the earth from 0": (0.0, 720, 0.5, 0.0),
    "round the earth, posts from -180 to 180": (-180.0, 721, 0.5, 0.25),
    "a half of the earth": (100.0, 260, 0.5, 0.0),
}


def utm(path: Path, crs: str) -> Path:
    X, Y = crs_step("EPSG:4326", crs)([180.0, LATITUDE])
    x, y = np.meshgrid(X - 2000 + 10 * (np.arange(400) + 0.5), Y + 2000 - 10 * (np.arange(400) + 0.5))
    latitude = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x, y)[1]
    return raster(path, slope(np.asarray(latitude)), (X - 2000, Y + 2000), (10, 10), crs)


def polynomials(offset: float = 179.9995) -> RationalFunctions:
    coefficients = np.zeros((4, 20))
    coefficients[[1, 3], 0] = 1.0
    coefficients[0, [1, 3]], coefficients[2, [2, 3]] = (1.0, 0.02), (-1.0, 0.05)
    half = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return RationalFunctions(half, half, (offset, LATITUDE, 100.0), (0.0028, 0.0018, 500.0), coefficients)


def orthophoto(
    folder: Path, terrain: Path, crs: str, offset: float = 179.9995
) -> tuple[np.ndarray, np.ndarray, object]:
    folder.mkdir()
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = (100 + 50 * np.sin(x / 5) * np.cos(y / 7) + x / 3).astype(np.uint8)
    with rasterio.open(
        folder / "img.tif", "w", driver="GTiff", width=SIZE[0], height=SIZE[1], count=1, dtype="uint8"
    ) as f:
        f.write(pixels, 1)
    (folder / "img_RPC.TXT").write_text(as_text(polynomials(offset)))
    made = inside("init", folder / "p", "--images", folder / "img.tif", "--terrain", terrain, "--crs", crs,
                  "--height-system", "ellipsoidal")  # fmt: skip
    assert made.code == 0, made.err
    said = inside("ortho", folder / "p/project.toml", "--resolution", 5, "--no-quicklook")
    assert said.code == 0, said.err
    with rasterio.open(said.out.strip()) as file:
        return file.read(1), file.read_masks(1) > 0, file.transform


@cache
def _wanted(folder: Path, crs: str) -> tuple[np.ndarray, np.ndarray, object]:
    return orthophoto(folder / f"wanted_{crs[5:]}", utm(folder / f"{crs[5:]}.tif", crs), crs)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("antimeridian")


@pytest.mark.parametrize("crs", ZONES)
@pytest.mark.parametrize("name", list(TERRAINS))
def test_the_product_is_that_over_a_grid_of_the_zone(folder: Path, tmp_path: Path, name: str, crs: str) -> None:
    values, valid, transform = orthophoto(tmp_path / "made", in_degrees(tmp_path / "t.tif", *TERRAINS[name]), crs)
    wanted, there, place = _wanted(folder, crs)
    assert transform == place and values.shape == wanted.shape and there.mean() > 0.9
    assert np.array_equal(valid, there)
    assert np.abs(values.astype(int) - wanted)[there].max() <= 1


@pytest.mark.parametrize("offset", [179.9995 - 360.0, -179.9995 + 360.0 - 0.001])
def test_polynomials_count_from_either_side(folder: Path, tmp_path: Path, offset: float) -> None:
    values, valid, transform = orthophoto(tmp_path / "made", utm(tmp_path / "t.tif", ZONES[0]), ZONES[0], offset)
    wanted, there, place = _wanted(folder, ZONES[0])
    assert transform == place and np.array_equal(values, wanted) and np.array_equal(valid, there)


def test_a_map_on_a_cylinder_goes_round_too(tmp_path: Path) -> None:
    """X of a grid in Web Mercator from 179.98° on goes on beyond the border of the projection."""
    turn = turn_of("EPSG:3857")
    assert turn == pytest.approx(2 * np.pi * 6378137, rel=1e-12)
    x0, y0 = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(179.98, LATITUDE + 0.02)
    y = y0 - 12 * (np.arange(370) + 0.5)
    latitude = Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True).transform(np.zeros(370), y)[1]
    path = raster(tmp_path / "m.tif", np.repeat(slope(latitude)[:, None], 370, axis=1), (x0, y0), (12, 12), "EPSG:3857")
    surface = open_terrain(path).in_crs(ZONES[0])[0].surface
    XY = crs_step("EPSG:4326", ZONES[0])([[179.99, -17.005], [180.0, -17.0], [-179.99, -17.0], [-179.985, -16.99]])
    np.testing.assert_allclose(surface.heights(XY), slope(np.array([-17.005, -17.0, -17.0, -16.99])), atol=0.01)


@pytest.mark.parametrize("name", list(TERRAINS))
def test_points_and_windows_in_degrees_are_found_in_either_count(tmp_path: Path, name: str) -> None:
    """Asked in longitudes from 0 to 360 and from -180 to 180 of terrain that counts in the other way."""
    terrain = in_degrees(tmp_path / "t.tif", *TERRAINS[name])
    table = tmp_path / "points.csv"
    longitudes = [179.985, 179.9999, 180.0, 180.0001, 180.01, -179.985, -180.0, -179.9999, -180.01, 539.99]
    table.write_text("name,x,y\n" + "".join(f"p{k},{lon},-17.003\n" for k, lon in enumerate(longitudes)))
    said = inside("dtm", "sample", terrain, table, "-o", tmp_path / "out.csv")
    assert said.code == 0, said.err
    heights = [float(line.split(",")[3]) for line in (tmp_path / "out.csv").read_text().splitlines()[1:]]
    assert heights == pytest.approx([94.0] * len(longitudes), abs=0.01)
    opened = open_terrain(terrain)
    grid = pp.MapGrid(180.0 - 0.005, -17.0, 0.0001, 100, 20, "EPSG:4326")
    relief = opened.surface.relief(pp.MapTarget(grid), pp.Window(0, 0, 100, 20))
    assert np.isfinite(relief).all() and np.ptp(relief, axis=1).max() < 1e-3
    opened.refuse_apart((-179.999, -17.01, -179.99, -17.0))


def test_a_grid_of_half_the_earth_serves_a_project(tmp_path: Path) -> None:
    """Most of it lies beyond the zone; that was an error before."""
    surface = open_terrain(in_degrees(tmp_path / "t.tif", -180.0, 720, 0.5)).in_crs("EPSG:32632")[0].surface
    assert surface.heights([[500_000.0, 8_120_000.0 - 10_000_000.0]]) == pytest.approx([100.0], abs=60.0)


@pytest.mark.parametrize("crs", ZONES)
def test_polynomials_fitted_across_the_line_and_their_derivatives(crs: str) -> None:
    camera = RpcCamera(polynomials(), GeodeticGround(crs, "ellipsoidal"), SIZE)
    fitted = fit_rpc(camera, GeodeticGround(crs, "ellipsoidal"), (0.0, 300.0))
    assert fitted.worst < 1e-3 and fitted.functions.ground_scale[0] < 0.01
    xy = np.stack(np.meshgrid([2.0, 59.0, 60.0, 61.0, 117.0], [3.0, 77.0]), axis=-1).reshape(-1, 2)
    XYZ, _ = camera.rays(xy, 120.0)
    assert np.isfinite(XYZ).all() and np.abs(project(camera, XYZ) - xy).max() < 1e-6
    apart = [(project(camera, XYZ + e) - project(camera, XYZ - e)) / 2 for e in np.eye(3)]
    np.testing.assert_allclose(camera.derivatives(XYZ), np.stack(apart, axis=-1), atol=1e-7)


def test_catalogue_entries_are_cut_at_the_line(folder: Path) -> None:
    """RFC 7946: two polygons within ±180°, and bounds whose west is more than their east."""
    _wanted(folder, ZONES[0])
    file = folder / "wanted_32701/p/project.toml"
    said = inside("mosaic", file, "--resolution", 10, "--sheets", 2000, "--no-quicklook", "--json")
    assert said.code == 0, said.err
    items = [Path(each["path"]).with_suffix(".stac.json") for each in json.loads(said.out)["products"]]
    found = [json.loads(item.read_text()) for item in items]
    shapes = [shapely.geometry.shape(item["geometry"]) for item in found]
    assert all(s.bounds[0] >= -180 and s.bounds[2] <= 180 and s.is_valid and s.area < 0.001 for s in shapes)
    across = [item["bbox"] for item, s in zip(found, shapes) if s.geom_type == "MultiPolygon"]
    assert across and all(west > 179.9 and east < -179.9 for west, _, east, _ in across)


def test_one_place_wraps_longitudes() -> None:
    assert nearest_turn([-179.0, 181.0, 541.0, np.nan], 180.0, 360.0).tolist()[:3] == [181.0, 181.0, 181.0]
    assert turn_of("EPSG:4326") == pytest.approx(360.0) and turn_of("EPSG:32632") is None
    assert turn_of("EPSG:4807") == pytest.approx(400.0)


def test_images_on_both_sides_of_the_line_on_a_cylinder() -> None:
    """Poses within 50 m of the line had got a heading that was turned by 180°, and places a turn apart."""
    enu = np.array([[-60.0, 0, 100], [-10, 5, 100], [3, 0, 100], [60, 0, 100]])
    for longitude in (180.0, -180.0, 179.9999):
        XYZ, axes = topocentric_poses((LATITUDE, longitude, 0.0), "EPSG:3857", enu)
        scale = 1 / np.cos(np.radians(LATITUDE))
        np.testing.assert_allclose(np.diff(XYZ[:, 0]), np.diff(enu[:, 0]) * scale, rtol=0.01)
        np.testing.assert_allclose(axes, np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-4)
    earth = np.array([geocentric_of_geodetic((LATITUDE, lon, 100.0)) for lon in (179.9995, -179.9995, 179.99999)])
    XYZ, axes = map_poses("EPSG:3857", earth)
    assert np.ptp(XYZ[:, 0]) < 120 and np.abs(axes - axes[0]).max() < 1e-4
    back, again = geocentric_poses("EPSG:3857", XYZ)
    np.testing.assert_allclose(back, earth, atol=1e-6)
    np.testing.assert_allclose(again, axes, atol=1e-9)
    states = [
        ImageMetadata(Path(f"{k}.jpg"), position=(LATITUDE, lon, 5.0)) for k, lon in enumerate((179.9995, -179.9995))
    ]
    X = map_positions(states, "EPSG:3857")[:, 0]
    assert X[1] - X[0] == pytest.approx(np.radians(0.001) * 6378137)
    table = OrientationTable(Path("a.csv"), tuple(
        OrientedImage(f"{k}", (x, 8117998.0, 100.0), (0, 0, 0), None)
        for k, x in enumerate(crs_step("EPSG:4326", "EPSG:32760")([[179.9995, LATITUDE], [-179.9999, LATITUDE]])[:, 0])
    ), crs="EPSG:32760")  # fmt: skip
    centers, opk = placed(table, "EPSG:3857")
    assert abs(centers[1, 0] - centers[0, 0]) < 100 and np.ptp(opk[:, 2]) < 0.01

"""The visible area: of level ground with a wall on it, whose shadow is known, as a raster and as a polygon."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin
from tools.command import inside
from tools.recorded import checked, recorded

from photoplan.errors import UsageError
from photoplan.products.view.measure import visible_area
from photoplan.requests.view import AreaRequest, CameraRequest

CRS, X0, Y0 = "EPSG:32633", 500_000.0, 5_300_000.0
#: Eye 20 m above level ground, level view, 30° to both sides.
STAND = CameraRequest(
    position=(X0, Y0), height=20.0, azimuth=0.0, field_of_view=60.0, size=(300, 200), curvature="none"
)
TAN30 = float(np.tan(np.radians(30.0)))


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Level ground, posts of 2 m, with a wall 10 m high across the view 100 m to the north, and a hole."""
    heights = np.full((200, 200), 100.0, np.float32)
    heights[99] = 110.0
    heights[20:30, 90:110] = -9999.0
    path = tmp_path_factory.mktemp("area") / "wall.tif"
    place = {"crs": CRS, "transform": from_origin(X0 - 200.0, Y0 + 300.0, 2.0, 2.0), "nodata": -9999.0}
    with rasterio.open(path, "w", driver="GTiff", width=200, height=200, count=1, dtype="float32", **place) as file:
        file.write(heights, 1)
    return path


def expected() -> shapely.Geometry:
    """Inside the picture, before the wall (the rise to its crest included) and behind its shadow, twice as far away."""
    crest, nearest = 300.0 - 99 * 2.0 - 1.0, 20.0 * 150 / TAN30 / 100
    half = np.array([nearest, 1000.0]) * TAN30
    wedge = shapely.Polygon([(-half[0], nearest), (half[0], nearest), (half[1], 1000.0), (-half[1], 1000.0)])
    shadow = shapely.box(-500.0, crest, 500.0, 2 * crest)
    return shapely.intersection(wedge, shapely.box(-199.0, -99.0, 199.0, 299.0)) - shadow


def test_level_ground_before_and_behind_a_wall(wall: Path, tmp_path: Path) -> None:
    """Every pixel whose middle is more than a metre from the border is right, behind the wall more than two."""
    found = visible_area(AreaRequest(wall, STAND, output=tmp_path / "a.tif", resolution=1.0))
    with rasterio.open(tmp_path / "a.tif") as file:
        values, left, top = file.read(1), file.bounds.left, file.bounds.top
        assert (left, top, file.res, file.crs.to_string()) == (X0 - 200, Y0 + 300, (1.0, 1.0), CRS)
    v, u = np.mgrid[0:400, 0:400]
    at = shapely.points(left + u + 0.5 - X0, top - v - 0.5 - Y0)
    truth = expected()
    border = shapely.distance(at, truth.boundary)
    hole = values == 255
    assert hole[42:58, 182:218].all() and not hole[70:390, 10:390].any()
    sure = (border > 2.5) & ~hole
    np.testing.assert_array_equal(values[sure] == 1, shapely.contains(truth, at)[sure])
    assert found.seen == (values == 1).sum() and found.looked_at == (~hole).sum()
    assert checked(json.loads((tmp_path / "a.run.json").read_text()))["kind"] == "view area"


def test_the_polygon_goes_along_the_pixels(wall: Path, tmp_path: Path) -> None:
    """By command, as table of one feature; `--farthest` bounds the map."""
    words = ("--from", X0, Y0, "--height", 20, "--azimuth", 0, "--size", 300, 200, "--curvature", "none")
    said = inside("view", "area", wall, *words, "--farthest", 90, "--resolution", 1, "-o", tmp_path / "a.gpkg")
    assert said.code == 0 and "km² are seen" in said.err, said.err
    meta, _, shapes, (area,) = pyogrio.raw.read(tmp_path / "a.gpkg")
    (shape,) = shapely.from_wkb(shapes)
    assert meta["geometry_type"] == "MultiPolygon" and meta["crs"] == CRS and shape.area == area[0]
    moved = shapely.transform(shape, lambda xy: xy - (X0, Y0))
    # What is seen lies on the ground, 20 m below the eye: 87.7 m on the map are 90 m of ray.
    near = shapely.intersection(expected(), shapely.Point(0, 0).buffer(np.sqrt(90**2 - 20**2), quad_segs=64))
    assert shapely.symmetric_difference(moved, near).area < 0.02 * near.area  # the steps of its pixels
    assert recorded(tmp_path / "a.run.json", "view area", wall)["product"]["area"]["visible_area"] == shape.area


def test_what_is_refused(wall: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"written as \.tif"):
        visible_area(AreaRequest(wall, STAND, output=tmp_path / "a.png"))
    with pytest.raises(UsageError, match=r"larger `resolution`"):
        visible_area(AreaRequest(wall, STAND, output=tmp_path / "a.tif", resolution=0.01))
    with pytest.raises(UsageError, match="is the input"):
        visible_area(AreaRequest(wall, STAND, output=wall, overwrite=True))


def test_nothing_seen_is_no_feature(wall: Path, tmp_path: Path) -> None:
    up = CameraRequest(position=(X0, Y0), height=20.0, azimuth=0.0, pitch=60.0, size=(30, 20))
    assert visible_area(AreaRequest(wall, up, output=tmp_path / "up.gpkg")).seen == 0
    assert pyogrio.read_info(tmp_path / "up.gpkg")["features"] == 0

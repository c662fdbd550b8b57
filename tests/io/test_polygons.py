"""Vector files of users, small vector products, and tables of points."""

from __future__ import annotations

import numpy as np
import pyogrio.raw
import pytest
import shapely
from tools.dem_file import write_geojson

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.io.tables import Columns, read_table
from photoplan.io.vector_layer import label_polygons, read_features, write_features

CRS = "EPSG:31287"
COLUMNS = Columns(roles={"x": ("x", "east"), "y": ("y", "north"), "h": ("h",), "name": ("name",)}, needed=("x", "y"))


@pytest.mark.parametrize("kind", ["Polygon", "MultiPolygon", "LineString Z", "Point Z"])
def test_what_is_written_is_read(tmp_path, kind):
    shape = {
        "Polygon": shapely.box(1, 2, 3, 4),
        "MultiPolygon": shapely.MultiPolygon([shapely.box(1, 2, 3, 4), shapely.box(5, 5, 6, 6)]),
        "LineString Z": shapely.LineString([(1, 2, 3.5), (4, 5, 6.25)]),
        "Point Z": shapely.Point(1, 2, 3.125),
    }[kind]
    path = tmp_path / "a.gpkg"
    write_features(path, kind, [shape, shape], {"name": np.array(["north", "süd"], object)}, CRS, "things")
    read = read_features(path, "Polygon", "LineString", "Point")
    assert [item.name for item in read.items] == ["north", "süd"] and read.crs == CRS
    assert all(shapely.equals_exact(item.geometry, shape) for item in read.items)
    found, given = (shapely.get_coordinates(g, include_z=True) for g in (read.items[0].geometry, shape))
    np.testing.assert_array_equal(found, given)
    assert [p.name for p in tmp_path.iterdir()] == ["a.gpkg"], "nothing else is left"


def test_fault_03_an_older_file_stays_when_writing_fails(tmp_path, monkeypatch):
    path = tmp_path / "a.gpkg"
    write_features(path, "Point", [shapely.Point(1, 2)], {}, CRS, "old")
    before = path.read_bytes()

    def fails(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pyogrio.raw, "write", fails)
    with pytest.raises(Exception, match="No space left"):
        write_features(path, "Point", [shapely.Point(3, 4)], {}, CRS, "new")
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.gpkg"]


def test_wrong_names_and_contents(tmp_path):
    with pytest.raises(UsageError, match=r"\.gpkg"):
        write_features(tmp_path / "a.shp", "Point", [], {}, CRS, "x")
    lines = write_geojson(tmp_path / "lines.geojson", {"way": shapely.LineString([(0, 0), (1, 1)])})
    with pytest.raises(InputError, match="feature 1 is a LineString"):
        read_features(lines, "Polygon")
    text = tmp_path / "text.geojson"
    text.write_text("hello")
    with pytest.raises(InputError, match="not a vector file"):
        read_features(text, "Polygon")
    text.write_text('{"type": "FeatureCollection", "features": [')
    with pytest.raises(InputError, match="cannot be read"):
        read_features(text, "Polygon")
    text.write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(InputError, match=r"text\.geojson"):
        read_features(text, "Polygon")
    silent = write_geojson(tmp_path / "silent.geojson", {"a": shapely.box(0, 0, 1, 1)}, crs=None)
    assert read_features(silent, "Polygon").crs is None, "GDAL would say WGS 84"


def test_labels_become_outlines():
    labels = np.array([[1, 1, 2], [1, 0, 2], [3, -1, 1]], np.int32)
    found = label_polygons(labels, MapGrid(100.0, 50.0, 2.0, 3, 3, CRS))
    assert {k: v.area for k, v in found.items()} == {1: 16.0, 2: 8.0, 3: 4.0}
    assert found[1].bounds == (100, 44, 106, 50) and len(found[1].geoms) == 2


@pytest.mark.parametrize("mark", [",", ";", "\t", " "])
def test_tables_of_points(tmp_path, mark):
    path = tmp_path / "t.csv"
    rows = [["Name", "East", "North", "h"], ["a", "1.5", "-2e3", "7"], ["b", "3", "4", "8"]]
    path.write_text("# talk\n" + "\n".join(mark.join(row) for row in rows) + "\n\n")
    table = read_table(path, COLUMNS)
    np.testing.assert_array_equal(table.numbers("x", "y"), [[1.5, -2000], [3, 4]])
    np.testing.assert_array_equal(table.numbers("h"), [7, 8])
    assert table.texts("name") == ["a", "b"] and list(table.lines) == [3, 4]
    if mark != " ":
        path.write_text(mark.join("xyh") + "\n" + mark.join(["1", "2", ""]) + "\n")
        assert np.isnan(read_table(path, COLUMNS).numbers("h", empty=True)).all()
    table = read_table(path, COLUMNS)
    assert table.labels("z", "line {line}") == [f"line {n}" for n in table.lines]

"""Tables and layers of ground points; faults 2, 17, 18 and 20 with the line that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from photoplan.errors import InputError
from photoplan.io.points import read_ground_points, write_ground_points
from photoplan.io.vector_layer import write_features

HEAD = "name,x,y,z,sigma_xy,sigma_z,role\n"
TABLE = HEAD + "A,1000.5,2000.25,300,0.02,0.03,control\nB,1,2,,,,\nC,,,5,,0.1,check\n"
NAN = np.nan


def write(folder: Path, content: str | bytes, name: str = "control.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("start", ["", "\ufeff", "# surveyed 1998\n"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_full_height_and_horizontal_control(tmp_path: Path, delimiter: str, start: str, end: str) -> None:
    points = read_ground_points(write(tmp_path, start + TABLE.replace(",", delimiter).replace("\n", end)))
    assert points.names == ("A", "B", "C")
    np.testing.assert_array_equal(points.XYZ, [[1000.5, 2000.25, 300], [1, 2, NAN], [NAN, NAN, 5]])
    np.testing.assert_array_equal(points.sigma, [[0.02, 0.02, 0.03], [NAN, NAN, NAN], [NAN, NAN, 0.1]])
    np.testing.assert_array_equal(points.check, [False, False, True])


def test_one_sigma_each_axis_or_all(tmp_path: Path) -> None:
    points = read_ground_points(write(tmp_path, "name x y z sigma sigma_z\nA 1 2 3 0.5 0.1\nB 1 2 3 0 0\n"))
    np.testing.assert_array_equal(points.sigma, [[0.5, 0.5, 0.1], [0, 0, 0]])


def test_the_mapping_agencys_control_needs_its_columns_declared(shared: Path) -> None:
    path = shared / "data" / "ign_borea" / "GCP_test.app"
    with pytest.raises(InputError, match=r"GCP_test\.app:1: .* is no header; what the 5 columns mean is not guessed"):
        read_ground_points(path)
    points = read_ground_points(path, columns="name,-,x,y,z")
    assert points.names == ("1003", "1005", "1006")
    np.testing.assert_array_equal(points.XYZ[1], [833670.94, 6281965.4, 52.63])
    assert np.isnan(points.sigma).all()


def test_decimal_comma_as_declared(tmp_path: Path) -> None:
    text = "name x y z\nA 1,5 2,5 3,5\n"
    with pytest.raises(InputError, match=r":2: x = '1,5' is not a number; write decimals with a point"):
        read_ground_points(write(tmp_path, text))
    points = read_ground_points(write(tmp_path, text), decimal_comma=True)
    np.testing.assert_array_equal(points.XYZ, [[1.5, 2.5, 3.5]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TABLE.replace("300", "NaN"), r"control\.csv:2: z = 'NaN' is not a number; leave the field empty"),
        (TABLE.replace("1000.5", "-"), r":2: x = '-' is not a number"),
        (TABLE.replace("B,1,2", "B,1,"), r":3: ground point 'B' has X alone"),
        (TABLE.replace("C,,,5", "C,,,"), r":4: ground point 'C' has nothing alone"),
        (TABLE.replace("0.02", "-0.02"), r":2: standard deviation of ground point 'A' is -0.02 m"),
        (TABLE.replace("check", "Passpunkt"), r":4: role 'Passpunkt' of ground point 'C'; allowed are control and"),
        (TABLE.replace("B,", "A,"), r":3: ground point 'A' is given twice"),
        (TABLE.replace("B,1,2,,,,", "B,1,2,3"), r":3: 4 columns, the first line has 7"),
        (HEAD, "holds a header and no line with data"),
        ("A,1,2,3\n", r":1: 'A 1 2 3' is no header"),
        ("name,x,y\nA,1,2\n", r":1: .* has fewer than 4 columns"),
        ("name,x,y,zz\nA,1,2,3\n", r":1: header name, x, y, zz: z \(no column called z or"),
    ],
)
def test_fault_18_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_ground_points(write(tmp_path, text))


def test_layers(tmp_path: Path) -> None:
    path = tmp_path / "control.gpkg"
    columns = {
        "name": np.array(["A", "B"], object),
        "sigma": np.array([0.02, np.nan]),
        "role": np.array(["control", "check"], object),
    }
    shapes = [shapely.Point(1, 2, 3), shapely.Point(4, 5, 6)]
    write_features(path, "Point Z", shapes, columns, "EPSG:25832", "control")
    points = read_ground_points(path, crs="EPSG:25832")
    assert points.names == ("A", "B")
    np.testing.assert_array_equal(points.XYZ, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(points.sigma, [[0.02] * 3, [NAN] * 3])
    np.testing.assert_array_equal(points.check, [False, True])
    with pytest.raises(InputError, match=r"ground points in EPSG:25832, the project is in EPSG:25833"):
        read_ground_points(path, crs="EPSG:25833")
    flat = tmp_path / "flat.gpkg"
    write_features(flat, "Point", [shapely.Point(1, 2)], {"name": np.array(["A"], object)}, "EPSG:25832", "c")
    np.testing.assert_array_equal(read_ground_points(flat).XYZ, [[1, 2, NAN]])
    lines = tmp_path / "lines.gpkg"
    shape = shapely.LineString([(0, 0), (1, 1)])
    write_features(lines, "LineString", [shape], {"name": np.array(["A"], object)}, "EPSG:25832", "c")
    with pytest.raises(InputError, match="feature 1 is a LineString; ground points are single points"):
        read_ground_points(lines)
    with pytest.raises(InputError, match="cannot be read"):
        read_ground_points(write(tmp_path, "no layer", "no.gpkg"))


def test_crs_beside_a_table(tmp_path: Path) -> None:
    path = write(tmp_path, TABLE)
    (tmp_path / "control.prj").write_text("EPSG:25832")
    assert len(read_ground_points(path, crs="EPSG:25832")) == 3
    with pytest.raises(InputError, match=r"control\.csv: ground points in EPSG:25832, the project is in EPSG:2154"):
        read_ground_points(path, crs="EPSG:2154")


def test_written_and_read_again(tmp_path: Path) -> None:
    points = read_ground_points(write(tmp_path, TABLE))
    write_ground_points(tmp_path / "out.csv", points)
    again = read_ground_points(tmp_path / "out.csv")
    assert again.names == points.names
    for field in ("XYZ", "sigma", "check"):
        np.testing.assert_array_equal(getattr(again, field), getattr(points, field))

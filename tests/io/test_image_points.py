"""Tables of image points; faults 11, 17 and 18 with the line that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError, UsageError
from photoplan.io.points import named_as, read_image_points, write_image_points

TABLE = "point,image,x,y\nA,p1.tif,10.5,20.25\nA,p2.tif,11,21\nB,p1.tif,-0.5,3e2\n"


def write(folder: Path, content: str | bytes, name: str = "points.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        TABLE,
        TABLE.replace(",", ";"),
        TABLE.replace(",", "\t"),
        TABLE.replace(",", "   "),
        TABLE.replace("\n", "\r\n"),
        "\ufeff" + TABLE,
        "# a remark\n\n" + TABLE,
        "# " + TABLE,
        TABLE.split("\n", 1)[1],  # no header: the order is known
        TABLE.replace("x,y", "Column,Row").replace("point", "Point"),
        "image,id,point,y,x\np1.tif,1,A,20.25,10.5\np2.tif,2,A,21,11\np1.tif,3,B,3e2,-0.5\n",
        '"point" "image" x y\n"A" "p1.tif" 10.5 20.25\n"A" "p2.tif" 11 21\n"B" "p1.tif" -0.5 3e2\n',
        "'point','image','x','y'\n'A','p1.tif','10.5','20.25'\n'A','p2.tif',11,21\n'B','p1.tif',-0.5,3e2\n",
    ],
)
def test_layouts_give_one_table(tmp_path: Path, text: str) -> None:
    points = read_image_points(write(tmp_path, text))
    assert (points.images, points.points) == (("p1.tif", "p2.tif"), ("A", "B"))
    np.testing.assert_array_equal(points.image, [0, 1, 0])
    np.testing.assert_array_equal(points.point, [0, 0, 1])
    np.testing.assert_array_equal(points.xy, [[10.5, 20.25], [11, 21], [-0.5, 300]])
    assert np.isnan(points.sigma).all()


def test_quotes_hold_a_delimiter_together_and_apostrophes_are_letters(tmp_path: Path) -> None:
    points = read_image_points(write(tmp_path, "point,image,x,y\n'A, north',p1.tif,1,2\nO'Hara,p1.tif,3,4\n"))
    assert points.points == ("A, north", "O'Hara")


def test_declared_columns_and_decimal_comma(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"points\.csv:1: 'p1 A 9 1 10.5 20.25 7' is no header; .* is not guessed"):
        read_image_points(write(tmp_path, "p1 A 9 1 10.5 20.25 7\n"))
    path = write(tmp_path, "p1;A;9;10,5;20,25\n")
    points = read_image_points(path, columns="image,point,-,x,y", decimal_comma=True)
    np.testing.assert_array_equal(points.xy, [[10.5, 20.25]])
    with pytest.raises(UsageError, match="missing y"):
        read_image_points(path, columns="image,point,-,x")
    with pytest.raises(InputError, match=r":1: 5 columns, 4 are declared"):
        read_image_points(path, columns="image,point,x,y")


def test_standard_deviations(tmp_path: Path) -> None:
    one = read_image_points(write(tmp_path, "A p1 1 2 0.5\nA p2 1 2 0.25\n"))
    np.testing.assert_array_equal(one.sigma, [[0.5, 0.5], [0.25, 0.25]])
    two = read_image_points(write(tmp_path, "point,image,x,y,sigma_x,sigma_y\nA,p1,1,2,0.5,0.1\nA,p2,1,2,,\n"))
    np.testing.assert_array_equal(two.sigma, [[0.5, 0.1], [np.nan, np.nan]])
    with pytest.raises(InputError, match=r"points\.csv:2: standard deviation .* must be positive"):
        read_image_points(write(tmp_path, "A p1 1 2 0.5\nA p2 1 2 0\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TABLE.replace("10.5", "nan"), r"points\.csv:2: x = 'nan' is not a number; give it or delete"),
        (TABLE.replace("10.5", "inf"), r":2: x = 'inf' is not a number"),
        (TABLE.replace("10.5", "1e999"), r":2: x = '1e999' is not a number"),
        (TABLE.replace("10.5", ""), r":2: x = '' is not a number; give it"),
        (TABLE.replace("20.25", "12O"), r":2: y = '12O' is not a number"),
        (TABLE.replace("10.5", "10,5"), r":2: 5 columns, the first line has 4; is the decimal sign a comma"),
        (TABLE.replace(",", ";").replace("10.5", "10,5"), r":2: x = '10,5' is not a number; write decimals with a po"),
        (TABLE.replace(",21", ""), r":3: 3 columns, the first line has 4"),
        (TABLE + "A,p1,1,1\n", r":5: point 'A' is measured in image 'p1' in line 2 already"),
        (TABLE.split("\n", maxsplit=1)[0], "holds a header and no line with data"),
        ("", "holds no line with data"),
        ("A,p1,1\n", r":1: 'A,p1,1' has fewer than 4 columns"),
        ("name,foto,x,y\nA,p1,1,2\n", r":1: header name, foto, x, y: image \(no column called image or photo"),
        ("point,image,x,x,y\nA,p1,1,2,3\n", r":1: .*x \(2 columns called x or"),
        (TABLE.replace("A,p2", ",p2"), r":3: point is ''; a name"),
        (b"point,image,x,y\nA,p1,1,2\nB\xe4,p1,1,2\n", r"points\.csv:3: not UTF-8"),
        (b"point,image,x,y\nA,p1,1,2\nB\x00,p1,1,2\n", r"points\.csv:3: holds a zero byte"),
    ],
)
def test_fault_18_is_named_with_its_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_image_points(write(tmp_path, text))


def test_fault_11_names_of_images_are_names_only(tmp_path: Path) -> None:
    """Folders and suffixes do not make another image; what leads out of a folder is only a name."""
    table = "A ../../etc/p1.tif 1 2\nB p1.JPG 3 4\nA C:\\scans\\p2.tif 5 6\n"
    points = read_image_points(write(tmp_path, table))
    assert points.images == ("../../etc/p1.tif", "C:\\scans\\p2.tif")
    np.testing.assert_array_equal(points.image, [0, 0, 1])
    named, unknown = named_as(points, ["p2.jp2", "p1", "p3"])
    assert named.images == ("p1", "p2.jp2")
    assert unknown == ()
    _, unknown = named_as(points, ["p2"])
    assert unknown == ("../../etc/p1.tif",)


def test_written_and_read_again(tmp_path: Path) -> None:
    points = read_image_points(write(tmp_path, "A p1 1.23456789 2 0.5\nB p1 3 1e-3 0.25\nA p2 26459.5 4 1\n"))
    write_image_points(tmp_path / "new" / "out.csv", points)
    again = read_image_points(tmp_path / "new" / "out.csv")
    assert (again.images, again.points) == (points.images, points.points)
    for field in ("image", "point", "xy", "sigma"):
        np.testing.assert_array_equal(getattr(again, field), getattr(points, field))


def test_the_mapping_agencys_measurements(shared: Path) -> None:
    folder = shared / "data" / "ign_borea"
    ties = read_image_points(folder / "all_liaisons2.mes")
    assert (len(ties), len(ties.images), len(ties.points)) == (14_491, 68, 3_089)
    control = read_image_points(folder / "all_terrains2.mes")
    assert control.points == ("1003", "1005")
    assert len(control) == 20

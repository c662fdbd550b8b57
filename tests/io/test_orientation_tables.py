"""Orientation tables: declared columns, units, orders; faults 11 and 18 with the line that is wrong."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photoplan.errors import InputError, UsageError
from photoplan.geometry.pose import ROTATION_ORDERS, angles_from_rotation, rotation_opk
from photoplan.io.formats import read_orientation
from photoplan.io.orientation.block import OrientationTable, OrientedImage, TableFormat

HEAD = "filename,x,y,z,omega,phi,kappa\n"
ROWS = "a.jpg,576661.8239,5188164.7692,207.2298,1.074164,-3.800570,-42.559458\nb.jpg,1,2,3,0.5,0.25,180\n"


def write(folder: Path, content: str | bytes, name: str = "ext.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_the_drone_blocks_table(block: Path) -> None:
    table = read_orientation(block / "ext.csv")
    assert len(table.images) == 18
    first = table.images[0]
    assert first == OrientedImage(
        "DJI_0018.jpg", (576661.8239, 5188164.7692, 207.2298), (1.074164, -3.800570, -42.559458), None, 2
    )
    assert table.crs == "EPSG:32615"
    assert table.height_system is None
    np.testing.assert_allclose(table.rotations[0], rotation_opk(*np.radians(first.angles)), atol=1e-15)
    # Numbers that are as the project states them are not touched.
    assert tuple(table.opk_degrees()[0]) == first.angles


def test_real_tables_of_other_layouts(shared: Path) -> None:
    data = shared / "data"
    with_header = read_orientation(data / "ngi_dmc" / "eo" / "ngi_xyz_opk.csv")
    assert with_header.crs is not None
    assert "+proj=tmerc" in with_header.crs
    bare = data / "ngi_dmc" / "eo" / "camera_pos_ori.txt"
    with pytest.raises(InputError, match=r"camera_pos_ori\.txt:1: no header; declare the columns"):
        read_orientation(bare)
    table = read_orientation(bare, TableFormat(columns="name,x,y,z,omega,phi,kappa"))
    np.testing.assert_allclose(table.centers, with_header.centers, atol=5e-4)
    np.testing.assert_allclose(table.opk_degrees(), with_header.opk_degrees(), atol=5e-4)
    assert [i.name for i in table.images] == [i.name for i in with_header.images]
    ign = read_orientation(data / "ign_borea" / "23FD1305_alt_2.OPK")
    assert len(ign.images) == 805
    assert ign.images[0].camera == "UCE-M3-f120-s06"
    assert ign.images[0].center == (833143.850, 6298117.693, 1769.986)


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", "   ", ", "])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_fault_18_delimiters_line_ends_and_marks(tmp_path: Path, delimiter: str, end: str, mark: bytes) -> None:
    text = (HEAD + ROWS).replace(",", delimiter).replace("\n", end)
    table = read_orientation(write(tmp_path, mark + text.encode()))
    assert [i.name for i in table.images] == ["a.jpg", "b.jpg"]
    assert table.images[1].center == (1.0, 2.0, 3.0)
    assert table.images[1].line == 3


def test_fault_18_decimal_comma_is_read_when_declared_and_hinted_at_when_not(tmp_path: Path) -> None:
    text = "name;x;y;z;omega;phi;kappa\na;1,5;2,25;3;0,5;-0,5;100\n"
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=r"ext\.csv:2: x = '1,5' is not a number; .*`decimal_comma`"):
        read_orientation(path)
    assert read_orientation(path, TableFormat(decimal_comma=True)).images[0].center == (1.5, 2.25, 3.0)
    with pytest.raises(UsageError, match="both delimiter and decimal sign"):
        TableFormat(delimiter=",", decimal_comma=True)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (HEAD, "a header and no image"),
        ("", "no line with data"),
        ("\n\n# only a comment\n", "no line with data"),
        (HEAD + ROWS + "c.jpg,1,2,3,4,5\n", ":4: 6 columns, the first line has 7"),
        (HEAD + ROWS + "c.jpg,1,2,3,4,5,6,7\n", ":4: 8 columns"),
        (HEAD + "a.jpg,NaN,2,3,4,5,6\n", ":2: x = 'NaN' is not a number; give it or delete the line"),
        (HEAD + "a.jpg,1,2,inf,4,5,6\n", ":2: z = 'inf'"),
        (HEAD + "a.jpg,1,2,3,,5,6\n", ":2: omega = '' is not a number"),
        (HEAD + "a.jpg,1,2,1e999,4,5,6\n", ":2: z = '1e999'"),
        (HEAD + "a.jpg,1_0,2,3,4,5,6\n", ":2: x = '1_0'"),
        (HEAD + "a.jpg,１,2,3,4,5,6\n", ":2: x = '１'"),
        (HEAD + "a.jpg,0x10,2,3,4,5,6\n", ":2: x = '0x10'"),
        (HEAD + ",1,2,3,4,5,6\n", ":2: the image has no name"),
        (HEAD + ROWS + "a.jpg,1,2,3,4,5,6\n", r"'a\.jpg' is given twice \(lines 2 and 4\)"),
        (HEAD + "a.jpg,1,2,3,4,5,361\n", ":2: image 'a.jpg': angle kappa = 361 is more than a full circle in deg"),
        (HEAD + '"a.jpg,1,2,3,4,5,6\n', ":2: cannot be split"),
        (HEAD + '"a.jpg" x,1,2,3,4,5,6\n', ":2: cannot be split"),
        ("a.jpg,1,2,3,4,5,6\n" + ROWS, ":1: no header; declare the columns"),
        ("name,x,y,omega,phi,kappa,q\n" + ROWS, r":1: header .* z \(no column called"),
        ("name,x,y,z,alt,omega,phi,kappa\n", r"z \(2 columns called"),
        ("name,latitude,longitude,altitude,omega,phi,kappa\n", "positions are geographic"),
        ("name,x,y,z,roll,pitch,yaw\n", "roll, pitch and yaw are angles of the aircraft"),
        ("one,two\n1,2\n", "fewer than 7 columns"),
        (b"filename,x,y,z,omega,phi,kappa\n\xe4.jpg,1,2,3,4,5,6\n", ":2: not UTF-8"),
        (b"\x00\x01\x02", "zero byte"),
    ],
)
def test_fault_18_broken_tables_name_the_line(tmp_path: Path, content: str | bytes, says: str) -> None:
    path = write(tmp_path, content)
    with pytest.raises(InputError, match=says) as error:
        read_orientation(path)
    assert "ext.csv" in str(error.value)


def test_columns_by_name_by_order_and_as_comment(tmp_path: Path) -> None:
    body = "x7 10.0 1 2 3 0.1 0.2 0.3\n"
    by_order = TableFormat(columns="name,-,x,y,z,omega,phi,kappa")
    bare = read_orientation(write(tmp_path, body), by_order)
    assert bare.images[0].center == (1.0, 2.0, 3.0)
    headed = read_orientation(write(tmp_path, "Bild Zeit Rechts Hoch H om ph ka\n" + body), by_order)
    assert headed.images == (OrientedImage("x7", (1, 2, 3), (0.1, 0.2, 0.3), None, 2),)
    assert headed.notes == ("ext.csv: line 1 was taken as a header",)
    by_name = TableFormat(columns="name=Bild,x=Rechts,y=Hoch,z=H,omega=om,phi=ph,kappa=ka")
    assert read_orientation(tmp_path / "ext.csv", by_name).images == headed.images
    commented = write(tmp_path, "#name X Y Z OMEGA PHI KAPPA\n# more\nx7 1 2 3 0.1 0.2 0.3\n")
    assert read_orientation(commented).images[0].angles == (0.1, 0.2, 0.3)


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ("name,x,y,z,omega,phi", "missing kappa"),
        ("name,x,y,z,omega,phi,kapa", "unknown kapa"),
        ("name,x,y,z,omega,phi,kappa,x", "repeated"),
        ("name,x,y,z,omega,phi,kappa", ":2: 8 columns, 7 are declared"),
        ("name=a,x=b", "missing y"),
        ("name=n,x=b,y=c,z=d,omega=e,phi=f,kappa=g", "no column called g"),
    ],
)
def test_wrong_declarations_of_columns(tmp_path: Path, columns: str, says: str) -> None:
    path = write(tmp_path, "\nn b c d e f k l\n")
    kind = UsageError if says.startswith(("missing", "unknown", "repeated")) else InputError
    with pytest.raises(kind, match=says):
        read_orientation(path, TableFormat(columns=columns))


@pytest.mark.parametrize("unit", ["deg", "gon", "rad"])
@pytest.mark.parametrize("direction", ["camera-to-ground", "ground-to-camera"])
@pytest.mark.parametrize("order", ROTATION_ORDERS)
def test_every_declaration_gives_the_same_rotation(tmp_path: Path, unit: str, direction: Any, order: str) -> None:
    opk = np.array([[3.0, -2.0, 110.0], [-0.5, 41.0, -170.0]])
    R = np.stack([rotation_opk(*a) for a in np.radians(opk)])
    factor = {"deg": 180 / np.pi, "gon": 200 / np.pi, "rad": 1.0}[unit]
    lines = [HEAD]
    for k, matrix in enumerate(R):
        angles = angles_from_rotation(matrix if direction == "camera-to-ground" else matrix.T, order) * factor
        named = dict(zip(order, angles))
        lines.append(f"i{k},1,2,3,{float(named['o'])!r},{float(named['p'])!r},{float(named['k'])!r}\n")
    form = TableFormat(angle_unit=unit, rotation=order, direction=direction)
    table = read_orientation(write(tmp_path, "".join(lines)), form)
    np.testing.assert_allclose(table.rotations, R, atol=1e-12)
    np.testing.assert_allclose(table.opk_degrees(), opk, atol=1e-10)


def test_orders_and_directions_are_told_apart() -> None:
    images = (OrientedImage("a", (0, 0, 0), (10.0, 20.0, 30.0)),)
    made = [
        OrientationTable(Path("x"), images, "deg", order, direction).rotations[0]
        for order, direction in itertools.product(ROTATION_ORDERS, ("camera-to-ground", "ground-to-camera"))
    ]
    assert all(np.abs(a - b).max() > 1e-3 for a, b in itertools.combinations(made, 2))


@pytest.mark.parametrize(
    "wrong", [{"angle_unit": "grad"}, {"rotation": "xyz"}, {"direction": "down"}, {"delimiter": "|"}]
)
def test_unknown_declarations_list_what_is_allowed(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="must be one of"):
        TableFormat(**wrong)


def test_the_prj_beside_the_table(tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + ROWS)
    assert read_orientation(path).crs is None
    for text, crs, heights in [
        ("EPSG:32615", "EPSG:32615", None),
        ("EPSG:32615+5703\n", "EPSG:32615", "EPSG:5703"),
        ("+proj=utm +zone=15 +datum=WGS84", "+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs", None),
    ]:
        write(tmp_path, text, "ext.prj")
        table = read_orientation(path)
        assert (table.crs, table.height_system) == (crs, heights)
        assert table.crs_file == tmp_path / "ext.prj"
    write(tmp_path, "no crs", "ext.prj")
    with pytest.raises(InputError, match=r"ext\.prj: 'no crs'"):
        read_orientation(path)


def test_own_toml(tmp_path: Path) -> None:
    text = """
crs = "EPSG:25832+7837"
[orientation]
angle_unit = "gon"
rotation = "pok"

[[images]]
name = "4711"
center = [512345.21, 5274112.87, 2630.44]
angles = [0.2, -0.4, 100]
fiducials = { a = [1, 2], b = [3.5, 4] }
"""
    table = read_orientation(write(tmp_path, text, "o.toml"))
    assert (table.crs, table.height_system) == ("EPSG:25832", "EPSG:7837")
    assert table.images[0].fiducials == {"a": (1.0, 2.0), "b": (3.5, 4.0)}
    expected = angles_from_rotation(table.rotations[0], "pok") * 200 / np.pi
    np.testing.assert_allclose(expected, [0.2, -0.4, 100], atol=1e-12)
    with pytest.raises(InputError, match=r"o\.toml:10: images\[1\]\.angles\[3\]"):
        read_orientation(write(tmp_path, text.replace("100]", "nan]"), "o.toml"))
    with pytest.raises(InputError, match="images: is missing"):
        read_orientation(write(tmp_path, 'crs = "EPSG:25832"', "o.toml"))


def test_fault_11_names_of_a_table_are_kept_as_they_are(tmp_path: Path) -> None:
    names = ["../../etc/passwd", "/abs/x.tif", "CON", "日本.tif", "x" * 500]
    body = "".join(f"{n},1,2,3,4,5,6\n" for n in names)
    assert [i.name for i in read_orientation(write(tmp_path, HEAD + body)).images] == names

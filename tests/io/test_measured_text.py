"""Measured terrain from text files: columns, codes, lines, and faults named with their line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError, UsageError
from photoplan.io.tables import Dialect
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.options import CodeClass, CodeTable, ReadOptions, read_code_table
from photoplan.surfaces.units import MeasuredTerrain

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def make(content: str | bytes, name: str = "p.csv") -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return make


def table(**codes: str) -> CodeTable:
    return CodeTable({code: CodeClass(kind) for code, kind in codes.items()})


def xyz(measured: MeasuredTerrain) -> list[list[float]]:
    return np.concatenate([g.xyz for g in measured.points]).tolist()


THREE = [[1.5, 2.25, 3.0], [4.0, 5.0, -6.5], [7.0, 8.0, 9.0]]


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("1.5 2.25 3\n4 5 -6.5\n7 8 9\n", ReadOptions()),
        ("  1.5\t 2.25   3\n4 5 -6.5\n7 8 9", ReadOptions()),
        ("1.5,2.25,3\n4,5,-6.5\n7,8,9e0\n", ReadOptions()),
        ("1.5;2.25;3\r\n4;5;-6.5\r\n7;8;9\r\n", ReadOptions()),
        ("1.5\t2.25\t3\r4\t5\t-6.5\r7\t8\t9", ReadOptions()),
        ("\ufeffX,Y,Z\n1.5,2.25,3\n\n# remark\n4,5,-6.5\n7,8,9\n", ReadOptions()),
        ("# x y z\n1.5 2.25 3\n4 5 -6.5\n7 8 9\n", ReadOptions()),
        ("1,5;2,25;3\n4;5;-6,5\n7;8;9\n", ReadOptions(dialect=Dialect(decimal_comma=True))),
        ("1,5 2,25 3\n4 5 -6,5\n7 8 9\n", ReadOptions(dialect=Dialect(decimal_comma=True))),
        ("nr;hoch;rechts;z;art\n1;2,25;1,5;3;g,h\n2;5;4;-6,5;g\n3;8;7;9;g\n", "names"),
        ("a 2.25 1.5 99 3\nb 5 4 99 -6.5\nc 8 7 99 9\n", ReadOptions(dialect=Dialect(columns="name,y,x,-,z"))),
        ("height,east,north\n3,1.5,2.25\n-6.5,4,5\n9,7,8\n", ReadOptions()),
        ('"1.5","2.25","3"\n"4","5","-6.5"\n7,8,9\n', ReadOptions()),
    ],
)
def test_fault_18_points_are_read_however_they_are_written(write: Write, text: str, options: ReadOptions | str) -> None:
    if isinstance(options, str):
        options = ReadOptions(dialect=Dialect(columns="x=rechts,y=hoch,z=z,code=art", decimal_comma=True))
    assert xyz(read_measured([write(text)], options)) == THREE


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 nan 6\n", r"p\.csv:2: y = 'nan' is not a number; give it"),
        ("1 2 3\n\n4 5 inf\n", r"p\.csv:3: z = 'inf'"),
        ("1 2 3\n4 5\n", r"p\.csv:2: 2 columns, the first line has 3"),
        ("1,2,3\n4,5,6\n7,8,9,1\n", r"p\.csv:3: 4 columns.*decimal sign"),
        ("x,y,z\n1,2,3\n4,,6\n", r"p\.csv:3: y = '' is not a number"),
        ("x,y,z\n", "only a header"),
        ("# nothing\n\n", "no line with data"),
        ("1,5 2,5 3,5\n1,5 2,5 3,5\n", r"p\.csv:1: .*decimal commas"),
        ("1;2;3\n4;5;6,5\n", r"p\.csv:2: z = '6,5'.*`decimal_comma`"),
        ("a b c\n1 2 3\n", "neither a record nor a header"),
        ("1 2\n3 4\n", "fewer than 3 columns"),
        (
            "1 2 3 code 0.1 n l 4 5\n1 2 3 code 0.1 n l 4 5\n",
            "what the 9 columns mean is not guessed",
        ),
        ("x y z sigma\n1 2 3 0.1\n1 2 3 -1\n", r"p\.csv:3: sigma = '-1'"),
        (b"x,y,z\n1,2,3\n1,2,\xff\n", r"p\.csv:3: not UTF-8"),
        (b"\xff\xfe1\x00 \x002\x00", "UTF-16"),
        (b"1 2 3\n4 5 6 \x00\n", "not a format of measured terrain"),
        ("x,y,z\n1,2,-9999\n4,5,6\n", "nodata"),
        ("x,y,z\n1,2,30000\n4,5,6\n", "record 2.*height 30000"),
        ("x,x,y,z\n1,1,2,3\n", "2 columns called x"),
        ("7 2.5 3.5 9.5\n8 2.6 3.6 9.6\n9 2.7 3.7 9.7\n", r"p\.csv:1: the first column counts"),
    ],
)
def test_fault_18_what_cannot_be_read_is_named_with_its_line(write: Write, text: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_measured([write(text)])


def test_fault_18_a_bad_line_far_inside_a_large_file_is_named(write: Write) -> None:
    rows = [f"{i}.5 {i} 1.25" for i in range(500_000)]
    rows[444_443] = "7 8 oops"
    with pytest.raises(InputError, match=r"p\.csv:444444: z = 'oops'"):
        read_measured([write("\n".join(rows))])


def test_numbers_keep_all_their_digits(write: Write) -> None:
    rng = np.random.default_rng(8)
    table = np.column_stack([rng.uniform(2e7, 2.1e7, 500), rng.normal(0, 1e-5, 500), rng.uniform(-1e3, 8e3, 500)])
    text = "\n".join(" ".join(map(repr, row)) for row in table.tolist())
    for options in (ReadOptions(), ReadOptions(dialect=Dialect(decimal_comma=True))):
        written = text.replace(".", ",") if options.dialect.decimal_comma else text
        np.testing.assert_array_equal(read_measured([write(written)], options).points[0].xyz, table)


def test_records_are_lines_of_the_file_across_blocks(write: Write) -> None:
    rows = [f"{i} 0 0" if i % 7 else f"{i} 0 0\n" for i in range(900_000)]
    (group,) = read_measured([write("# head\n" + "\n".join(rows))]).points
    lines = np.cumsum([1 + (i % 7 == 0) for i in range(900_000)]) + 1 - np.array([i % 7 == 0 for i in range(900_000)])
    np.testing.assert_array_equal(group.records, lines)
    np.testing.assert_array_equal(group.xyz[:, 0], np.arange(900_000))


def test_codes_part_points_into_groups_with_their_own_sigma(write: Write) -> None:
    path = write("x,y,z,code\n1,1,1,G\n2,2,2,S\n3,3,3,G\n4,4,4,TREE\n")
    codes = CodeTable({"G": CodeClass("mass"), "S": CodeClass("spot", 0.02), "TREE": CodeClass("ignore")})
    measured = read_measured([path], ReadOptions(codes=codes))
    assert [(g.name, g.kind, g.sigma, g.records.tolist()) for g in measured.points] == [
        ("p.csv G", "mass", None, [2, 4]),
        ("p.csv S", "spot", 0.02, [3]),
    ]
    assert any("1 points left out" in note for note in measured.notes)
    with pytest.raises(InputError, match=r"p\.csv:5: code 'TREE' is not in the table"):
        read_measured([path], ReadOptions(codes=table(G="mass", S="spot")))
    assert read_measured([path], ReadOptions(codes=table(G="spot", **{"*": "mass"}))).count == 4


def test_a_column_of_sigma_parts_points(write: Write) -> None:
    measured = read_measured([write("x y z sigma\n1 1 1 0.1\n2 2 2 0.2\n3 3 3 0.1\n4 4 4 -\n")])
    assert [(g.sigma, len(g.xyz)) for g in measured.points] == [(0.1, 2), (0.2, 1), (None, 1)]
    rng = np.random.default_rng(1)
    rows = "".join(f"{i} 0 0 {s:.6f}\n" for i, s in enumerate(rng.uniform(0.05, 0.5, 5000)))
    many = read_measured([write("x y z sigma\n" + rows)])
    assert len(many.points) <= 100 and many.count == 5000


def test_lines_are_consecutive_records_of_one_id(write: Write) -> None:
    text = "x,y,z,code,line\n0,0,1,B,1\n1,0,1,B,1\n2,0,1,B,2\n2,1,1,B,2\n2,2,1,B,2\n5,5,5,,\n"
    text += "9,9,9,B,3\n0,0,1,B,1\n1,1,1,B,1\n"
    measured = read_measured([write(text)], ReadOptions(codes=table(B="formline")))
    assert [(x.name, x.kind, len(x.xyz), x.code) for x in measured.lines] == [
        ("p.csv:2 B 1", "formline", 2, "B"),
        ("p.csv:4 B 2", "formline", 3, "B"),
        ("p.csv:9 B 1", "formline", 2, "B"),
    ]
    assert sorted(xyz(measured)) == [[5.0, 5.0, 5.0], [9.0, 9.0, 9.0]]
    assert any("line 8 of the file" in note for note in measured.notes)


def test_lines_without_id_end_at_an_empty_line_or_another_code(write: Write) -> None:
    text = "x y z code\n0 0 1 breakline\n1 0 1 breakline\n\n2 0 1 breakline\n3 0 1 breakline\n"
    text += "0 5 1 formline\n1 5 1 formline\n"
    measured = read_measured([write(text)])
    assert [(x.kind, len(x.xyz)) for x in measured.lines] == [("breakline", 2), ("breakline", 2), ("formline", 2)]


def test_a_second_height_makes_a_wall(write: Write) -> None:
    text = "x,y,z,code,line,z_right\n0,0,5,W,1,\n1,0,5,W,1,3\n2,0,5,W,1,2\n0,9,1,K,2,\n1,9,1,K,2,\n"
    measured = read_measured([write(text)], ReadOptions(codes=table(W="breakline", K="breakline")))
    wall, curb = measured.lines
    assert wall.right is not None and wall.right.tolist() == [5, 3, 2]
    assert curb.right is None


def test_borders_need_no_heights(write: Write) -> None:
    text = "x,y,z,code,line\n0,0,,border,1\n9,0,,border,1\n9,9,nan,border,1\n0,0,,border,1\n1,1,1,,\n"
    (border,) = read_measured([write(text)]).lines
    assert border.kind == "border" and np.isnan(border.xyz[:, 2]).all()
    with pytest.raises(InputError, match=r"p\.csv:2: z = ''"):
        read_measured([write(text.replace("border", "breakline"))])


def test_a_prj_file_states_crs_and_heights(write: Write) -> None:
    path = write("21500000 6700000 3\n")
    write("EPSG:3875+3900", "p.prj")
    measured = read_measured([path])
    assert (measured.crs, measured.height_system) == ("EPSG:3875", "EPSG:3900")


def test_nodata_heights_are_left_out_where_declared(write: Write) -> None:
    measured = read_measured([write("1 2 3\n4 5 -9999\n")], ReadOptions(nodata=-9999))
    assert measured.count == 1 and "1 points of height -9999" in measured.notes[-1]


def test_code_tables_from_toml_and_csv_say_the_same(write: Write) -> None:
    toml = write('[codes]\n121 = "breakline"\nD4 = { kind = "spot", sigma = 0.05 }\n"*" = "mass"\n', "codes.toml")
    text = write("code;kind;sigma\n121;break lines;\nD4;spot;0,05\n*;mass;\n", "codes.csv")
    for path in (toml, text):
        codes = read_code_table(path)
        assert codes.find("121") == CodeClass("breakline")
        assert codes.find("D4") == CodeClass("spot", 0.05)
        assert codes.find("anything") == CodeClass("mass")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.toml", '121 = "edge"', "code '121': class 'edge'; allowed are mass"),
        ("c.toml", "121 = 5", "code '121': 5; write"),
        ("c.toml", '1 = { kind = "spot", sigma = -1 }', "sigma -1"),
        ("c.csv", "121,breakline\n121,spot\n", r"c\.csv:2: code '121' is given twice"),
        ("c.csv", "121,breakline,wide\n", r"c\.csv:1: sigma 'wide'"),
        ("c.csv", "121\n", r"c\.csv:1: '121' has fewer than 2 columns"),
        ("c.csv", "# nothing\n", "holds no line with data"),
    ],
)
def test_bad_code_tables_are_named_with_line_or_code(write: Write, name: str, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_code_table(write(text, name))


def test_options_that_cannot_be_meant_are_refused() -> None:
    with pytest.raises(UsageError):
        ReadOptions(dialect=Dialect(delimiter=",", decimal_comma=True))
    with pytest.raises(UsageError):
        read_measured([])


def test_codes_that_no_column_holds_are_an_error_that_lists_the_columns(write: Write) -> None:
    codes = CodeTable({"121": CodeClass("breakline"), "G": CodeClass("spot")}, Path("codes.toml"))
    path = write("x,y,z,Description,Remark\n1,2,3,121,a\n4,5,6,121,b\n7,8,9,G,c\n")
    with pytest.raises(
        InputError, match=r"'Description' holds codes of the table .121, G.*x, y, z, Description, Remark"
    ):
        read_measured([path], ReadOptions(codes=codes))
    named = ReadOptions(Dialect("x=x,y=y,z=z,code=Description"), codes)
    assert [line.kind for line in read_measured([path], named).lines] == ["breakline"]
    assert read_measured([path]).notes == (f"{path.name}: columns not used: Description, Remark",)
    for text in ("x,y,z,Art\n1,2,3,bb\n4,5,6,cc\n", "1 2 3\n4 5 6\n", "x,y,z,code\n1,2,3,\n4,5,6,\n"):
        for more in ({}, {"*": CodeClass("mass")}):
            other = CodeTable({**codes.classes, **more}, codes.file)
            columns = "x, y, z, Art" if "Art" in text else "x, y, z"
            with pytest.raises(InputError, match=rf"codes.toml: none of its codes \(121, G\).*no codes.*{columns}"):
                read_measured([write(text)], ReadOptions(codes=other))
    only_rest = ReadOptions(codes=CodeTable({"*": CodeClass("spot")}))
    assert {g.kind for g in read_measured([write("1 2 3\n4 5 6\n")], only_rest).points} == {"spot"}


def test_codes_of_one_of_several_files_are_enough(write: Write) -> None:
    points, lines = write("1 2 3\n4 5 6\n", "p.xyz"), write("x,y,z,code\n1,1,1,B\n2,2,2,B\n", "l.csv")
    assert read_measured([points, lines], ReadOptions(codes=table(B="breakline", C="spot"))).count == 2

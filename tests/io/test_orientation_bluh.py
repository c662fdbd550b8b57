"""BLUH and BINGO: φ, ω, κ in gon with φ primary; hand-written files after the programs' descriptions."""

from math import cos, pi, sin

import numpy as np
import pytest
from tools.orientation_blocks import (
    CAMERA,
    GROUND,
    block,
    our_pixels,
    phi_omega_kappa,
    pixels_of_matrix,
    pixels_of_millimetres,
)

from photoplan.errors import InputError
from photoplan.io.formats import read_orientation, read_orientation_block, write_orientation
from photoplan.io.orientation.block import TableFormat

FORMATS = {"bluh": "", "bingo": "ORIA "}
#: What a user has to declare of each.
FORMS = {"bluh": TableFormat(angle_unit="gon"), "bingo": TableFormat()}
#: φ, ω, κ in gon.
LINES = {
    "4711": (512345.678, 5274112.875, 2630.44, -1.3894, 0.8331, 98.3333),
    "4712": (513000.125, 5274100.5, 2641.0625, 7.9167, -13.8889, -101.1111),
}


def text(keyword, lines=LINES):
    rows = [f"{keyword}{name} " + "  ".join(map(str, values)) for name, values in lines.items()]
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(("name", "keyword"), FORMATS.items())
def test_ground_points_fall_on_the_pixels_of_the_collinearity_equations(tmp_path, name, keyword):
    path = tmp_path / "block.dat"
    path.write_text(text(keyword))
    table = read_orientation(path, FORMS[name], name)
    expected = []
    for X, Y, Z, *pok in LINES.values():
        p, o, k = (v * pi / 200 for v in pok)
        expected.append(pixels_of_matrix(phi_omega_kappa(p, o, k), (X, Y, Z)))
    np.testing.assert_allclose(our_pixels(table), expected, atol=1e-6)
    assert [i.center for i in table.images] == [v[:3] for v in LINES.values()]
    assert table.notes == ("block.dat: angles read as gon, rotation pok, camera to ground",)


@pytest.mark.parametrize(("name", "keyword"), FORMATS.items())
def test_lines_mean_what_a_published_program_takes_them_for(tmp_path, name, keyword):
    """Š. Turek, Implementation of bundle block adjustment method for determination of exterior orientation into GRASS
    GIS, master's thesis, Czech Technical University in Prague, 2014
    (geo.fsv.cvut.cz/proj/dp/2014/stepan-turek-dp-2014.pdf), and its program, which reads the results of Bingo-F and
    compares its own with them: lines beginning with an asterisk are comments; `ORIA` number X0 Y0 Z0 φ ω κ, gon, and
    one more column; `CORD` number X Y Z are points. The matrix, from the ground's axes to the camera's, is called
    BLUH's; it and the collinearity equations are written out here. For BLUH's file only the rotation is documented so.
    """
    path = tmp_path / "itera.dat"
    rows = [f"{keyword}{n}  {'  '.join(map(str, v))}  1" for n, v in LINES.items()]
    others = ["* orientations", "", "CORD 101 512300.0 5274150.0 500.0 0"] if keyword else []
    path.write_text("\n".join([*others, *rows]) + "\n")
    table = read_orientation(path, FORMS[name], name)
    expected = []
    for X, Y, Z, *gon in LINES.values():
        p, o, k = (v / 200 * pi for v in gon)
        r = [
            [cos(k) * cos(p) + sin(k) * sin(o) * sin(p), sin(k) * cos(o), -cos(k) * sin(p) + sin(k) * sin(o) * cos(p)],
            [-sin(k) * cos(p) + cos(k) * sin(o) * sin(p), cos(k) * cos(o), sin(k) * sin(p) + cos(k) * sin(o) * cos(p)],
            [cos(o) * sin(p), -sin(o), cos(o) * cos(p)],
        ]
        x, y, z = np.array(r) @ (np.array(GROUND) - (X, Y, Z)).T
        c = CAMERA.camera_constant_mm
        expected.append(pixels_of_millimetres(-c * x / z, -c * y / z))
    np.testing.assert_allclose(our_pixels(table), expected, atol=1e-6)
    assert [i.name for i in table.images] == list(LINES)


@pytest.mark.parametrize("name", FORMATS)
def test_written_and_read_again(tmp_path, name):
    made = block()
    (path,) = write_orientation(made, tmp_path / "out.ori", name)
    again = read_orientation(path, FORMS[name], name)
    np.testing.assert_allclose(again.centers, made.table.centers, atol=5.1e-5)
    # Eight decimals of a gon are 1.6e-10 radians.
    np.testing.assert_allclose(again.rotations, made.table.rotations, atol=2e-10)
    np.testing.assert_allclose(our_pixels(again), our_pixels(made.table), atol=2e-3)
    assert [i.name for i in again.images] == [i.name for i in made.table.images]
    # What was read is written without change.
    (second,) = write_orientation(read_orientation_block(path, FORMS[name], name), tmp_path / "second.ori", name)
    assert second.read_text() == path.read_text()


def test_bingo_is_recognised_and_bluh_is_not(tmp_path):
    bingo, bluh = tmp_path / "itera.dat", tmp_path / "dapor.dat"
    bingo.write_text("C comment\nPARA 1 2 3\n" + text("ORIA "))
    bluh.write_text(text(""))
    assert len(read_orientation(bingo).images) == 2
    with pytest.raises(InputError, match=r"dapor\.dat:1: no header; declare the columns.*or the format"):
        read_orientation(bluh)


def test_other_conventions_are_declared(tmp_path):
    path = tmp_path / "block.ori"
    path.write_text("a 0 0 1000 1 2 3\n")
    table = read_orientation(path, TableFormat(angle_unit="rad", rotation="kpo", direction="ground-to-camera"), "bluh")
    assert (table.angle_unit, table.rotation, table.direction) == ("rad", "kpo", "ground-to-camera")
    assert table.images[0].angles == (3.0, 1.0, 2.0)
    with pytest.raises(InputError, match="tells the unit of angles in files of BLUH; declare `angle_unit`"):
        read_orientation(path, TableFormat(), "bluh")
    # The value that is the default of tables can be declared, too.
    declared = TableFormat(angle_unit="deg", rotation="opk")
    table = read_orientation(path, declared, "bluh")
    assert (table.angle_unit, table.rotation) == ("deg", "opk")
    assert table.images[0].angles == (2.0, 1.0, 3.0)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "holds no image"),
        ("a 1 2 3 4 5\n", r":1: 6 columns"),
        ("a 1 2 3 4 5 6\nb 1 2 nan 4 5 6\n", r":2: image 'b': X, Y, Z, phi, omega, kappa = 'nan' is not a number"),
        ("a 1 2 3 4 5 401\n", r":1: image 'a': angle kappa = 401 is more than a full circle in gon"),
        ("a 1 2 3 4 5 6\r\na 1 2 3 4 5 6\r\n", r"'a' is given twice \(lines 1 and 2\)"),
        ("a 1,5 2 3 4 5 6\n", "'1,5' is not a number"),
        ("a 1 2 1e999 4 5 6\n", "'1e999' is not a number"),
        (b"\xe4 1 2 3 4 5 6\n", ":1: not UTF-8"),
        ("a 1 2 3 4 5 6\n\x00", ":2: holds a zero byte"),
    ],
)
def test_fault_18_broken_files_name_the_line(tmp_path, content, says):
    path = tmp_path / "b.ori"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=says):
        read_orientation(path, FORMS["bluh"], "bluh")


def test_fault_18_bingo_names_the_line(tmp_path):
    path = tmp_path / "b.dat"
    path.write_text("ORIA a 1 2 3 4 5 6\nORIA b 1 2 3\n")
    with pytest.raises(InputError, match=r":2: image 'b': .* 3 values; 6 numbers"):
        read_orientation(path, format="bingo")
    path.write_text("GEOIN\n")
    with pytest.raises(InputError, match="no line begins with ORIA"):
        read_orientation(path, format="bingo")


def test_fortran_exponents_and_further_columns(tmp_path):
    path = tmp_path / "b.ori"
    path.write_text("a 1.5D+03 2 3 .4 -5. +6 0.01 0.01 0.01\n")
    image = read_orientation(path, FORMS["bluh"], "bluh").images[0]
    assert image.center == (1500.0, 2.0, 3.0)
    assert image.angles == (0.4, -5.0, 6.0)


def test_names_with_blanks_are_refused_before_anything_is_written(tmp_path):
    from dataclasses import replace

    made = block()
    images = tuple(replace(i, name=i.name.replace("_", " ")) for i in made.table.images)
    blank = replace(made, table=replace(made.table, images=images))
    for name in FORMATS:
        with pytest.raises(InputError, match="has a blank in its name"):
            write_orientation(blank, tmp_path / "x.ori", name)
    assert not list(tmp_path.iterdir())


def test_points_of_the_tests_are_in_front():
    assert len(GROUND) == 3
    assert np.isfinite(our_pixels(block().table)).all()

"""The registry: what is recognised, what is asked, what is written, and nothing that exists is touched."""

import numpy as np
import pytest
from tools.orientation_blocks import CAMERA, block, our_pixels

from photoplan.errors import InputError, UsageError
from photoplan.io import formats as orientation_file
from photoplan.io.camera.model import FilmEntry
from photoplan.io.formats import (
    FORMATS,
    choose_format,
    orientation_format,
    read_orientation,
    read_orientation_block,
    write_orientation,
    written_formats,
)
from photoplan.io.orientation.block import (
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    OrientedImage,
    TableFormat,
)

MARKS = {str(k): xy for k, xy in enumerate([(-106.0, -106.0), (106.0, -106.0), (106.0, 106.0)])}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_keeps_its_word(name):
    found = orientation_format(name)
    assert isinstance(found, OrientationFormat)
    assert found.name == name
    assert found.title


def test_an_unknown_format_is_refused_with_those_that_are_known(tmp_path):
    with pytest.raises(UsageError, match="'nonsense'; allowed are csv, toml"):
        read_orientation(tmp_path / "x", format="nonsense")
    with pytest.raises(InputError, match="cannot be read"):
        read_orientation(tmp_path / "x")


def test_a_file_that_two_formats_claim_is_asked_about(tmp_path, monkeypatch):
    """Both marks in one file: the user says which it is."""
    path = tmp_path / "both.txt"
    path.write_text("$PROJECT 5\nORIA a 1 2 3 4 5 6\n")
    with pytest.raises(InputError, match=r"bingo \(.*\), inpho \(.*\); say it with `format`"):
        read_orientation(path)
    assert read_orientation(path, format="bingo").images[0].name == "a"


@pytest.mark.parametrize("name", ["toml", "patb", "bingo", "inpho", "csv"])
def test_what_is_written_is_recognised(tmp_path, name):
    suffix = {"toml": ".toml", "inpho": ".prj"}.get(name, ".txt")
    path = write_orientation(block(crs="EPSG:25832"), tmp_path / f"out{suffix}", name)[0]
    assert choose_format(path, TableFormat()).name == name


def test_declared_columns_make_it_a_table(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("ORIA 1 2 3 4 5 6\n")
    table = read_orientation(path, TableFormat(columns="name,x,y,z,omega,phi,kappa"))
    assert table.images[0] == OrientedImage("ORIA", (1, 2, 3), (4, 5, 6), None, 1)


def test_nothing_that_exists_is_replaced_unless_asked(tmp_path):
    made = block(crs="EPSG:25832")
    side = tmp_path / "out.prj"
    side.write_text("precious")
    with pytest.raises(UsageError, match=r"out\.prj: exists"):
        write_orientation(made, tmp_path / "out.csv", "csv")
    assert [p.name for p in tmp_path.iterdir()] == ["out.prj"] and side.read_text() == "precious"
    files = write_orientation(made, tmp_path / "out.csv", "csv", overwrite=True)
    assert files == [tmp_path / "out.csv", side]
    assert side.read_text().strip() == "EPSG:25832"


def test_csv_holds_every_digit(tmp_path):
    odd = OrientedImage('a, "b"', (1 / 3, -2e-7, 1e6 + 1 / 7), (1e-9, 90.0, -179.999999999), "c,1", None)
    table = OrientationTable(tmp_path, (odd,))
    path = write_orientation(OrientationBlock(table), tmp_path / "o.csv", "csv")[0]
    again = read_orientation(path)
    assert again.images[0].name == odd.name
    assert again.images[0].center == odd.center
    assert again.images[0].angles == odd.angles
    assert again.images[0].camera == "c,1"


@pytest.mark.parametrize("camera", [CAMERA, FilmEntry(type="film", camera_constant_mm=153.0, fiducials_mm=MARKS)])
def test_own_toml_holds_everything(tmp_path, camera):
    made = block(camera, crs="EPSG:25832")
    path = write_orientation(made, tmp_path / "o.toml", "toml")[0]
    again = read_orientation_block(path)
    assert again.cameras == {"DMC": camera}
    assert again.files == made.files
    assert again.table.images == made.table.images
    assert again.table.crs is not None and "25832" in again.table.crs
    if camera is CAMERA:
        np.testing.assert_array_equal(our_pixels(again.table), our_pixels(made.table))


def test_images_without_orientation_are_left_out_of_toml(tmp_path):
    path = tmp_path / "o.toml"
    path.write_text(
        '[[images]]\nname = "a"\n[[images]]\nname = "b"\ncenter = [1.0, 2.0, 3.0]\nangles = [0.0, 0.0, 0.0]\n'
    )
    table = read_orientation(path)
    assert [i.name for i in table.images] == ["b"]
    assert "1 images are not oriented" in table.notes[0]
    path.write_text('[[images]]\nname = "a"\ncenter = [1.0, 2.0, 3.0]\n')
    with pytest.raises(InputError, match="'a': center and angles go together"):
        read_orientation(path)


def test_what_a_project_knows_of_its_orientations_and_no_file_holds_is_noted(tmp_path):
    path = tmp_path / "p.toml"
    image = '[[images]]\nname = "b"\ncenter = [1.0, 2.0, 3.0]\nangles = [0.0, 0.0, 0.0]\n'
    path.write_text('[orientation]\nearth_curvature = "strict"\nrefraction = true\n' + image)
    (note,) = read_orientation(path).notes
    assert "earth curvature (strict) and refraction" in note
    path.write_text(image + "sigma_center = [0.1, 0.1, 0.2]\nsigma_angles = [0.0, 0.0, 0.0]\n")
    (note,) = read_orientation(path).notes
    assert "standard deviations" in note
    path.write_text(image)
    assert read_orientation(path).notes == ()


def test_a_block_names_what_does_not_fit():
    image = OrientedImage("a", (0, 0, 0), (0, 0, 0), "x")
    table = OrientationTable(__import__("pathlib").Path("t"), (image,))
    with pytest.raises(InputError, match="camera 'x' of image 'a' is not described; cameras are 'DMC'"):
        OrientationBlock(table, {"DMC": CAMERA})
    with pytest.raises(InputError, match="file of image 'b', which is not in the block"):
        OrientationBlock(table, files={"b": "b.tif"})


def test_formats_that_are_only_read_say_which_are_written(tmp_path, monkeypatch):
    only = OrientationFormat("csv", "x", lambda path, head: False, lambda path, form: block())
    monkeypatch.setattr(orientation_file, "orientation_format", lambda name: only)
    assert written_formats() == []
    with pytest.raises(UsageError, match="csv is read only"):
        write_orientation(block(), tmp_path / "x", "csv")


@pytest.mark.parametrize("name", ["csv", "toml", "patb", "bingo", "bluh", "inpho"])
@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_fault_18_marks_and_line_ends_change_nothing(tmp_path, name, end):
    suffix = orientation_format(name).suffix
    path = write_orientation(block(), tmp_path / f"out{suffix}", name)[0]
    undescribed = {"patb": {"direction": "camera-to-ground"}, "bluh": {"angle_unit": "deg"}}
    form = TableFormat(**undescribed.get(name, {}))
    stated = name if name == "bluh" else None
    before = read_orientation(path, form, stated).images
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", end.encode()))
    if name == "toml" and end == "\r":
        # TOML knows no lone carriage return; the reader makes newlines of it.
        assert b"\n" not in path.read_bytes()
    assert read_orientation(path, form, stated).images == before


@pytest.mark.parametrize("name", ["csv", "toml", "patb", "bingo", "bluh", "inpho"])
def test_fault_7_huge_files_are_refused_by_their_size(tmp_path, name):
    path = tmp_path / f"huge{orientation_format(name).suffix}"
    with path.open("wb") as file:
        file.truncate(300_000_000)
    with pytest.raises(InputError, match="300000000 bytes; at most"):
        read_orientation(path, format=name)


@pytest.mark.parametrize("name", ["csv", "toml", "patb", "bingo", "bluh", "inpho"])
def test_a_local_system_is_refused_where_its_origin_cannot_be_stated(tmp_path, name):
    from dataclasses import replace

    made = block()
    local = replace(made, table=replace(made.table, origin=(47.0, 11.0, 600.0)))
    with pytest.raises(InputError, match="carry them into a map with `crs`"):
        write_orientation(local, tmp_path / "x", name)
    assert not list(tmp_path.iterdir())

"""Conversion of orientation files: poses and pixels stay, what is lost is said or refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tools.orientation_blocks import ANGLES, CAMERA, CENTERS, GROUND, NAMES, block, our_pixels

from photoplan.errors import InputError, UsageError
from photoplan.geometry.pose import angles_from_rotation, rotation_from_angles
from photoplan.io.camera.model import FilmEntry
from photoplan.io.formats import FORMATS, orientation_format, read_orientation_block, write_orientation
from photoplan.io.orientation.block import TableFormat
from photoplan.orientation.conventions import Convention
from photoplan.plain import json_text, plain
from photoplan.products.convert import ConvertRequest, convert_orientation, list_readings

MINE = ("csv", "toml", "patb", "bingo", "bluh", "inpho")
FROM_CAMERA = TableFormat(direction="camera-to-ground")
#: What has to be declared of files whose makers do not tell it.
DECLARED = {"patb": FROM_CAMERA, "bluh": TableFormat(angle_unit="gon")}


@pytest.fixture
def toml(tmp_path):
    folder = tmp_path / "source"
    return write_orientation(block(crs="EPSG:25832"), folder / "block.toml", "toml")[0]


@pytest.mark.parametrize("target", MINE)
def test_there_and_back_every_pixel_stays(tmp_path, toml, target):
    suffix = orientation_format(target).suffix
    there = tmp_path / "out" / f"there{suffix}"
    done = convert_orientation(ConvertRequest(toml, target, there))
    assert done.files[0] == there
    assert (done.source_format, done.target_format, done.images) == ("toml", target, 3)
    back = tmp_path / "back.csv"
    form = DECLARED.get(target, TableFormat())
    convert_orientation(ConvertRequest(there, "csv", back, format=target, form=form))
    again = read_orientation_block(back).table
    assert [i.name for i in again.images] == list(NAMES)
    np.testing.assert_allclose(our_pixels(again), our_pixels(block().table), atol=2e-3)
    assert json_text(done)


def test_without_a_name_the_file_lies_beside(toml):
    done = convert_orientation(ConvertRequest(toml, "patb"))
    assert done.files == (toml.with_name("block_patb.ori"),)
    with pytest.raises(UsageError, match=r"block_patb\.ori: exists already"):
        convert_orientation(ConvertRequest(toml, "patb"))
    convert_orientation(ConvertRequest(toml, "patb", overwrite=True))


def test_fault_13_an_output_that_exists_or_is_the_input_is_refused_before_work(toml):
    with pytest.raises(UsageError, match="the output is the input"):
        convert_orientation(ConvertRequest(toml, "toml", toml, overwrite=True))
    link = toml.with_name("link.toml")
    link.symlink_to(toml)
    with pytest.raises(UsageError, match="the output is the input"):
        convert_orientation(ConvertRequest(toml, "toml", link, overwrite=True))
    # The side file of a table counts as well.
    side = toml.with_name("out.prj")
    side.write_text("precious")
    with pytest.raises(UsageError, match=r"out\.prj: exists"):
        convert_orientation(ConvertRequest(toml, "csv", toml.with_name("out.csv")))
    assert side.read_text() == "precious" and not toml.with_name("out.csv").exists()


def test_unknown_formats_are_refused(toml):
    with pytest.raises(UsageError, match="allowed are csv"):
        convert_orientation(ConvertRequest(toml, "nonsense"))
    with pytest.raises(UsageError, match="allowed are csv"):
        convert_orientation(ConvertRequest(toml, "csv", format="nonsense"))


def test_a_lens_is_never_lost_in_silence(block, tmp_path):
    request = ConvertRequest(block / "ext.csv", "inpho", tmp_path / "o.prj", camera=block / "int.yaml")
    with pytest.raises(UsageError, match=r"no lens of type opencv .*`drop_lens`"):
        convert_orientation(request)
    assert not (tmp_path / "o.prj").exists()
    done = convert_orientation(
        ConvertRequest(block / "ext.csv", "inpho", tmp_path / "o.prj", camera=block / "int.yaml", drop_lens=True)
    )
    assert "lens" in [loss.kind for loss in done.lost]
    (camera,) = read_orientation_block(tmp_path / "o.prj").cameras.values()
    assert camera.lens.type == "none"
    # A format without cameras leaves the lens to the camera's file.
    done = convert_orientation(ConvertRequest(block / "ext.csv", "bluh", tmp_path / "o.ori", camera=block / "int.yaml"))
    assert [loss.kind for loss in done.lost] == ["camera", "crs"]


def test_a_whole_project_is_converted_with_its_camera_and_image_files(tmp_path, block):
    from photoplan.products.init import InitRequest, init_project

    images = str(block / "images" / "*.jpg")
    request = InitRequest(
        tmp_path / "project",
        (images,),
        block / "int.yaml",
        block / "ext.csv",
        str(block / "dsm.tif"),
        height_system="same",
    )
    project = init_project(request).path
    done = convert_orientation(ConvertRequest(project, "toml", tmp_path / "elsewhere" / "deep" / "o.toml"))
    again = read_orientation_block(done.files[0])
    assert len(again.table.images) == 18
    assert [c.lens.type for c in again.cameras.values()] == ["opencv"]
    for file in again.files.values():
        assert (tmp_path / "elsewhere" / "deep" / file).is_file()


@pytest.mark.parametrize(
    ("axes", "turned"), [("up-back", 90), ("up-back", 270), ("down-forward", 90), ("down-forward", 0)]
)
def test_axes_and_directions_that_a_table_does_not_state(tmp_path, axes, turned):
    """A table of radians from ground to camera, whose camera may be computer vision's, of images that are turned.

    An image turned counter-clockwise shows what lies along the camera's x at that angle from its own x.
    """
    made = block()
    flip = np.diag([1.0, -1.0, -1.0]) if axes == "down-forward" else np.eye(3)
    turn = rotation_from_angles((0, 0, np.radians(turned)))
    rows = ["name,x,y,z,omega,phi,kappa"]
    for name, center, R in zip(NAMES, CENTERS, made.table.rotations):
        o, p, k = angles_from_rotation((R @ turn @ flip).T)
        rows.append(f"{name},{','.join(map(repr, map(float, center)))},{o},{p},{k}")
    source = tmp_path / "cv.csv"
    source.write_text("\n".join(rows) + "\n")
    form = TableFormat(angle_unit="rad", direction="ground-to-camera")
    request = ConvertRequest(source, "csv", tmp_path / "o.csv", form=form, camera_axes=axes, turned=turned)
    convert_orientation(request)
    again = read_orientation_block(tmp_path / "o.csv").table
    np.testing.assert_allclose(again.rotations, made.table.rotations, atol=1e-12)
    np.testing.assert_allclose([i.angles for i in again.images], ANGLES, atol=1e-9)


def test_crs_is_declared_or_changed(tmp_path, toml):
    bare = write_orientation(block(), tmp_path / "bare.csv", "csv")[0]
    done = convert_orientation(ConvertRequest(bare, "csv", tmp_path / "declared.csv", crs="EPSG:25832"))
    assert done.crs == "EPSG:25832"
    again = read_orientation_block(tmp_path / "declared.csv").table
    assert again.images[0].center == CENTERS[0]
    convert_orientation(ConvertRequest(toml, "csv", tmp_path / "33.csv", crs="EPSG:25833"))
    other = read_orientation_block(tmp_path / "33.csv").table
    from pyproj import Transformer

    step = Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True)
    X, Y = step.transform(*np.array(CENTERS)[:, :2].T)
    np.testing.assert_allclose(other.centers[:, :2], np.column_stack([X, Y]), atol=1e-6)
    # κ turns by the difference of the grids' norths, 4.4° here.
    turned = np.degrees(angles_from_rotation(other.rotations[0])[2]) - ANGLES[0][2]
    at = np.array(CENTERS[0][:2])
    north = np.subtract(step.transform(at[0], at[1] + 100), step.transform(*at))
    assert turned == pytest.approx(np.degrees(np.arctan2(-north[0], north[1])), abs=0.02)
    with pytest.raises(InputError, match="projected"):
        convert_orientation(ConvertRequest(toml, "csv", tmp_path / "geo.csv", crs="EPSG:4326"))


def test_cameras_of_another_file_replace_those_of_the_orientation(tmp_path, toml):
    camera = tmp_path / "camera.toml"
    text = toml.read_text()
    camera.write_text(text[text.index("[cameras.DMC]") : text.index("[[images]]")].replace("120.01", "119.0"))
    done = convert_orientation(ConvertRequest(toml, "toml", tmp_path / "o.toml", camera=camera))
    assert read_orientation_block(done.files[0]).cameras["DMC"].camera_constant_mm == 119.0
    camera.write_text(camera.read_text().replace("DMC", "RC30"))
    with pytest.raises(InputError, match=r"names camera 'DMC'.* describes 'RC30'"):
        convert_orientation(ConvertRequest(toml, "toml", tmp_path / "p.toml", camera=camera))


def test_matrices_are_written_as_asked(tmp_path, toml):
    for matrix, form in (
        ("camera-to-ground", FROM_CAMERA),
        ("ground-to-camera", TableFormat(direction="ground-to-camera")),
    ):
        path = tmp_path / f"{matrix}.ori"
        done = convert_orientation(ConvertRequest(toml, "patb", path, matrix=matrix))
        assert any(matrix.replace("-", " ") in loss.text for loss in done.lost)
        again = read_orientation_block(path, form).table
        np.testing.assert_allclose(again.rotations, block().table.rotations, atol=1e-12)


@pytest.fixture
def measured(tmp_path):
    """Image points of ground points of the block, and the ground points."""
    rng = np.random.default_rng(1)
    ground = np.array(GROUND)[:1] + rng.uniform(-1, 1, (40, 3)) * [600, 600, 60]
    pixels = our_pixels(block().table, CAMERA, ground)
    lines = ["point,image,x,y"]
    for name, xy in zip(NAMES, pixels):
        lines += [f"p{k},{name}.tif,{x:.2f},{y:.2f}" for k, (x, y) in enumerate(xy)]
    points, control = tmp_path / "points.csv", tmp_path / "control.csv"
    points.write_text("\n".join(lines) + "\n")
    control.write_text("name,x,y,z\n" + "".join(f"p{k},{X},{Y},{Z}\n" for k, (X, Y, Z) in enumerate(ground)))
    return points, control


@pytest.mark.parametrize("unit", ["deg", "gon", "rad"])
def test_fault_14_readings_of_a_table_and_the_options_to_give(tmp_path, toml, measured, unit):
    made = block().table
    scale = {"deg": 180, "gon": 200, "rad": np.pi}[unit] / np.pi
    rows = ["name,x,y,z,omega,phi,kappa"]
    for name, center, R in zip(NAMES, CENTERS, made.rotations):
        k, p, o = angles_from_rotation(R.T, "kpo") * scale
        rows.append(f"{name},{','.join(map(repr, map(float, center)))},{o},{p},{k}")
    table = tmp_path / "unknown.csv"
    table.write_text("\n".join(rows) + "\n")
    found = list_readings(ConvertRequest(table, "csv", camera=toml), *measured)
    assert (found.points, found.images, found.matrices) == (120, 3, False)
    options = found.options(found.fitting[0].reading)
    assert options == f"`angle_unit` {unit} `rotation` kpo `rotation_direction` ground-to-camera"
    assert len(found.fitting) == 1 and len(found.others) == 5
    assert found.fitting[0].median < 0.02
    assert plain(found)["fitting"][0]["options"] == options


def test_fault_14_readings_of_matrices(tmp_path, toml, measured):
    path = convert_orientation(ConvertRequest(toml, "patb", tmp_path / "o.ori", matrix="ground-to-camera")).files[0]
    found = list_readings(ConvertRequest(path, "csv", camera=toml), *measured)
    assert found.matrices
    assert [found.options(f.reading) for f in found.fitting] == ["`rotation_direction` ground-to-camera"]


def test_readings_of_film_scans_use_their_marks(tmp_path):
    """Three scans of different position and turn; the one whose marks are not measured is left out and named."""
    marks = {"a": (-106.0, -106.0), "b": (106.0, -106.0), "c": (106.0, 106.0), "d": (-106.0, 106.0)}
    camera = FilmEntry(
        type="film", camera_constant_mm=153.1, fiducials_mm=marks, principal_point_mm=(0.01, -0.02), size=(9600, 9600)
    )
    made = block(camera)
    rng = np.random.default_rng(2)
    ground = np.array(GROUND)[:1] + rng.uniform(-1, 1, (40, 3)) * [900, 900, 60]
    images, lines = [], ["point,image,x,y"]
    for k, (image, R) in enumerate(zip(made.table.images, made.table.rotations)):
        # Pixels of 25 µm; scans lie turned by a tenth of a degree and are cut differently.
        turn, shift = np.radians(0.1 * k), np.array([4790.0 + 30 * k, 4810.0 - 20 * k])

        def to_pixel(xy, turn=turn, shift=shift):
            c, s = np.cos(turn), np.sin(turn)
            x, y = np.asarray(xy).T
            return np.stack([c * x - s * y, -(s * x + c * y)], axis=-1) / 0.025 + shift

        d = (ground - image.center) @ R
        xy = -153.1 * d[:, :2] / d[:, 2:] + (0.01, -0.02)
        lines += [f"p{p},{image.name},{x:.3f},{y:.3f}" for p, (x, y) in enumerate(to_pixel(xy))]
        measured = None if k == 2 else {m: tuple(map(float, to_pixel(at))) for m, at in marks.items()}
        images.append(replace(image, fiducials=measured))
    film = replace(made, table=replace(made.table, images=tuple(images)))
    source = write_orientation(film, tmp_path / "film.toml", "toml")[0]
    (tmp_path / "points.csv").write_text("\n".join(lines) + "\n")
    control = "".join(f"p{k},{X},{Y},{Z}\n" for k, (X, Y, Z) in enumerate(ground))
    (tmp_path / "control.csv").write_text("name,x,y,z\n" + control)
    found = list_readings(ConvertRequest(source, "csv"), tmp_path / "points.csv", tmp_path / "control.csv")
    assert (found.points, found.images) == (80, 2)
    assert found.fitting[0].reading == Convention()
    assert found.fitting[0].median < 0.01
    assert any(f"1 film images have no measured fiducial marks ({NAMES[2]!r}" in n for n in found.notes)
    # Marks and sizes go into own TOML; an Inpho project says that it has none.
    again = convert_orientation(ConvertRequest(source, "toml", tmp_path / "again.toml")).files[0]
    assert [i.fiducials for i in read_orientation_block(again).table.images] == [i.fiducials for i in images]
    lost = convert_orientation(ConvertRequest(source, "inpho", tmp_path / "film.prj")).lost
    assert "film" in [loss.kind for loss in lost]


def test_readings_need_a_camera_and_say_when_none_fits(tmp_path, toml, measured):
    bare = write_orientation(block(camera=None), tmp_path / "bare.csv", "csv")[0]
    with pytest.raises(UsageError, match="give `camera` FILE"):
        list_readings(ConvertRequest(bare, "csv"), *measured)
    points, control = measured
    text = control.read_text().split("\n")
    # Heights of another kind: everything is off.
    shifted = [text[0]] + [",".join([*r.split(",")[:3], str(float(r.split(",")[3]) - 300)]) for r in text[1:] if r]
    control.write_text("\n".join(shifted) + "\n")
    found = list_readings(ConvertRequest(toml, "csv"), points, control)
    assert any("even the best reading leaves" in n and "heights of one kind" in n for n in found.notes)


def test_a_folder_that_is_no_orientation_is_refused(tmp_path):
    with pytest.raises(InputError):
        convert_orientation(ConvertRequest(tmp_path, "csv", tmp_path / "o.csv"))


@pytest.mark.parametrize("target", [name for name in FORMATS if name not in MINE])
def test_other_formats_there_and_back(tmp_path, toml, target):
    """By way of another program's axes, and of a local system where it has one, every pixel comes back."""
    if orientation_format(target).render is None:
        pytest.skip("this format is read only")
    if target == "opencv":
        pytest.skip("this format holds cameras only")
    there = tmp_path / target / f"there{orientation_format(target).suffix}"
    convert_orientation(ConvertRequest(toml, target, there))
    back = tmp_path / "back.csv"
    convert_orientation(ConvertRequest(there, "csv", back, format=target, crs="EPSG:25832"))
    again = read_orientation_block(back).table
    by_name = {Path(image.name).stem: k for k, image in enumerate(again.images)}
    at = [by_name[name] for name in NAMES]
    np.testing.assert_allclose(our_pixels(again)[at], our_pixels(block().table), atol=0.02)

"""`photoplan convert`: streams, exit codes, and the way from an unknown table to a project."""

import json
from pathlib import Path

import numpy as np
import pytest
from tools.orientation_blocks import CAMERA, GROUND, NAMES, block, our_pixels
from tools.recorded import recorded

from photoplan.geometry.pose import angles_from_rotation
from photoplan.io.formats import FORMATS, orientation_format, read_orientation, write_orientation


@pytest.fixture
def toml(tmp_path):
    return write_orientation(block(crs="EPSG:25832"), tmp_path / "block.toml", "toml")[0]


def test_paths_on_stdout_and_what_is_lost_on_stderr(photoplan, toml, tmp_path):
    said = photoplan("convert", toml, "--to", "bingo", "-o", tmp_path / "itera.dat")
    assert said.code == 0
    assert said.out == f"{tmp_path / 'itera.dat'}\n"
    assert "3 images, from toml to bingo" in said.err
    assert "bingo holds no cameras ('DMC')" in said.err
    assert "bingo holds no coordinate system" in said.err
    assert recorded(tmp_path / "itera.run.json", "convert", toml)["settings"]["target"] == "bingo"
    quiet = photoplan("convert", toml, "--to", "csv", "-o", tmp_path / "t.csv", "-q")
    assert quiet.out.split("\n")[:2] == [str(tmp_path / "t.csv"), str(tmp_path / "t.prj")]
    assert quiet.err == ""


def test_a_dry_run_says_what_it_would_write_and_refuses_as_the_run(photoplan, toml, tmp_path):
    words = ("convert", toml, "--to", "bingo", "-o", tmp_path / "itera.dat")
    said = photoplan(*words, "--dry-run")
    assert (said.code, said.out) == (0, f"{tmp_path / 'itera.dat'}\n")
    assert "bingo; nothing is written" in said.err and "bingo holds no cameras ('DMC')" in said.err
    assert [p.name for p in tmp_path.iterdir()] == ["block.toml"]
    assert photoplan(*words).code == 0
    assert photoplan(*words, "--dry-run").code == 2


def test_json(photoplan, toml, tmp_path):
    said = photoplan("convert", toml, "--to", "inpho", "-o", tmp_path / "o.prj", "--json")
    facts = json.loads(said.out)
    assert facts["files"] == [str(tmp_path / "o.prj")]
    assert (facts["from"], facts["to"], facts["images"], facts["cameras"]) == ("toml", "inpho", 3, ["DMC"])
    assert {loss["kind"] for loss in facts["lost"]} == {"other"}


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--to", "csv", "-o", "{toml}", "--overwrite"), 2, "the output is the input"),
        (("--to", "nonsense"), 2, "allowed are csv"),
        (("--to", "csv", "--format", "nonsense"), 2, "allowed are csv"),
        ((), 2, "--to FORMAT"),
        (("--to", "csv", "--list-readings"), 2, "--image-points FILE and --control FILE"),
        (("--to", "csv", "--control", "x"), 2, "require --list-readings"),
        (("--to", "csv", "--crs", "EPSG:4326"), 3, "projected"),
        (("--to", "csv", "--camera", "missing.toml"), 3, "missing.toml"),
        (("--to", "csv", "--format", "bingo"), 3, "no line begins with ORIA"),
    ],
)
def test_wrong_use_and_bad_input(photoplan, toml, arguments, code, says):
    said = photoplan("convert", toml, *(a.format(toml=toml) for a in arguments))
    assert said.code == code
    assert says in said.err
    assert said.out == ""
    assert [p.name for p in toml.parent.iterdir()] == ["block.toml"]


def test_a_missing_orientation(photoplan, tmp_path):
    said = photoplan("convert", tmp_path / "none.ori", "--to", "csv")
    assert (said.code, said.out) == (3, "")
    assert "none.ori: cannot be read" in said.err


def test_fault_14_from_an_unknown_table_to_its_pixels(photoplan, toml, tmp_path):
    """The listing gives options; with them the table becomes what it was made of."""
    made = block().table
    rows = []
    for name, image, R in zip(NAMES, made.images, made.rotations):
        k, p, o = angles_from_rotation(R.T, "kpo") * 200 / np.pi
        rows.append(f"{name} {' '.join(map(repr, image.center))} {o} {p} {k}")
    table = tmp_path / "unknown.txt"
    table.write_text("\n".join(rows) + "\n")
    rng = np.random.default_rng(1)
    ground = np.array(GROUND)[:1] + rng.uniform(-1, 1, (30, 3)) * [600, 600, 60]
    lines = ["point image x y"]
    for name, xy in zip(NAMES, our_pixels(made, CAMERA, ground)):
        lines += [f"p{k} {name} {x:.3f} {y:.3f}" for k, (x, y) in enumerate(xy)]
    (tmp_path / "points.txt").write_text("\n".join(lines) + "\n")
    control = "".join(f"p{k},{X},{Y},{Z}\n" for k, (X, Y, Z) in enumerate(ground))
    (tmp_path / "control.csv").write_text("name,x,y,z\n" + control)
    columns = ("--columns", "name,x,y,z,omega,phi,kappa", "--camera", toml)
    measured = ("--image-points", tmp_path / "points.txt", "--control", tmp_path / "control.csv")
    said = photoplan("convert", table, *columns, "--list-readings", *measured)
    assert said.code == 0, said.err
    first, *others = said.out.splitlines()
    options = "--angle-unit gon --rotation kpo --rotation-direction ground-to-camera"
    assert first.split("px")[1].split() == ["fits", *options.split()]
    assert len(others) == 5 and not any("fits" in line for line in others)
    assert "medians of 90 points in 3 images" in said.err
    facts = json.loads(photoplan("convert", table, *columns, "--list-readings", *measured, "--json").out)
    assert facts["fitting"][0]["options"] == options
    done = photoplan("convert", table, *columns, *options.split(), "--to", "csv", "-o", tmp_path / "right.csv")
    assert done.code == 0, done.err
    np.testing.assert_allclose(our_pixels(read_orientation(tmp_path / "right.csv")), our_pixels(made), atol=1e-4)


def test_fault_14_patb_is_asked_what_its_matrix_does(photoplan, toml, tmp_path):
    photoplan("convert", toml, "--to", "patb", "-o", tmp_path / "o.ori")
    said = photoplan("convert", tmp_path / "o.ori", "--to", "csv", "-o", tmp_path / "o.csv")
    assert said.code == 3 and "--rotation-direction" in said.err
    given = ("--rotation-direction", "camera-to-ground")
    said = photoplan("convert", tmp_path / "o.ori", "--to", "csv", "-o", tmp_path / "o.csv", *given)
    assert said.code == 0, said.err
    np.testing.assert_allclose(read_orientation(tmp_path / "o.csv").rotations, block().table.rotations, atol=1e-12)


def test_a_project_is_made_from_a_classical_file(photoplan, tmp_path, block):
    """The drone block's table written for BINGO, read by `photoplan init`."""
    files = ("--images", block / "images" / "*.jpg", "--camera", block / "int.yaml", "--terrain", block / "dsm.tif")
    common = (*files, "--crs", "EPSG:32615", "--height-system", "same")
    photoplan("convert", block / "ext.csv", "--to", "bingo", "-o", tmp_path / "itera.dat")
    said = photoplan("init", tmp_path / "project", *common, "--orientation", tmp_path / "itera.dat")
    assert said.code == 0, said.err
    assert "angles read as gon, rotation pok, camera to ground" in said.err
    again = read_orientation(tmp_path / "project" / "project.toml")
    expected = read_orientation(block / "ext.csv")
    by_name = {Path(i.name).stem: R for i, R in zip(expected.images, expected.rotations)}
    for image, R in zip(again.images, again.rotations):
        np.testing.assert_allclose(R, by_name[image.name], atol=1e-9)


def test_fault_11_names_of_a_table_lead_nowhere(photoplan, tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("name,x,y,z,omega,phi,kappa\n../../evil,1,2,3,0,0,0\n/etc/passwd,1,2,3,0,0,0\n")
    for target in FORMATS:
        render = orientation_format(target).render
        if render is None:
            continue
        out = tmp_path / "inner" / target
        photoplan("convert", table, "--to", target, "--crs", "EPSG:25832", "-o", out / "o.x")
        outside = [p for p in tmp_path.rglob("*") if p.is_file() and tmp_path / "inner" not in p.parents]
        assert outside == [table]

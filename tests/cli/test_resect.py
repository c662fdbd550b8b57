"""`photoplan resect`: a small project with control, measured with errors that are known."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner, Result
from tools.recorded import recorded

from photoplan.cameras.base import project as project_points
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Brown, Interior
from photoplan.cli.table import VERBS
from photoplan.errors import GeometryError, InputError, TilesFailed, UsageError
from photoplan.geometry.pose import Pose, rotation_from_angles
from photoplan.io.project.file import load_project
from photoplan.project.scene import open_scene

command = VERBS["resect"].command("resect")

SIZE, C = (4000, 3000), 3200.0
LENS = Brown(k1=-0.05)
ORDER = "pok"
#: φ, ω, κ in gon.
POSES = {
    "a": ((500_000.0, 5_400_000.0, 1500.0), (1.5, -2.0, 30.0)),
    "b": ((500_400.0, 5_400_010.0, 1520.0), (-0.8, 1.2, -170.0)),
    "c": ((503_000.0, 5_400_000.0, 1500.0), (0.0, 0.0, 0.0)),
}


def radians(angles: Any) -> np.ndarray:
    return np.array(angles) * np.pi / 200


def pose_of(name: str) -> Pose:
    center, angles = POSES[name]
    return Pose(np.array(center), rotation_from_angles(radians(angles), ORDER))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project of three images with strict curvature and refraction; "c" shows no control."""
    rng = np.random.default_rng(1)
    n = 14
    XYZ = np.column_stack(
        [500_200 + rng.uniform(-450, 450, n), 5_400_000 + rng.uniform(-350, 350, n), rng.uniform(150, 400, n)]
    )
    names = [f"K{k + 1}" for k in range(n)]
    rows = ["point,image,x,y"]
    interior = Interior.digital(SIZE, (C, C), (12.0, -7.0))
    for name in POSES:
        camera = oriented_camera(
            interior, LENS, pose_of(name), crs="EPSG:32632", earth_curvature="strict", refraction=True
        )
        xy = project_points(camera, XYZ) + rng.normal(0, 0.3, (n, 2))
        inside = (xy > 0).all(axis=1) & (xy < SIZE).all(axis=1)
        rows += [f"{names[k]},{name}.jpg,{xy[k, 0]:.3f},{xy[k, 1]:.3f}" for k in np.flatnonzero(inside)]
    rows += ["T1,c,100,100"]
    (tmp_path / "points.csv").write_text("\n".join(rows) + "\n")
    control = ["name,x,y,z"] + [f"{m},{X:.4f},{Y:.4f},{Z:.4f}" for m, (X, Y, Z) in zip(names, XYZ)]
    (tmp_path / "control.csv").write_text("\n".join(control) + "\n")
    images = "".join(f'[[images]]\nname = "{m}"\nfile = "{m}.tif"\ncamera = "cam"\n\n' for m in POSES)
    (tmp_path / "project.toml").write_text(
        f"""# A comment that stays.
crs = "EPSG:32632"

[orientation]
height_system = "ellipsoidal"
angle_unit = "gon"
rotation = "{ORDER}"
earth_curvature = "strict"
refraction = true

[observations]
image_points = ["points.csv"]
control = ["control.csv"]
sigma_image = 0.3
sigma_control = [0.02, 0.03]

[cameras.cam]
size = [{SIZE[0]}, {SIZE[1]}]
focal_px = {C}
principal_point_px = [{1999.5 + 12.0}, {1499.5 - 7.0}]
lens = {{ type = "brown", k1 = -0.05 }}

{images}"""
    )
    return tmp_path


def run(folder: Path, *options: str) -> Result:
    return CliRunner().invoke(command, [str(folder / "project.toml"), *options])


def test_images_with_control_are_oriented_and_written(folder: Path) -> None:
    result = run(folder)
    assert result.exit_code == 0, result.output
    project = load_project(folder / "project.toml")
    for name in "ab":
        image = project.image(name)
        truth, angles = POSES[name]
        error = np.array(image.center) - truth
        assert (np.abs(error) < 4 * np.array(image.sigma_center)).all()
        assert np.abs(error).max() < 1.5
        turn = np.array(image.angles) - angles
        assert (np.abs(turn) < 4 * np.array(image.sigma_angles)).all()
        assert np.abs(turn).max() < 0.05
    assert project.image("c").center is None
    text = (folder / "project.toml").read_text()
    assert text.startswith("# A comment that stays.")
    assert (folder / "project.previous.toml").is_file()
    recorded(folder / "project.resect.run.json", "resect", folder / "project.toml", folder / "control.csv")
    first = result.stdout.splitlines()
    assert first[0].startswith("a  ") and "sigma0" in first[0] and "rms 0." in first[0]
    assert re.search(r" · 95 % within 2\.[0-9] times ±$", first[0])
    assert first[1].strip().startswith(("X0 499999.", "X0 500000.")) and "±" in first[1]
    assert first[2].strip().startswith("φ 1.") and "  ω -" in first[2] and "  κ " in first[2] and "gon" in first[2]
    assert "1 images have fewer than 3 control points: c" in result.stderr


def test_the_written_orientation_reproduces_the_points(folder: Path) -> None:
    found = json.loads(run(folder, "--json", "-q").stdout)
    image = load_project(folder / "project.toml").image("a")
    pose = Pose(np.array(image.center), rotation_from_angles(radians(image.angles), ORDER))
    interior = Interior.digital(SIZE, (C, C), (12.0, -7.0))
    camera = oriented_camera(interior, LENS, pose, crs="EPSG:32632", earth_curvature="strict", refraction=True)
    control = np.genfromtxt(folder / "control.csv", delimiter=",", skip_header=1)[:, 1:]
    for point in found["images"][0]["points"]:
        again = project_points(camera, control[int(point["name"][1:]) - 1])
        np.testing.assert_allclose(again - point["xy"], point["residual_px"], atol=2e-3)
    assert found["written"] is True and found["left_out"] == ["c"] and found["failed"] == []
    assert 0.5 < found["images"][0]["sigma0"] < 1.6


@pytest.mark.parametrize("curvature", ["none", "correction", "strict"])
def test_products_use_the_camera_that_was_adjusted(folder: Path, curvature: str) -> None:
    """The camera that `ortho` opens misses the measured points by the residuals that were reported."""
    path = folder / "project.toml"
    terrain = '[terrain]\nheight = 260.0\nheight_system = "same"\n\n[orientation]'
    text = path.read_text().replace("[orientation]", terrain, 1)
    path.write_text(text.replace('earth_curvature = "strict"', f'earth_curvature = "{curvature}"'))
    with rasterio.open(folder / "a.tif", "w", driver="GTiff", width=SIZE[0], height=SIZE[1], count=1, dtype="uint8"):
        pass
    found = json.loads(run(folder, "--images", "a", "--json").stdout)["images"][0]
    camera = open_scene(load_project(path), "a").camera
    control = np.genfromtxt(folder / "control.csv", delimiter=",", skip_header=1)[:, 1:]
    for point in found["points"]:
        again = project_points(camera, control[int(point["name"][1:]) - 1])
        np.testing.assert_allclose(again - point["xy"], point["residual_px"], atol=2e-3)


def test_a_dry_run_changes_nothing(folder: Path) -> None:
    before = (folder / "project.toml").read_text()
    result = run(folder, "--images", "a", "--dry-run", "--json")
    assert (folder / "project.toml").read_text() == before
    assert [i["image"] for i in json.loads(result.stdout)["images"]] == ["a"]
    assert not (folder / "project.previous.toml").exists()


def test_a_dry_run_writes_the_report_that_is_asked(folder: Path) -> None:
    pytest.importorskip("matplotlib")
    before = (folder / "project.toml").read_text()
    result = run(folder, "--images", "a", "--dry-run", "--report", str(folder / "r.html"), "--json")
    assert json.loads(result.stdout)["report"] == str(folder / "r.html") and "sigma0" in (folder / "r.html").read_text()
    assert (folder / "project.toml").read_text() == before and not (folder / "project.resect.run.json").exists()
    inside = run(folder, "--images", "a", "--report", str(folder / "control.csv"), "--overwrite")
    assert isinstance(inside.exception, UsageError) and "is the input" in str(inside.exception)


def test_fault_17_a_wrong_point_is_named(folder: Path) -> None:
    lines = (folder / "points.csv").read_text().splitlines()
    k = next(i for i, line in enumerate(lines) if line.startswith("K4,a"))
    point, image, x, y = lines[k].split(",")
    lines[k] = f"{point},{image},{float(x) + 60},{y}"
    (folder / "points.csv").write_text("\n".join(lines))
    result = run(folder, "--images", "a")
    assert "gross error: point 'K4' misses by -60" in result.stdout
    image = load_project(folder / "project.toml").image("a")
    assert np.abs(np.array(image.center) - POSES["a"][0]).max() < 1.5


def test_an_unknown_camera_constant_is_found_and_written(folder: Path) -> None:
    path = folder / "project.toml"
    path.write_text(path.read_text().replace(f"focal_px = {C}", "focal_px = 9000.0"))
    result = run(folder, "--images", "b", "--unknown-camera-constant")
    assert result.exit_code == 0, result.output
    camera = load_project(path).cameras["cam"]
    assert abs(camera.focal_px - C) < 25.0
    assert camera.principal_point_px == (2011.5, 1492.5)
    assert "  c 32" in result.stdout or "  c 31" in result.stdout
    both = run(folder, "--free", "c")
    assert isinstance(both.exception, UsageError)
    assert "cannot be found for 2 images one by one" in str(both.exception)
    wrong = run(folder, "--free", "c,k9", "--images", "b")
    assert "allows c, x0, y0, k1" in str(wrong.exception)
    radial = run(folder, "--free", "k1", "--images", "b")
    assert radial.exit_code == 0, radial.output
    assert "  k1 " in radial.stdout
    calibrated = load_project(path).cameras["cam"]
    assert calibrated.lens.type == "brown"
    assert abs(calibrated.lens.k1 - LENS.k1) < 5 * calibrated.sigma["k1"]


def test_fault_16_images_without_enough_control(folder: Path) -> None:
    alone = run(folder, "--images", "c")
    assert isinstance(alone.exception, InputError)
    assert "image 'c': 0 control points" in str(alone.exception)
    some = run(folder, "--images", "b", "--images", "c")
    assert isinstance(some.exception, TilesFailed)
    assert "1 of 2 images could not be oriented" in str(some.exception)
    assert load_project(folder / "project.toml").image("b").center is not None
    (folder / "control.csv").write_text("name,x,y,z\nother,1,2,3\n")
    none = run(folder)
    assert isinstance(none.exception, UsageError)
    assert "none of the 3 images has 3 control points" in str(none.exception)


def test_fault_16_collinear_control_never_writes_nan(folder: Path) -> None:
    lines = (folder / "control.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    straight = [f"{m},{500_000 + 20 * k},{5_400_000 + 10 * k},200" for k, (m, *_) in enumerate(rows)]
    (folder / "control.csv").write_text("\n".join([lines[0], *straight]))
    before = (folder / "project.toml").read_text()
    result = run(folder, "--images", "a")
    assert isinstance(result.exception, GeometryError | InputError)
    assert "lie on one line" in str(result.exception)
    assert (folder / "project.toml").read_text() == before


def test_files_given_as_options_replace_the_projects(folder: Path) -> None:
    other = folder / "elsewhere"
    other.mkdir()
    for name in ("points.csv", "control.csv"):
        (folder / name).rename(other / name)
    options = ("--image-points", str(other / "points.csv"), "--control", str(other / "control.csv"))
    result = run(folder, *options, "--sigma-control", "0.05", "0.1", "--sigma-image", "0.4", "--images", "a")
    assert result.exit_code == 0, result.output
    assert load_project(folder / "project.toml").observations.control == ("control.csv",)


@pytest.mark.drawn
def test_the_report_shows_residuals(folder: Path) -> None:
    result = run(folder, "--report", str(folder / "report.html"))
    assert str(folder / "report.html") in result.stdout
    text = (folder / "report.html").read_text()
    assert "Residuals of a" in text and "data:image/png" in text and "K4" in text
    again = run(folder, "--report", str(folder / "report.html"))
    assert isinstance(again.exception, UsageError)
    assert run(folder, "--report", str(folder / "report.html"), "--overwrite").exit_code == 0


def test_film_without_marks_says_what_to_do(folder: Path) -> None:
    path = folder / "project.toml"
    text = path.read_text()
    begin, end = text.index("[cameras.cam]"), text.index("[[images]]")
    marks = "{ 1 = [106.0, -106.0], 2 = [-106.0, -106.0], 3 = [-106.0, 106.0], 4 = [106.0, 106.0] }"
    film = f'[cameras.cam]\ntype = "film"\nsize = [4000, 3000]\ncamera_constant_mm = 153.0\nfiducials_mm = {marks}\n\n'
    path.write_text(text[:begin] + film + text[end:])
    result = run(folder)
    assert "photoplan fiducials" in str(result.exception)


def test_images_need_not_be_there(folder: Path) -> None:
    """Only measurements count; the pixels are not opened."""
    assert not list(folder.glob("*.tif"))
    assert run(folder).exit_code == 0

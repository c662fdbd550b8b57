"""Level and upward photographs, and orientations that are stated with the scene at z > 0."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from tools.command import inside

from photoplan.geometry.pose import ANGLE_UNITS, rotation_from_angles
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import turned_angles, turned_correlation

#: Ecker 1991, section 8.1: the quarry, as printed.
QUARRY = """
format = 1
crs = "EPSG:31256"
[terrain]
height = 214.0
height_system = "same"
[orientation]
height_system = "same"
angle_unit = "gon"
{scene}
[cameras.rc10]
type = "film"
camera_constant_mm = 153.24
{camera}
size = [2300, 2300]
[[images]]
name = "3870"
file = "none.tif"
camera = "rc10"
center = [43429.32, 332890.06, 1014.68]
angles = [{angles}]
fiducials = {{ 1 = [68.0, 131.5], 2 = [62.0, 2248.0], 3 = [2182.0, 2253.0], 4 = [2189.0, 141.0] }}
"""
PRINTED = """principal_point_mm = [-0.001, 0.003]
fiducials_mm = { 1 = [105.999, -106.016], 2 = [-106.012, -106.006], 3 = [-105.997, 105.993], 4 = [106.007, 105.993] }"""
REVERSED = """principal_point_mm = [0.001, 0.003]
fiducials_mm = { 1 = [-105.999, -106.016], 2 = [106.012, -106.006], 3 = [105.997, 105.993], 4 = [-106.007, 105.993] }"""
ANGLES = "200.9777, 0.4335, 40.9304"


def quarry(folder: Path, scene: str = "", camera: str = PRINTED, angles: str = ANGLES) -> Path:
    path = folder / "project.toml"
    path.write_text(QUARRY.format(scene=scene, camera=camera, angles=angles))
    return path


def test_quarry_as_printed_is_the_quarry_turned_by_hand(tmp_path: Path) -> None:
    stated = load_project(quarry(tmp_path, 'scene = "z > 0"'))
    by_hand = load_project(quarry(tmp_path, camera=REVERSED, angles="0.9777, -0.4335, -40.9304"))
    assert stated.cameras == by_hand.cameras
    assert stated.images[0].angles == pytest.approx(by_hand.images[0].angles, abs=1e-10)


@pytest.mark.parametrize("camera", [PRINTED, "mirrored = true\n" + PRINTED])
def test_hints_for_the_quarry_name_the_scene_and_lead_to_the_right_ground(tmp_path: Path, camera: str) -> None:
    """Either hint alone was wrong, and following both (mirrored, then omega − 200) mirrored the ground."""
    said = inside("check", quarry(tmp_path, camera=camera))
    assert said.code == 3
    assert 'scene = "z > 0"' in said.err
    assert "turned by 180" not in said.err
    assert inside("check", quarry(tmp_path, 'scene = "z > 0"')).code == 0


def test_results_are_written_back_in_the_stated_camera_system(tmp_path: Path) -> None:
    path = quarry(tmp_path, 'scene = "z > 0"')
    found = load_project(path)
    angles = [float(a) for a in found.images[0].angles or ()]
    correlation = [0.1 * k for k in range(-7, 8)]
    entries = {"angles": [a + 0.01 for a in angles], "sigma_center": [1.0] * 3, "sigma_angles": [1.0] * 3}
    camera = {"principal_point_mm": [0.005, 0.003]}
    changes = ProjectChanges({"3870": {**entries, "correlation": correlation}}, {"rc10": camera})
    edited = edit_project(path, changes)
    assert "angles = [-199.0123, 0.4235, 40.9204]" in path.read_text()
    assert "principal_point_mm = [-0.005, 0.003]" in path.read_text()
    for project in (edited, load_project(path)):
        assert project.images[0].angles == pytest.approx([a + 0.01 for a in angles], abs=1e-9)
        assert project.images[0].correlation == pytest.approx(correlation)
        assert project.cameras["rc10"].principal_point_mm == (0.005, 0.003)


@pytest.mark.parametrize("order", ["opk", "pok", "kpo", "kop", "okp", "pko"])
def test_half_a_turn_about_x_in_any_order(order: str) -> None:
    angles = [130.0, -20.0, 77.0]
    unit = ANGLE_UNITS["deg"] / (2 * np.pi)
    R, turned = (rotation_from_angles(np.array(a) / unit, order) for a in (angles, turned_angles(angles, "deg", order)))
    assert turned == pytest.approx(R * (1.0, -1.0, -1.0), abs=1e-12)


def test_correlations_turn_twice_into_themselves(tmp_path: Path) -> None:
    camera = load_project(quarry(tmp_path)).cameras["rc10"]
    correlation = tuple(0.05 * k for k in range(15))
    once = turned_correlation(correlation, "opk", camera)
    assert once != correlation
    assert turned_correlation(once, "opk", camera) == correlation


WALL = """
format = 1
crs = "EPSG:32632"
[terrain]
file = "dtm.tif"
height_system = "same"
[orientation]
height_system = "same"
{objects}
[cameras.cam]
type = "frame"
size = [300, 240]
focal_px = 300.0
"""
IMAGE = """
[[images]]
name = "P{k}"
file = "P{k}.tif"
camera = "cam"
center = [{x}, 5400280.0, 55.0]
angles = [{omega}, 0.0, 0.0]
"""


def wall(folder: Path, omega: float, count: int = 1, objects: str = "") -> Path:
    """Photographs to the north from 5 m above level ground of 200 m by 200 m."""
    options = {"crs": "EPSG:32632", "dtype": "float32", "count": 1, "width": 100, "height": 100}
    with rasterio.open(folder / "dtm.tif", "w", transform=from_origin(500000, 5400400, 2, 2), **options) as file:
        file.write(np.full((1, 100, 100), 50.0, np.float32))
    text = WALL.format(objects=objects)
    for k in range(count):
        text += IMAGE.format(k=k, x=500100.0 + 3 * k, omega=omega)
        with rasterio.open(folder / f"P{k}.tif", "w", dtype="uint8", count=1, width=300, height=240) as file:
            file.write(np.full((1, 240, 300), 90, np.uint8))
    path = folder / "project.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(("omega", "count"), [(90.0, 1), (90.0, 3), (95.0, 2), (84.0, 1), (90.0, 8)])
def test_level_photographs_are_plausible(tmp_path: Path, omega: float, count: int) -> None:
    """They were called gon, and refused by `check`, `ortho` and `object`."""
    project = wall(tmp_path, omega, count)
    said = inside("check", project, "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["alternative"] is None
    assert inside("ortho", project, "--resolution", "1", "-o", tmp_path / "out", "--no-quicklook").code == 0


ROOF = {
    "type": "FeatureCollection",
    "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}},
    "features": [
        {
            "type": "Feature",
            "properties": {"name": "canopy"},
            "geometry": {
                "type": "Polygon",
                "coordinates": [
                    [[500090 + x, 5400270 + y, 65.0] for x, y in [(0, 0), (20, 0), (20, 20), (0, 20), (0, 0)]]
                ],
            },
        }
    ],
}


def test_upward_photographs_need_an_object_to_look_at(tmp_path: Path) -> None:
    project = wall(tmp_path, 180.0)
    said = inside("check", project)
    assert said.code == 3
    assert "looks above the horizon" in said.err
    (tmp_path / "roof.geojson").write_text(json.dumps(ROOF))
    objects = '[[objects]]\nfile = "roof.geojson"\nheight_system = "same"'
    said = inside("check", wall(tmp_path, 180.0, objects=objects))
    assert said.code == 0, said.err
    assert "sees objects of the project" in said.out


def test_init_converts_files_with_the_scene_behind_the_image(tmp_path: Path) -> None:
    project = quarry(tmp_path, 'scene = "z > 0"')
    camera = '[cameras.rc10]\ntype = "film"\ncamera_constant_mm = 153.24\nsize = [2300, 2300]\n' + PRINTED
    (tmp_path / "camera.toml").write_text(camera)
    (tmp_path / "poses.csv").write_text("name,x,y,z,omega,phi,kappa\n3870,43429.32,332890.06,1014.68," + ANGLES)
    with rasterio.open(tmp_path / "3870.tif", "w", dtype="uint8", count=1, width=2300, height=2300) as file:
        file.write(np.zeros((1, 2300, 2300), np.uint8))
    said = inside(
        *("init", tmp_path / "new", "--images", tmp_path / "3870.tif", "--camera", tmp_path / "camera.toml"),
        *("--orientation", tmp_path / "poses.csv", "--angle-unit", "gon", "--scene", "z>0", "--crs", "EPSG:31256"),
        *("--terrain", "214", "--height-system", "same"),
    )
    assert said.code == 0, said.err
    made, stated = load_project(tmp_path / "new" / "project.toml"), load_project(project)
    assert made.cameras["rc10"].fiducials_mm == stated.cameras["rc10"].fiducials_mm
    assert made.images[0].angles == pytest.approx([0.9 * a for a in stated.images[0].angles or ()], abs=1e-9)

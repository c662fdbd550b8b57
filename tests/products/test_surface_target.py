"""`photoplan surface --target`: heights over walls and along images, against a map of the same rendered scene."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from tools.command import Said, inside
from tools.facet_scene import GROUND, HEIGHT, Scene, write_scene
from tools.small_block import X0, Y0, write_image

from photoplan.geometry.frames import WallFrame
from photoplan.geometry.pose import angles_from_rotation, rotation_from_angles
from photoplan.report import maps

KINDS = ("", "_sigma", "_count", "_fit", "_grey", "_grey_sigma")
HALF, STEP = 12.0, 1.5
#: Near the middle of the scene, on a corner of the map's pixels.
X, Y = (STEP * round(c / STEP) for c in (X0, Y0))
WALL = WallFrame.facing((X0 - 700.0, Y0 + 300.0, 140.0), 158.0, 4.0)
ON_WALL = f"wall:{X0 - 700},{Y0 + 300},140,158,4"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_scene(tmp_path_factory.mktemp("targets"), 3, size=(100, 100))


def surface(path: Path, *words: object) -> Said:
    common = ("--resolution", STEP, "--reach", 4, "--no-search", "--no-quicklook", "--workers", 1)
    return inside("surface", path, *common, *words)


def around(x: float, y: float) -> tuple[object, ...]:
    return "--bounds", x - HALF, y - HALF, x + HALF, y + HALF


def layers(folder: Path) -> list[np.ndarray]:
    out = []
    for kind in KINDS:
        with rasterio.open(folder / f"surface{kind}.tif") as file:
            out.append(file.read(1))
    return out


def points(path: Path) -> np.ndarray:
    _, _, body = path.read_bytes().partition(b"end_header\n")
    return np.frombuffer(body, [("xyz", "<f8", 3), ("sigma", "<f4"), ("grey", "<f4")])


@pytest.fixture(scope="module")
def on_map(scene: Scene) -> Path:
    said = surface(scene.path, "--start", GROUND, *around(X, Y), "--output", scene.path.parent / "map")
    assert said.code == 0, said.err
    return scene.path.parent / "map"


def test_a_wall_that_lies_is_the_map_to_the_last_bit(scene: Scene, on_map: Path, tmp_path: Path) -> None:
    words = ["--target", "wall:0,0,0,180,90", "--start", GROUND, *around(X, Y), "--output", tmp_path]
    said = surface(scene.path, *words)
    assert said.code == 0, said.err
    for kind, mapped, found in zip(KINDS, layers(on_map), layers(tmp_path)):
        assert mapped.tobytes() == found.tobytes(), kind
    with rasterio.open(on_map / "surface.tif") as mapped, rasterio.open(tmp_path / "surface.tif") as found:
        assert found.crs is None and mapped.crs is not None and found.transform == mapped.transform
    keys = [json.loads((folder / "surface.run.json").read_text())["key"] for folder in (on_map, tmp_path)]
    assert keys[0] != keys[1]


def test_the_scene_stood_up_is_a_wall(scene: Scene, on_map: Path, tmp_path: Path) -> None:
    """The same images, as if what they show stood upright and looked south by east."""
    turned = scene.path.with_name("upright.toml")
    A = np.array(WALL.axes).T

    def stood(match: re.Match[str]) -> str:
        center, angles = (np.array(json.loads(match[k])) for k in (1, 2))
        XYZ = WALL(center - (X, Y, GROUND))
        opk = np.degrees(angles_from_rotation(A @ rotation_from_angles(np.radians(angles))))
        return f"center = {XYZ.tolist()}\nangles = {opk.tolist()}"

    turned.write_text(re.sub(r"center = (.*)\nangles = (.*)", stood, scene.path.read_text()))
    said = surface(turned, "--target", ON_WALL, *around(0, 0), "--output", tmp_path, "--points", tmp_path / "w.ply")
    assert said.code == 0, said.err
    upright, lying = layers(tmp_path), layers(on_map)
    # What is drawn to estimate roughness depends on the place.
    alike = 0.005 * scene.height_of_a_pixel
    assert np.abs(upright[0] - (lying[0] - GROUND)).max() < alike and np.abs(upright[1] - lying[1]).max() < alike
    record = json.loads((tmp_path / "surface.run.json").read_text())
    assert record["settings"]["target"] == ON_WALL and record["frame"]["axes"][2] == pytest.approx(A[:, 2])
    found = points(tmp_path / "w.ply")
    uvh = np.add(WALL.inverse(found["xyz"]), (X, Y, GROUND))
    off = uvh[:, 2] - scene.heights(uvh[:, 0], uvh[:, 1])
    assert len(found) == 256 and np.sqrt(np.mean(off**2)) < 0.05 * scene.height_of_a_pixel
    assert b"sigma of the height over the target" in (tmp_path / "w.ply").read_bytes()[:300]
    # It is no terrain: nothing says where it lies on the map.
    project = turned.with_name("terrain.toml")
    stated = scene.path.read_text().replace(f"height = {GROUND}", f'file = "{tmp_path}/surface.tif"')
    project.write_text(stated)
    said = inside("ortho", project, "--images", "i2", "--resolution", 0.5, "--output", tmp_path / "o", "--no-quicklook")
    assert said.code == 3 and f"heights over {ON_WALL}, which is no map" in said.err, said.err
    project.write_text(stated.replace('surface.tif"', 'surface.tif"\ncrs = "EPSG:32633"'))
    said = inside("ortho", project, "--images", "i2", "--resolution", 0.5, "--output", tmp_path / "o", "--no-quicklook")
    assert said.code == 3 and "which is no map" in said.err, said.err
    # Nor is a copy on which somebody put a CRS.
    with rasterio.open(tmp_path / "surface.tif") as file:
        rasterio.shutil.copy(file, tmp_path / "copy.tif", driver="GTiff")
    with rasterio.open(tmp_path / "copy.tif", "r+") as file:
        file.crs = "EPSG:32633"
    project.write_text(stated.replace("surface.tif", "copy.tif"))
    said = inside("ortho", project, "--images", "i2", "--resolution", 0.5, "--output", tmp_path / "o", "--no-quicklook")
    assert said.code == 3 and "which is no map" in said.err, said.err


def test_a_picture_names_what_is_along_its_axes(on_map: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def kept(figure: Any) -> bytes:
        drawn.extend(ax.get_xlabel() + ax.get_ylabel() for ax in figure.axes)
        return b""

    monkeypatch.setattr(maps, "png", kept)
    maps.draw_surface(on_map / "surface.tif", ("u", "v"))
    assert drawn == ["v [m]", "", "u [m]v [m]", "u [m]", "m", "m", ""]


def test_heights_along_an_image_are_the_ground(scene: Scene, tmp_path: Path) -> None:
    words = ["--target", f"image:i2,{HEIGHT:g}", *around(0, 0), "--output", tmp_path, "--points", tmp_path / "i.ply"]
    said = surface(scene.path, *words)
    assert said.code == 0, said.err
    found = points(tmp_path / "i.ply")
    x, y, z = found["xyz"].T
    off = z - scene.heights(x, y)
    print(len(found), np.sqrt(np.mean(off**2)) / scene.height_of_a_pixel, np.sqrt(np.mean((off / found["sigma"]) ** 2)))
    assert len(found) == 256 and np.sqrt(np.mean(off**2)) < 0.05 * scene.height_of_a_pixel
    assert 0.5 < np.sqrt(np.mean((off / found["sigma"]) ** 2)) < 1.6


def test_bands_are_chosen(scene: Scene, on_map: Path, tmp_path: Path) -> None:
    """Of images with noise in two bands that are not taken, the third gives what it gives alone."""
    for path in scene.path.parent.glob("rendered/*.tif"):
        with rasterio.open(path) as file:
            own = file.read(1)
        noise = np.random.default_rng(0).integers(1, 255, own.shape, np.uint8)
        write_image(tmp_path / path.name, np.stack([noise, noise[::-1], own]))
    project = scene.path.with_name("bands.toml")
    project.write_text(scene.path.read_text().replace('"rendered/', f'"{tmp_path}/'))
    said = surface(project, "--bands", 3, "--start", GROUND, *around(X, Y), "--output", tmp_path)
    assert said.code == 0, said.err
    assert layers(tmp_path)[0].tobytes() == layers(on_map)[0].tobytes()


def test_an_image_has_its_own_bounds_and_the_distance_of_the_terrain(scene: Scene) -> None:
    said = surface(scene.path, "--target", "image:i2", "--dry-run", "--json")
    plan = json.loads(said.out)
    assert plan["frame"]["distance"] == pytest.approx(HEIGHT, rel=0.02) and plan["target"] == "image:i2"
    assert plan["bounds"] == pytest.approx([-25.5, -25.5, 25.5, 25.5], abs=1.5)


def test_targets_that_are_none(scene: Scene) -> None:
    far = HEIGHT - 1
    for words, code, text in (
        (["--target", "wal:1,2"], 2, "give `map`, `wall:X,"),
        (["--target", "wall:1,2,3"], 2, "azimuth"),
        (["--target", "vault:1,2,3,4"], 2, "the radius"),
        (["--target", "vault:1,2,3,4,0"], 2, "the radius"),
        (["--target", "column:1,2,3,4,5,6"], 2, "that its middle faces"),
        (["--target", "wall:1,2,3,4,95"], 2, "azimuth"),
        (["--target", "wall:1,2,3,nan"], 2, "azimuth"),
        (["--target", ON_WALL], 2, "it has no end; give --bounds"),
        (["--target", ON_WALL, *around(0, 0)], 3, "no two images see"),
        (["--target", "wall:0,0,0,0,-90", *around(-X, -Y)], 3, "all images stand behind the target"),
        (["--target", f"vault:{X0},{Y0},{GROUND},0,3", *around(0, 0)], 2, "reach 4 m: its heights go to 2.7 m"),
        (["--target", f"vault:{X0},{Y0},{GROUND},0,30", *around(0, 0)], 3, "a vault is seen from inside its radius"),
        (["--target", "image:none"], 3, "image 'none' is not in the project"),
        (["--target", "wall:1e300,2,3,4", *around(0, 0)], 2, "lies on no map"),
        (["--target", f"wall:{Y0},{X0},140,4", *around(0, 0)], 2, "are X and Y exchanged"),
        (["--target", "image:i2,-5"], 2, "give a distance from 0.001"),
        (["--target", "image:i2,x"], 2, "give a distance from 0.001"),
        (["--target", "image:i2,1e300"], 2, "give a distance from 0.001"),
        (["--target", "image:i2", "--bounds", 0.1, 0.1, 0.4, 0.4], 2, "bounds 0.10 0.10 0.40 0.40 hold 1 × 1"),
        (["--target", "image:i2", "--start", "a.tif"], 2, "on a target that is no map give a height"),
        (["--target", "image:i2,200", "--start", -far], 2, "its heights go from"),
    ):
        said = surface(scene.path, *words, "--dry-run")
        assert said.code == code and text in said.err, (words, said.err)
    level = scene.path.with_name("level.toml")
    level.write_text(re.sub(r"angles = .*", "angles = [90.0, 0.0, 0.0]", scene.path.read_text()))
    said = surface(level, "--target", "image:i2", "--dry-run")
    assert said.code == 2 and "meets no terrain; say `image:i2,DISTANCE`" in said.err, said.err
    bent = scene.path.with_name("bent.toml")
    bent.write_text(scene.path.read_text().replace("[orientation]", '[orientation]\nearth_curvature = "strict"'))
    said = surface(bent, "--target", "image:i2", "--dry-run")
    assert said.code == 3 and 'earth_curvature = "none"' in said.err, said.err

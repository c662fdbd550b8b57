"""What commands take for the ground of a project with objects: with them, or bare."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from tools.command import Here
from tools.real_projects import drone_project
from tools.recorded import recorded
from tools.small_block import CRS, X0, Y0, Z0, Block, make_project, write_terrain

from photoplan.io.project.file import load_project
from photoplan.io.raster import RasterReader
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.products.adjust.sensors import nadir_heights
from photoplan.products.control import Ortho, choose_patches
from photoplan.products.monoplot import _unknown_on_objects
from photoplan.products.tie import _placed
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.ground import ground_of
from photoplan.project.scene import open_scene
from photoplan.terrain.analysis import MonoplotErrors, monoplot

GROUND, DECK = 100.0, 250.0


def with_object(project: Path, ring: np.ndarray, crs: str = CRS, role: str = "paint") -> Path:
    """A project beside another one, with a level polygon in the air."""
    layer = VectorLayer("deck", "Polygon Z", [shapely.Polygon(ring)], {"name": np.array(["deck"], object)})
    write_geopackage(project.with_name("deck.gpkg"), [layer], crs)
    path = project.with_name("objects.toml")
    entry = f'\n[[objects]]\nfile = "deck.gpkg"\nheight_system = "same"\nrole = "{role}"\n'
    path.write_text(project.read_text() + entry)
    return path


@pytest.fixture
def decked(small: Block) -> tuple[Path, Path]:
    """Projects of level ground: bare, and with a deck of 60 m below the first camera, 150 m above the ground."""
    write_terrain(small.terrain, np.full((60, 64), GROUND))
    make_project(small)
    square = np.array([(-30, -30, DECK), (30, -30, DECK), (30, 30, DECK), (-30, 30, DECK)])
    return small.project, with_object(small.project, square + np.array((X0, Y0, 0)))


def told(photoplan: Here, *words: object) -> Any:
    said = photoplan(*words, "--json")
    assert said.code == 0, said.err
    return json.loads(said.out)


@pytest.mark.parametrize("files", ["with files", "without files"])
def test_check_tells_figures_of_the_ground(photoplan: Here, decked: tuple[Path, Path], files: str) -> None:
    if files == "without files":
        for image in (decked[0].parent / "images").iterdir():
            image.unlink()
    bare, over = (told(photoplan, "check", project) for project in decked)
    assert bare == over and bare["images"][0]["gsd"] == pytest.approx((Z0 - GROUND) / 200, rel=0.01)


def test_a_camera_below_a_bridge_is_not_below_the_ground(photoplan: Here, decked: tuple[Path, Path]) -> None:
    text = decked[1].read_text()
    decked[1].write_text(text.replace('"same"\nrole', '"same"\noffset = [0.0, 0.0, 200.0]\nrole'))
    assert told(photoplan, "check", decked[1]) == told(photoplan, "check", decked[0])
    found = told(photoplan, "ortho", decked[1], "--images", "one", "--dry-run")
    assert found == told(photoplan, "ortho", decked[0], "--images", "one", "--dry-run")
    points = decked[0].with_name("points.csv")
    points.write_text("name,x,y\nmiddle,99.5,74.5\n")
    met = told(photoplan, "monoplot", decked[1], "one", points, "-o", points.with_name("ground.csv"))
    assert met["met"] == 1


def test_budget_is_on_the_level_of_the_ground(photoplan: Here, decked: tuple[Path, Path]) -> None:
    stated = ("--sigma-terrain", 0.5, "--sigma-center", 0.2, 0.2, 0.2, "--sigma-angles", 0.01, 0.01, 0.01)
    bare, over = (told(photoplan, "budget", project, *stated) for project in decked)
    assert bare == over and bare["images"][0]["gsd_m"] == pytest.approx((Z0 - GROUND) / 200, rel=0.01)


def test_monoplot_takes_what_a_ray_meets_first(photoplan: Here, decked: tuple[Path, Path], tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    points.write_text("name,x,y\nmiddle,99.5,74.5\ncorner,3,3\n")
    for role in ("paint", "occluder"):
        decked[1].write_text(decked[1].read_text().replace('role = "paint"', f'role = "{role}"'))
        rows = []
        for k, project in enumerate(decked):
            out = tmp_path / f"{role}{k}.csv"
            found = told(photoplan, "monoplot", project, "one", points, "-o", out, "--sigma-terrain", 0.3)
            assert found["met"] == 2
            rows.append(list(csv.DictReader(out.read_text().splitlines())))
        (bare, over) = rows
        assert [float(row["Z"]) for row in bare] == pytest.approx([GROUND, GROUND], abs=1e-3)
        assert [float(row["Z"]) for row in over] == pytest.approx([DECK, GROUND], abs=1e-3)
        assert over[1] == bare[1] and all(row["sigma_Z"] for row in over)
    record = recorded(tmp_path / "paint1.run.json", "monoplot", decked[1])
    assert any(each["path"].endswith("deck.gpkg") for each in record["inputs"])


def test_standard_deviations_of_the_terrain_are_none_of_objects(decked: tuple[Path, Path]) -> None:
    project = load_project(decked[1])
    ground = ground_of(project)
    errors = MonoplotErrors(0.5, 0.3)
    found = monoplot(
        camera_without_pixels(project, "one"), [(99.5, 74.5), (3, 3)], ground.surface, (100, 250), errors, 10
    )
    assert np.isfinite(found.sigmas).all()
    (note,) = _unknown_on_objects(found, ground)
    assert note.startswith("1 points lie on objects")
    assert np.isnan(found.sigmas[0]).all() and np.isfinite(found.sigmas[1]).all()


def test_tie_and_adjust_take_the_ground_below_a_camera(decked: tuple[Path, Path]) -> None:
    for project in map(load_project, decked):
        levels = _placed(project, project.images)[1]
        heights = nadir_heights(project, np.array([(X0, Y0)]), 7.0)
        assert levels == pytest.approx([GROUND] * 3, abs=1e-3) and heights == pytest.approx([GROUND], abs=1e-3)


def test_control_takes_the_ground_and_no_place_of_an_object(block: Path, tmp_path: Path) -> None:
    bare = drone_project(block, tmp_path, "DJI_0026")
    project = load_project(bare)
    ortho = Ortho((RasterReader(block / "ref_ortho_from_cloud.tif"),))
    _, before = choose_patches(ortho, [open_scene(project, "DJI_0026")], 8, 8, 5.0)
    X = float(np.median([patch.XYZ[0] for patch in before]))
    Y = before[0].XYZ[1]
    half = np.array([(X, Y - 200, 400), (X + 200, Y - 200, 400), (X + 200, Y + 200, 400), (X, Y + 200, 400)])
    over = load_project(with_object(bare, half, project.crs))
    _, after = choose_patches(ortho, [open_scene(over, "DJI_0026")], 8, 8, 5.0)
    assert max(patch.XYZ[0] for patch in after) < X + 0.1 < max(patch.XYZ[0] for patch in before)
    west = {patch.XYZ for patch in before if patch.XYZ[0] < X - 10}
    assert len(west) > 5 and west <= {patch.XYZ for patch in after}

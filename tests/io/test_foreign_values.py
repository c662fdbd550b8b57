"""Values of wrong types and sizes in JSON and in layers: refused by name, never a traceback."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import shapely
from pyproj import CRS, Transformer
from tools.command import inside
from tools.small_block import write_block

from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs
from photoplan.io.files import parse_json, whole_number
from photoplan.io.formats import read_cameras, read_orientation_block
from photoplan.io.objects import read_objects
from photoplan.io.project.file import load_project
from photoplan.io.vector_layer import PlanTables, read_columns, read_features, read_plan_tables, write_plan_tables


@pytest.mark.parametrize(
    "text", ["9" * 5000, "[1e999]", "NaN", "[" * 100_000, "{", '{"a": -Infinity}', "1" + "0" * 400]
)
def test_json_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"a\.json"):
        parse_json(text, "a.json")


def test_whole_numbers_of_any_length_are_numbers() -> None:
    assert parse_json("[123456789012345678, 100000000000000000000000]", "a") == [123456789012345678, 1e23]


@pytest.mark.parametrize(
    "name",
    [
        "digits5000.city.json",
        "huge_coordinate.city.jsonl",
        "huge_integer.city.jsonl",
        "metadata_number.city.json",
        "transform_number.city.json",
    ],
)
def test_city_models_of_wrong_types(shared: Path, name: str) -> None:
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        read_objects(shared / "cases" / "cityjson" / name)


@pytest.mark.parametrize("value", ["[]", "[[1]]", "{a = 1}", "5", "inf"])
@pytest.mark.parametrize("key", ["camera", "file"])
def test_names_of_other_types_in_a_project(tmp_path: Path, key: str, value: str) -> None:
    """Sizes of film scans are looked up before the entries are checked."""
    path = tmp_path / "project.toml"
    entry = {"camera": '"c"', "file": '"a.tif"'} | {key: value}
    path.write_text(
        f"[cameras.c]\ntype = 'film'\n[[images]]\nname = 'a'\ncamera = {entry['camera']}\nfile = {entry['file']}\n"
        "fiducials = {a = [1.0, 2.0]}\n"
    )
    with pytest.raises(InputError, match=r"project\.toml"):
        load_project(path)


@pytest.mark.parametrize("entry", ["focal_px = 1e308", "focal_px = 1e16"])
def test_finite_numbers_beyond_all_cameras(tmp_path: Path, entry: str) -> None:
    project = write_block(tmp_path / "block").project
    project.write_text(project.read_text().replace("focal_px = 200.0", entry))
    for command in (("check", project), ("ortho", project, "--dry-run"), ("balance", project)):
        said = inside(*command)
        assert said.code == 3 and "focal_px: 1e" in said.err and "than or equal to" in said.err


def reconstruction(path: Path, origin: bool = True) -> dict[str, object]:
    """Write a reconstruction whose origin may be one of OpenDroneMap, and return a shot of it."""
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32616", always_xy=True)
    lon, lat = to_map.transform(698_636.0, 1_558_200.0, direction="INVERSE")
    lla = {"reference_lla": {"latitude": lat, "longitude": lon, "altitude": 0.0}} if origin else {}
    shot = {"rotation": [3.0, 0.0, 0.0], "translation": [0.0, 0.0, 100.0], "camera": "c"}
    path.write_text(json.dumps([{"shots": {"a": shot, "b": shot}, "cameras": {}, **lla}]))
    return shot


@pytest.mark.parametrize("beside", ["r.topocentric.json", "odm_report/shots.geojson", "reference_lla.json"])
@pytest.mark.parametrize("content", ["[1]", '[{"shots": null}]', '{"features": [1]}', '{"features": {"a": 1}}', "5"])
def test_files_beside_a_reconstruction_are_checked_like_itself(tmp_path: Path, beside: str, content: str) -> None:
    path = tmp_path / "r.json"
    reconstruction(path, origin=beside != "reference_lla.json")
    (tmp_path / beside).parent.mkdir(exist_ok=True)
    (tmp_path / beside).write_text(content)
    with pytest.raises(InputError, match=r"topocentric\.json|shots\.geojson|reference_lla"):
        read_orientation_block(path, format="opensfm")
    path.write_text('[{"shots": [1]}]')
    with pytest.raises(InputError, match=r"r\.json: not a reconstruction"):
        read_orientation_block(path, format="opensfm")


@pytest.mark.parametrize("rotation", [["x", 1, 2], [1, 2], [[1], [2], [3]], [10**30, None, 0]])
def test_rotations_of_other_kinds_beside_a_reconstruction(tmp_path: Path, rotation: list[object]) -> None:
    shot = reconstruction(tmp_path / "r.json")
    (tmp_path / "r.topocentric.json").write_text(json.dumps([{"shots": {"a": shot | {"rotation": rotation}}}]))
    with pytest.raises(InputError, match=r"r\.topocentric\.json"):
        read_orientation_block(tmp_path / "r.json", format="opensfm")


@pytest.mark.parametrize("word", ["²", "٣²", "9" * 5000, "9" * 400, "-", ""])
def test_words_that_are_no_whole_numbers(tmp_path: Path, word: str) -> None:
    assert whole_number(word) is None and whole_number("007") == 7
    (tmp_path / "cameras.txt").write_text(f"1 {word or 'x'} 400 300 500 200 150\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(InputError, match=r"cameras\.txt"):
        read_orientation_block(tmp_path, format="colmap")
    pix4d = tmp_path / "x_calibrated_camera_parameters.txt"
    pix4d.write_text(f"h\n\na.jpg {word or 'x'} 300\n" + "1 0 0\n" * 9)
    with pytest.raises(InputError, match="x_calibrated"):
        read_orientation_block(pix4d, format="pix4d")
    camera = tmp_path / "c.yaml"
    camera.write_text(
        f"c:\n  type: pinhole\n  im_size: [{word or 'x'}, 150]\n  focal_len: 200\n  sensor_size: [2, 1]\n"
    )
    with pytest.raises(InputError, match=r"c\.yaml"):
        read_cameras(camera)


def test_a_unit_of_angles_without_end() -> None:
    wkt = CRS("EPSG:32633").to_wkt("WKT1_GDAL").replace("0.0174532925199433", "1e308")
    with pytest.raises(InputError, match=r"unit of angles of 1e\+308 rad"):
        parse_crs(wkt)


def test_a_spike_of_a_thousand_kilometres(shared: Path) -> None:
    """The last of five walls goes up, down and along itself: it is filled like those that touch themselves."""
    found = read_objects(shared / "cases" / "cityjson" / "ring_of_numbers.geojson")
    assert found.names == ("f0", "f1", "f2", "f3", "f4") and {*found.owner.tolist()} == {0, 1, 2, 3, 4}
    assert not found.faults and found.corners[..., 2].max() == pytest.approx(1e6)


def test_layers_without_geometry(shared: Path) -> None:
    with pytest.raises(InputError, match=r"nogeom\.gpkg: holds no layer with geometry"):
        read_features(shared / "cases" / "vector_without_geometry" / "nogeom.gpkg", "Polygon")
    with pytest.raises(InputError, match=r"seams\.gpkg: holds no Polygon"):
        read_features(shared / "cases" / "vector_empty" / "seams.gpkg", "Polygon")


def plan(path: Path) -> Path:
    tiles = {"product": np.array(["a", "a"], object), "tile": np.arange(2), "sources": np.array(["0", "0 1"], object),
             "cells": np.arange(2), "residual_px": np.zeros(2)}  # fmt: skip
    outline = shapely.get_coordinates(shapely.box(0, 0, 1, 1))
    bounds = np.array([[0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 2.0, 1.0]])
    write_plan_tables(
        path, PlanTables({"a": 1}, tiles, bounds, {"product": np.array(["a"], object)}, [outline], "EPSG:31287")
    )
    return path


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("UPDATE tiles SET sources = NULL WHERE fid = 2", "row 2: sources is 'None'; it must be a text"),
        ("UPDATE tiles SET tile = NULL", "row 1: tile .* it must be an integer"),
        ("UPDATE tiles SET residual_px = NULL", "row 1: residual_px .* it must be a number"),
        ("DROP TABLE tiles", "not a plan of photoplan"),
        ("ALTER TABLE tiles RENAME COLUMN cells TO x", "no column cells|cannot be read"),
        ("UPDATE photoplan_plan SET content = '[1]'", "header"),
        ("UPDATE photoplan_plan SET content = x'00'", "header"),
        ("UPDATE photoplan_plan SET format = 'x'", "plan format"),
        ("DELETE FROM photoplan_plan", "plan format"),
    ],
)
def test_damaged_plans_are_refused(tmp_path: Path, statement: str, told: str) -> None:
    path = plan(tmp_path / "plan.gpkg")
    assert read_plan_tables(path)[0] == {"a": 1}
    with closing(sqlite3.connect(path)) as db:
        for (trigger,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            db.execute(f'DROP TRIGGER "{trigger}"')
        db.execute(statement)
        db.commit()
    with pytest.raises(InputError, match=rf"plan\.gpkg.*({told})"):
        read_plan_tables(path)


def test_columns_have_the_kind_that_is_asked_for(tmp_path: Path) -> None:
    path = plan(tmp_path / "plan.gpkg")
    assert read_columns(path, "tiles", {"tile": "integer"})["tile"].tolist() == [0, 1]
    with pytest.raises(InputError, match="it must be a number"):
        read_columns(path, "tiles", {"product": "number"})

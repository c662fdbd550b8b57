"""Values of wrong types and sizes in JSON and in layers: refused by name, never a traceback."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import shapely

from photoplan.errors import InputError
from photoplan.io.objects.file import read_objects
from photoplan.io.plain_files import parse_json
from photoplan.io.plan_file import PlanTables, read_plan_tables, write_plan_tables
from photoplan.io.polygons import read_features
from photoplan.io.vector_layer import read_columns


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


def test_a_ring_of_numbers(shared: Path) -> None:
    try:
        read_objects(shared / "cases" / "cityjson" / "ring_of_numbers.geojson")
    except InputError as error:
        assert "ring_of_numbers" in str(error)


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

"""Descriptions of fiducial marks: read, written, refused; every kind becomes a pattern."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pydantic import TypeAdapter, ValidationError

from photoplan.cameras.fiducials import MarkExample, MarkPattern
from photoplan.cameras.marks import Mark
from photoplan.errors import InputError
from photoplan.io.camera.model import FilmEntry
from photoplan.io.formats import read_cameras
from photoplan.io.project.file import camera_lines
from photoplan.project.camera_marks import mark_pattern, mark_patterns

KINDS: list[dict[str, Any]] = [
    {"type": "cross", "arm": 1.0, "width": 0.1, "free": 0.2, "rotation": 45.0},
    {"type": "dot", "diameter": 0.3, "bright": False, "margin": 0.5},
    {"type": "ring", "diameter": 1.0, "width": 0.1},
    {"type": "ring_cross", "diameter": 1.0, "width": 0.1, "arm": 0.4, "cross_width": 0.05},
    {"type": "dot_cross", "diameter": 0.2, "arm": 1.0, "width": 0.1},
    {
        "type": "polygon",
        "parts": [{"outline": [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], "tone": 1.0}],
        "background": 0.0,
        "window": (-1.0, -1.0, 2.0, 2.0),
        "rotation": 90.0,
    },
    {"type": "block", "ledge": 3.0, "depth": 1.6, "tip": 1.8, "height": 3.0, "slit": 0.1, "inside": 0.4},
    {"type": "curve", "ledge": 3.0, "depth": 2.0, "rise": 3.2, "run": 4.0, "window": (-3.0, -2.0, 0.4, 0.4)},
    {"type": "notch", "reach": 2.5, "tip": 1.9, "shoulder": 2.2, "angle": 46.0, "mirrored": True},
    {"type": "triangle", "flanks": (225.0, 315.0), "near": 0.3, "far": 2.5, "inside_bright": True},
    {"type": "arc", "arm": 1.0, "width": 0.1, "tip": 4.0, "depth": 2.4, "rise": 4.5, "run": 8.0, "rotation": 180.0},
]
BASE: dict[str, Any] = {
    "type": "film",
    "camera_constant_mm": 153.0,
    "fiducials_mm": {"1": (110.0, 110.0), "2": (-110.0, 110.0), "3": (0.0, -110.0)},
}
CAMERA = TypeAdapter(FilmEntry)


def camera(marks: Any) -> FilmEntry:
    return CAMERA.validate_python({**BASE, "marks": marks})


@pytest.mark.parametrize("entry", KINDS, ids=lambda e: e["type"])
def test_every_kind_becomes_a_pattern(entry: dict[str, Any]) -> None:
    made = mark_pattern(TypeAdapter(Mark).validate_python(entry), Path())
    assert isinstance(made, MarkPattern)
    assert made.name == entry["type"]


def test_one_description_serves_all_marks() -> None:
    made = mark_patterns(camera(KINDS[0]).fiducial_system, Path())
    assert list(made) == ["1", "2", "3"]
    assert made["1"] is made["3"]


def test_each_mark_may_have_its_own() -> None:
    made = mark_patterns(camera({"1": KINDS[0], "2": KINDS[1], "3": KINDS[6]}).fiducial_system, Path())
    assert [each.name for each in made.values()] == ["cross", "dot", "block"]


@pytest.mark.parametrize("marks", [KINDS[0], {"1": KINDS[5], "2": KINDS[6], "3": KINDS[9]}, None])
def test_a_description_is_the_same_after_writing(tmp_path: Path, marks: Any) -> None:
    given = CAMERA.validate_python(BASE if marks is None else {**BASE, "marks": marks})
    path = tmp_path / "camera.toml"
    path.write_text("\n".join(camera_lines("film", given)), encoding="utf-8")
    assert tomllib.loads(path.read_text(encoding="utf-8"))["cameras"]["film"].get("marks") is not None or marks is None
    assert read_cameras(path).cameras == {"film": given}


@pytest.mark.parametrize(
    ("marks", "message"),
    [
        ({"type": "cros", "arm": 1.0, "width": 0.1}, "does not match any of the expected tags"),
        ({"type": "cross", "arm": -1.0, "width": 0.1}, "greater than 0"),
        ({"type": "cross", "arm": 1.0, "width": 0.1, "lenght": 2.0}, "Extra inputs"),
        ({"type": "cross", "arm": float("nan"), "width": 0.1}, "finite|greater"),
        ({"type": "dot", "diameter": 1e300}, "less than or equal to 1000"),
        ({"type": "dot", "diameter": "0.1"}, "valid number"),
        ({"1": KINDS[0]}, "does not describe fiducial mark 2, 3"),
        ({"1": KINDS[0], "2": KINDS[0], "3": KINDS[0], "9": KINDS[0]}, "describes 9; fiducials_mm has 1, 2, 3"),
        ({}, "no mark is described"),
        (3, "valid dictionary"),
        ({"1": 3, "2": 3, "3": 3}, "valid dictionary"),
        ({"type": "example", "file": "a.tif", "reference": (1.0, 1.0), "pixel_um": 25.0, "rotation": 45}, "0, 90"),
        ({"type": "polygon", "parts": [{"outline": [(0.0, 0.0), (1.0, 1.0)]}]}, "at least 3"),
    ],
)
def test_wrong_descriptions_are_refused(marks: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        camera(marks)


def test_impossible_numbers_name_the_mark() -> None:
    given = camera({"1": KINDS[0], "2": {"type": "ring", "diameter": 1.0, "width": 0.6}, "3": KINDS[0]})
    with pytest.raises(InputError, match=r"fiducial mark .2.: ring: width 0\.6 mm"):
        mark_patterns(given.fiducial_system, Path())


def test_a_camera_without_descriptions_says_how_to_add_them() -> None:
    with pytest.raises(InputError, match="add `marks`"):
        mark_patterns(CAMERA.validate_python(BASE).fiducial_system, Path())


def write(path: Path, values: np.ndarray) -> None:
    profile = {"driver": "PNG", "height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", **profile) as out:
        out.write(values, 1)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize(("rotation", "mirrored"), [(0, False), (90, False), (180, True), (270, True)])
def test_an_example_is_read_and_turned_with_its_reference(tmp_path: Path, rotation: int, mirrored: bool) -> None:
    values = np.full((20, 30), 10, np.uint8)
    values[4, 22] = 200
    write(tmp_path / "mark.png", values)
    entry = {
        "type": "example",
        "file": "mark.png",
        "reference": (22.0, 4.0),
        "pixel_um": 20.0,
        "rotation": rotation,
        "mirrored": mirrored,
    }
    made = mark_patterns(camera(entry).fiducial_system, tmp_path)["1"]
    assert isinstance(made, MarkExample)
    assert made.pixel_mm == pytest.approx(0.02)
    column, row = (int(each) for each in made.reference)
    assert made.values[row, column] == 200
    # Anticlockwise: what was at the right is at the top after a quarter.
    assert made.values.shape == ((30, 20) if rotation in (90, 270) else (20, 30))
    if rotation == 90:
        assert (column, row) == (4, 7)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_examples_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    entry = {"type": "example", "file": "mark.png", "reference": (22.0, 4.0), "pixel_um": 20.0}
    with pytest.raises(InputError, match=r"mark\.png"):
        mark_patterns(camera(entry).fiducial_system, tmp_path)
    write(tmp_path / "mark.png", np.zeros((8, 5000), np.uint8))
    with pytest.raises(InputError, match="up to 4096"):
        mark_patterns(camera(entry).fiducial_system, tmp_path)
    write(tmp_path / "mark.png", np.zeros((9, 9), np.uint8))
    with pytest.raises(InputError, match="far outside"):
        mark_patterns(camera({**entry, "reference": (500.0, 4.0)}).fiducial_system, tmp_path)
    with pytest.raises(InputError, match="virtual file systems"):
        mark_patterns(camera({**entry, "file": "/vsicurl/http://a.org/b.png"}).fiducial_system, tmp_path)

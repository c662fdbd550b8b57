"""A camera kind is one file and a registry line: everything else asks the camera."""

from __future__ import annotations

import ast
import inspect
import re
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest

import photoplan
from photoplan.cameras import curvature as curved
from photoplan.cameras import curvature as warped
from photoplan.cameras import frame, framed
from photoplan.cameras.lenses import Brown, Fisheye, NoLens, OpenCV
from photoplan.io.camera.model import BrownLens, Camera, CameraEntry, IdealLens, OpenCVFisheyeLens, OpenCVLens

ROOT = Path(photoplan.__file__).parent
#: Classes of the registry.
DESCRIBED = [get_args(kind)[0] for kind in get_args(get_args(Camera)[0])]
#: All classes of kinds, described and computing, and their makers.
KINDS = {"FrameCamera", "WarpedCamera", "corrected_camera", "curved_camera", "LineCamera", "FilmCamera"} | {
    kind.__name__ for kind in DESCRIBED
}
#: Files that may name a kind, and why.
ALLOWED = {
    "cameras/pushbroom.py": "a kind",
    "cameras/correctable.py": "corrections of a kind",
    "io/camera/line.py": "makes a kind of what files state",
    "__init__.py": "public names",
    "cameras/__init__.py": "public names",
    "cameras/frame.py": "a kind",
    "cameras/curvature.py": "a kind",
    "cameras/framed.py": "registry of cameras that compute, and kinds in other axes",
    "io/camera/satellite.py": "makes a kind of what files state",
    "io/camera/model.py": "kinds, and their registry",
    "io/orientation/projects.py": "reads a format that knows frames in millimetres alone",
}


def named(file: Path) -> set[str]:
    """Kinds that the code of a file names, strings included (they may be imports by name)."""
    words: set[str] = set()
    source = file.read_text(encoding="utf-8")
    if not any(kind in source for kind in KINDS):
        return words
    for node in ast.walk(ast.parse(source)):
        for value in (getattr(node, field, None) for field in ("id", "attr", "name", "value")):
            if isinstance(value, str) and "\n" not in value:
                words.update(value.replace(".", " ").split())
    return words & KINDS


def test_only_a_kinds_own_file_and_the_registries_name_it() -> None:
    naming = {file.relative_to(ROOT).as_posix() for file in ROOT.rglob("*.py") if named(file)}
    assert naming == set(ALLOWED)


def test_the_names_are_those_of_the_code() -> None:
    assert {c.__name__ for c in DESCRIBED} == {"FrameEntry", "FilmEntry"}
    assert all(hasattr(module, name) for module, name in ((frame, "FrameCamera"), (warped, "WarpedCamera")))
    assert all(hasattr(module, name) for module, name in ((framed, "corrected_camera"), (curved, "curved_camera")))


@pytest.mark.parametrize("kind", DESCRIBED)
def test_a_kind_is_complete(kind: type[CameraEntry]) -> None:
    """It has no abstract part, and a comment for every entry that is written."""
    assert not inspect.isabstract(kind)
    assert set(kind.comments) | {"lens", "restore", "sigma"} == set(kind.model_fields)


@pytest.mark.parametrize(
    ("entry", "lens"), [(BrownLens, Brown), (OpenCVLens, OpenCV), (OpenCVFisheyeLens, Fisheye), (IdealLens, NoLens)]
)
def test_a_described_lens_has_the_coefficients_of_the_lens_that_computes(entry: type, lens: type) -> None:
    own = [name for name in entry.model_fields if name not in ("type", "unit", "y_axis", "meaning")]
    assert own == [field.name for field in fields(lens)]


def test_no_file_is_longer_than_1200_lines() -> None:
    long = {str(file.relative_to(ROOT)): len(file.read_text().splitlines()) for file in ROOT.rglob("*.py")}
    assert {name: lines for name, lines in long.items() if lines > 1200} == {}


def test_a_class_name_has_one_meaning() -> None:
    homes: dict[str, list[str]] = {}
    for file in ROOT.rglob("*.py"):
        for name in re.findall(r"^class ([A-Z]\w*)", file.read_text(), re.MULTILINE):
            homes.setdefault(name, []).append(str(file.relative_to(ROOT)))
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}

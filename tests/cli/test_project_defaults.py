"""A project file states options of commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image
from tools.command import Here

from photoplan.cli.table import schema as make_schema
from photoplan.events import SILENT
from photoplan.requests.orient import TieRequest
from photoplan.requests.project import SchemaRequest


def with_defaults(folder: Path, text: str) -> Path:
    lines = 'format = 1\ncrs = "EPSG:32633"\n[orientation]\nheight_system = "same"\n'
    lines += '[cameras.c]\ntype = "frame"\nsize = [100, 100]\nfocal_px = 100.0\n'
    lines += "".join(f'[[images]]\nname = "{n}"\nfile = "{n}.tif"\ncamera = "c"\n' for n in "ab")
    for name in "ab":
        Image.new("L", (100, 100)).save(folder / f"{name}.tif")
    (folder / "project.toml").write_text(f"{lines}[defaults.tie]\n{text}\n")
    return folder / "project.toml"


@pytest.mark.parametrize(
    ("text", "given", "said"),
    [
        ('pairs = "none.txt"', (), "none.txt"),
        ('pairs = "none.txt"', ("--pairs", "other.txt"), "other.txt"),
        ('features = "many"', (), "[defaults.tie] features: str 'many'; needed is a whole number"),
        ("features = true", (), "[defaults.tie] features: bool True; needed is a whole number"),
        ("features = 8000.7", (), "[defaults.tie] features: float 8000.7; needed is a whole number"),
        ("features = [1, 2]", (), "[defaults.tie] features: list [1, 2]; needed is a whole number"),
        ("features = { a = 1 }", (), "[defaults.tie] features: dict {'a': 1}; needed is a whole number"),
        ("features = 1979-05-27", (), "[defaults.tie] features: date; needed is a whole number"),
        ("features = -5", (), "[defaults.tie] features -5 must be at least 50, per_image 500 at least 1"),
        ("refine = 0", (), "[defaults.tie] refine: int 0; needed is True or False"),
        ("pairs = 5", (), "[defaults.tie] pairs 5 must be one of auto or all (pairs of images that are compared: auto"),
        ('pairs = "\\u0000"', (), "input '\\x00'"),
        ("levels = 9", (), "[defaults.tie] levels 9 must be from 1 to 4"),
        (
            "levels = 9\n[defaults.ti]\nlevels = 2",
            (),
            "[defaults.ti] levels: no option that a project may state; ti has",
        ),
        (
            "[defaults.adjust]\nlevels = 2",
            (),
            "[defaults.adjust] levels: no option that a project may state; these are",
        ),
        ("[defaults.view]\nhaze = 0.1", (), "[defaults.view] haze: no option that a project may state; view has none"),
        ("[defaults.budget]\ntables = true", (), "[defaults.budget] tables: no option that a project may state"),
        ('output = "/x"', (), "[defaults.tie] output: no option that a project may state; these are pairs,"),
        ("overwrite = true", (), "[defaults.tie] overwrite: no option that a project may state"),
        ('executor = "tcp://a:1"', (), "[defaults.tie] executor: no option that a project may state"),
    ],
)
def test_options_of_the_project_hold_unless_others_are_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, given: tuple[str, ...], said: str
) -> None:
    found = Here(capsys)("tie", with_defaults(tmp_path, text), "--dry-run", *given)
    assert found.code in (2, 3) and said in found.err


@pytest.mark.parametrize("verb", [("check",), ("tie", "--dry-run")])
def test_a_misspelt_option_of_any_command_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: tuple[str, ...]
) -> None:
    with_defaults(tmp_path, "[defaults.ortho]\nresolutoin = 1.0")
    found = Here(capsys)(verb[0], tmp_path, *verb[1:])
    assert found.code == 3 and "[defaults.ortho] resolutoin: no option that a project may state" in found.err


def test_a_relative_path_starts_at_the_folder_of_the_project(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    project, elsewhere = tmp_path / "project", tmp_path / "elsewhere"
    project.mkdir()
    elsewhere.mkdir()
    with_defaults(project, 'pairs = "pairs.txt"')
    (project / "pairs.txt").write_text("a b\n")
    (elsewhere / "pairs.txt").write_text("a nobody\n")
    monkeypatch.chdir(elsewhere)
    for place in (project, project / "project.toml"):
        found = Here(capsys)("tie", place, "--dry-run")
        assert found.code == 0 and f"pairs of {project / 'pairs.txt'}" in found.out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('prefer = ["nobody"]', "image 'nobody' is not in the project"),
        ('weights = "slope=2"', "[defaults.mosaic] score 'slope=2'; write NAME=WEIGHT"),
        ("weights = { slope = 2 }", "[defaults.mosaic] Weights {'slope': 2}"),
        ('weights = { slant = "x" }', "[defaults.mosaic] Weights {'slant': 'x'}"),
    ],
)
def test_values_of_other_kinds_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str) -> None:
    found = Here(capsys)("mosaic", with_defaults(tmp_path, f"[defaults.mosaic]\n{text}"), "--dry-run")
    assert found.code in (2, 3) and said in found.err


def test_no_option_that_writes_or_runs_may_be_stated() -> None:
    assert not {"project", "output", "overwrite", "executor", "memory", "workers"} & set(TieRequest.may_be_stated())


def test_a_schema_states_what_the_field_is_and_the_help_what_the_flag_does(
    capsys: pytest.CaptureFixture[str],
) -> None:
    fields = json.loads(Here(capsys)("schema", "tie").out)["properties"]
    assert fields["refine"]["description"] == "Refine the places of features by least-squares matching."
    assert "Leave out least-squares matching" in Here(capsys)("tie", "--help").out
    assert not [name for name, each in fields.items() if "Write no" in each["description"]]


@pytest.mark.parametrize("verb", ["view", "view sequence", "view matrix", "mosaic", "simulate"])
def test_a_schema_states_options_alone(verb: str) -> None:
    schema = make_schema(SchemaRequest(tuple(verb.split())), SILENT).json_fields()
    for each in (schema, *schema.get("$defs", {}).values()):
        for name, field in each.get("properties", {}).items() if "Options" in each.get("description", "") else ():
            assert "description" in field or "$ref" in json.dumps(field), name

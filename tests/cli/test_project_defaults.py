"""A project file states options of commands."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image
from tools.command import Here

from photoplan.requests.orient import TieRequest


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
        ('features = "many"', (), "[defaults.tie] features: 'many' is not a valid integer"),
        ("levels = 9", (), "[defaults.tie] --levels 9 must be from 1 to 4"),
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


def test_no_option_that_writes_or_runs_may_be_stated() -> None:
    assert not {"project", "output", "overwrite", "executor", "memory", "workers"} & set(TieRequest.may_be_stated())

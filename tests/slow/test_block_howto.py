"""The commands at the beginning of the page on blocks, literally, from the included block to orthophotos."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from tools.command import inside

from photoplan.io.project.file import load_project

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "block.md"


@pytest.mark.slow
def test_the_page_runs_from_the_included_block_to_orthophotos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cv2")
    monkeypatch.chdir(tmp_path)
    first = re.search(r"```console\n(.*?)```", PAGE.read_text(), re.S)
    assert first is not None
    commands = [shlex.split(line) for line in first[1].replace("\\\n", " ").splitlines() if line.strip()]
    assert [words[1] for words in commands] == ["demo", "init", "tie", "adjust", "check", "ortho"]
    for words in commands:
        assert words[0] == "photoplan"
        said = inside(*words[1:])
        assert said.code == 0, (words, said.err)
        if words[1] == "check":
            assert "all plausible" in said.out and "left out" not in said.out
    # What the page says to look at: all images are in, some tenths of a pixel, a few per cent of gross errors.
    report = json.loads((tmp_path / "block" / "adjustment" / "report.json").read_text())
    assert len(report["images"]) == 18 and report["not_oriented"] == []
    assert report["image_residual_rms_px"] < 0.3
    assert len(report["gross_errors"]) < 0.03 * report["measurements"]
    # The shape is that of the orientation that it begins with, as the page states.
    rms = {group["name"]: group["rms"] for group in report["groups"]}
    assert rms["datum from orientations, horizontal"] < 0.06 and rms["datum from orientations, height"] < 0.04
    assert len(list((tmp_path / "block" / "products").glob("*_ortho.tif"))) == 18
    sigma = [image.sigma_center for image in load_project(tmp_path / "block" / "project.toml").posed]
    assert all(s is not None and 0.3 < s[0] < 3.0 for s in sigma)

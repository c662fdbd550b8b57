"""`photoplan adjust`: streams, exit codes, files; refusals without a trace."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tools.adjust_project import Make, write_project
from tools.command import Here, edit, inside
from tools.recorded import recorded

pytest.importorskip("matplotlib")


def test_a_block_is_adjusted(tmp_path: Path) -> None:
    made = write_project(tmp_path / "block", Make(pixel_noise=0.3, check=3))
    said = inside("adjust", made.path, "--calibrate", "cam=c")
    assert said.code == 0, said.err
    lines = said.out.strip().split("\n")
    folder = tmp_path / "block" / "adjustment"
    assert lines[:4] == [str(folder / n) for n in ("report.html", "report.json", "points.gpkg", "image_points.csv")]
    assert lines[4].startswith("sigma0 0.") or lines[4].startswith("sigma0 1.")
    assert any("camera cam: c 3" in line for line in lines)
    assert any("check points: RMSE_H 0." in line and "(ASPRS 2023)" in line for line in lines)
    assert any("warning: 3 check points" in line for line in lines)
    assert "8 images · " in said.err
    assert "calibrated cam: c" in said.err
    # Progress is for terminals; elsewhere there is a line now and then.
    iterations = json.loads((folder / "report.json").read_text())["iterations"]
    assert iterations > 3 * said.err.count("iteration")
    assert "orientations of 8 images written into the project" in said.err
    assert "sigma_center" in made.project_text()
    record = recorded(folder / "report.run.json", "adjust", made.path, *made.path.parent.glob("*.csv"))
    assert record["product"]["iterations"] == iterations and record["settings"]["calibrate"] == ["cam=c"]


def test_json_quiet_and_dry_run(photoplan: Here, tmp_path: Path) -> None:
    made = write_project(tmp_path / "block", Make(pixel_noise=0.3))
    before = made.project_text()
    said = photoplan("adjust", made.path, "--dry-run", "--json", "-q", "--no-variance-components", "--critical", 5)
    assert said.code == 0, said.err
    assert said.err == ""
    found = json.loads(said.out)
    assert found["files"] == []
    assert found["settings"]["gross errors"] == "beyond 5 standard deviations"
    assert len(found["images"]) == 8
    assert made.project_text() == before
    assert sorted(path.name for path in made.path.parent.iterdir()) == ["control.csv", "points.csv", "project.toml"]


def test_wrong_use_is_exit_2(photoplan: Here, tmp_path: Path) -> None:
    made = write_project(tmp_path / "block", Make(pixel_noise=0.3))
    for words, message in (
        (("--calibrate", "lens=k1"), "cameras of the project are 'cam'"),
        (("--critical", 0), "a positive number of standard deviations"),
        (("--images", "zz"), "image 'zz' is not in the project"),
        (("--output", made.path), "is no folder"),
    ):
        said = photoplan("adjust", made.path, *words)
        assert said.code == 2, (words, said)
        assert message in said.err
        assert "Traceback" not in said.err


def test_fault_16_and_18_are_exit_3(photoplan: Here, tmp_path: Path) -> None:
    made = write_project(tmp_path / "block", Make(pixel_noise=0.3))
    before = made.project_text()
    points = made.path.parent / "points.csv"
    text = points.read_text()
    points.write_text(text.replace("\n", "\nT1,a1.tif,nan,1\n", 1))
    said = photoplan("adjust", made.path)
    assert said.code == 3
    assert "points.csv:2: x = 'nan' is not a number" in said.err
    points.write_text(text)
    edit(made.path, 'control = ["control.csv"]\n', "")
    said = photoplan("adjust", made.path)
    assert said.code == 3
    assert "block" in said.err
    assert made.project_text() == before.replace('control = ["control.csv"]\n', "")
    assert not (made.path.parent / "adjustment").exists()

"""Numbers need no pictures: commands that work from coordinates say the same without the image files.

That `resect` and `adjust` need none is what all their tests show: their projects have no image files.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from test_interior import noisy, project
from tools.command import Here, edit
from tools.small_block import Block, make_project


def _without(block: Block) -> None:
    """The project as it is; the size stated, the files gone."""
    for image in block.images:
        image.unlink()


def test_check(photoplan: Here, small: Block) -> None:
    make_project(small)
    before = json.loads(photoplan("check", small.project, "--json").out)
    _without(small)
    said = photoplan("check", small.project, "--json")
    assert said.code == 0, said.err
    after = json.loads(said.out)
    for image, was in zip(after["images"], before["images"], strict=True):
        assert image.pop("notes") == [
            f"{small.folder / 'images' / image['image']}.tif is not there: all but its pixels is checked"
        ]
        was.pop("notes")
    assert after == before


def test_check_still_finds_faults(photoplan: Here, small: Block) -> None:
    make_project(small)
    _without(small)
    small.project.write_text(small.project.read_text().replace("400.0", "99000.0"))
    said = photoplan("check", small.project)
    assert said.code == 3
    assert "are heights in millimetres?" in said.err


def test_monoplot(photoplan: Here, small: Block, tmp_path: Path) -> None:
    make_project(small)
    points = tmp_path / "points.csv"
    points.write_text("name,x,y\nA,20,30\nB,120.5,80\n")
    tables = []
    for k in range(2):
        output = tmp_path / f"ground{k}.csv"
        said = photoplan("monoplot", small.project, "one", points, "-o", output, "--sigma-terrain", 0.5)
        assert said.code == 0, said.err
        tables.append(output.read_text())
        if k == 0:
            _without(small)
    assert tables[0] == tables[1]
    assert tables[1].count("\n") == 3


def test_a_file_of_another_size_is_still_refused(photoplan: Here, small: Block, tmp_path: Path) -> None:
    make_project(small)
    edit(small.project, "size = [200, 150]", "size = [210, 150]")
    points = tmp_path / "points.csv"
    points.write_text("x,y\n20,30\n")
    said = photoplan("monoplot", small.project, "one", points, "-o", tmp_path / "ground.csv")
    assert said.code == 3
    assert "200 × 150 pixels, but camera 'small' has 210 × 150" in said.err


def test_interior(photoplan: Here, tmp_path: Path) -> None:
    path = project(tmp_path, {"a": noisy()})

    def figures() -> Any:
        said = photoplan("interior", path, "--json", "--scan-resolution", "200dpi")
        assert said.code == 0, said.err
        return json.loads(said.out)

    before = figures()
    (tmp_path / "a.tif").unlink()
    assert figures() == before
    (image,) = json.loads(photoplan("interior", path, "--json").out)["images"]
    assert image["note"] == "film shrinkage is not known: the scan cannot be opened"
    assert image["pixel_um"] == pytest.approx(before["images"][0]["pixel_um"])

"""A dry run, the progress of the run and its record count the same tiles."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.facet_scene import GROUND, write_scene
from tools.forked import forked
from tools.small_block import CRS, X0, Y0, texture, write_block, write_image
from tools.town import write_town

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs fork")

#: Ground north-west and south-east of what an image sees: tiles in the corners of the bounds hold nothing of it.
AROUND = ["--bounds", X0 - 260, Y0 - 260, X0 + 360, Y0 + 260, "--resolution", 2, "--tile", 128]
SEEN = ["--images", "one", "--resolution", 1, "--tile", 128]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_town(write_block(folder / "block").project, (X0, Y0), 100.0, CRS)
    write_scene(folder, 3)
    pixels = np.ascontiguousarray(np.tile(texture(bands=1), (1, 5, 4))[:, :600, :1100])
    write_image(folder / "scan.tif", pixels, tiled=True)
    write_image(folder / "small.tif", np.ascontiguousarray(pixels[:, :200, :300]), tiled=True)
    (folder / "weights.csv").write_text("0,-0.8,0\n-0.8,4.2,-0.8\n0,-0.8,0\n")
    (folder / "path.csv").write_text(f"X,Y\n{X0 - 60},{Y0 - 50}\n{X0 - 50},{Y0 - 50}\n")
    return folder


def command(name: str, at: Path, out: Path) -> list[object]:
    """Return the words of a command that works by tiles, without those of a dry run."""
    project, town, dem = at / "block" / "project.toml", at / "block" / "town.toml", at / "block" / "dem.tif"
    folder = ["-o", out, "--no-quicklook"]
    look = ["--from", X0 - 60, Y0 - 50, "--height", 40, "--look-at", X0 + 20, Y0 + 10, "--size", 620, 300]
    return {
        "ortho": ["ortho", project, *AROUND, *folder],
        "direct": ["ortho", project, *SEEN, "--method", "direct", *folder],
        "strict": ["ortho", project, *SEEN, "--tolerance", 0, *folder],
        "true": ["ortho", town, *SEEN, "--true", "--hidden", "mark", *folder],
        "mosaic": ["mosaic", project, *AROUND, *folder],
        "sheets": ["mosaic", project, "--resolution", 2, "--tile", 128, "--sheets", 300, *folder],
        "object": ["object", town, at / "block" / "town.gpkg", "--objects", "house", "--resolution", 0.25, "--tile",
                   128, "--force", *folder],
        "restore": ["restore", at / "scan.tif", at / "small.tif", "--filter", at / "weights.csv", *folder],
        "surface": ["surface", at / "project.toml", "--bounds", X0 - 18, Y0 - 30, X0 + 18, Y0 + 30, "--resolution", 3,
                    "--start", GROUND, *folder],
        "view": ["view", dem, *look, "--samples", 1, "-o", out / "view.png"],
        "matrix": ["view", "matrix", dem, *look, "-o", out / "view.tif"],
    }[name]  # fmt: skip


def counted(found: dict[str, Any]) -> int:
    """Return the tiles that JSON of a dry run or of a run states: of all products together."""
    parts = found.get("products", found.get("images") if "filter" in found else None)
    total = sum(each["tiles"] for each in parts) if parts else found["tiles"]
    assert found.get("tiles", total) == total
    return int(total)


#: Commands whose tiles are counted where those of another one in the list are.
LIKE_OTHERS = ("direct", "strict", "true", "sheets", "matrix")


@pytest.mark.parametrize(
    "name",
    [
        *("ortho", "mosaic", "object", "restore", "surface", "view"),
        *(pytest.param(each, marks=pytest.mark.slow) for each in LIKE_OTHERS),
    ],
)
def test_a_dry_run_counts_the_tiles_of_the_run(name: str, inputs: Path, tmp_path: Path) -> None:
    words = command(name, inputs, tmp_path / "out")
    dry = forked([*words, "--dry-run", "--json"], tmp_path / "dry")
    assert dry.code == 0, dry.err
    tiles = counted(json.loads(dry.out))
    said = forked([*words, "--json", "--workers", 1], tmp_path / "said")
    assert said.code == 0, said.err
    assert counted(json.loads(said.out)) == tiles == len(said.tasks) > 0
    assert [phase[1:] for phase in said.phases if phase[1]][-1] == (tiles, tiles), said.phases
    records = [json.loads(path.read_text())["product"] for path in (tmp_path / "out").glob("*.run.json")]
    assert sum(each["tiles"] for each in records) == tiles


def test_a_plan_that_is_executed_counts_the_tiles_of_its_dry_run(inputs: Path, tmp_path: Path) -> None:
    words = command("ortho", inputs, tmp_path / "out")
    planned = forked([*words, "--plan", tmp_path / "plan.gpkg", "--json"], tmp_path / "dry")
    assert planned.code == 0, planned.err
    said = forked(["run", tmp_path / "plan.gpkg", "--json", "--no-quicklook", "--workers", 1], tmp_path / "said")
    assert said.code == 0, said.err
    assert counted(json.loads(said.out)) == counted(json.loads(planned.out)) == len(said.tasks)


def test_a_sequence_counts_the_tiles_of_all_its_pictures(inputs: Path, tmp_path: Path) -> None:
    look = ["--height", 40, "--size", 520, 100, "--samples", 1]
    words = [
        "view",
        "sequence",
        inputs / "block" / "dem.tif",
        "--path",
        inputs / "path.csv",
        *look,
        "-o",
        tmp_path / "out",
    ]
    dry = forked([*words, "--dry-run", "--json"], tmp_path / "dry")
    assert dry.code == 0, dry.err
    said = forked([*words, "--workers", 1], tmp_path / "said")
    assert said.code == 0, said.err
    assert [phase[1:] for phase in said.phases if phase[1]] == [(json.loads(dry.out)["tiles"],) * 2]

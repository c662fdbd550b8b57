"""`photoplan budget`: the source's tables to the printed digit, budgets by numbers and of projects."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from tools.command import Here, edit
from tools.small_block import FOCAL, write_block

from photoplan.plan.accuracy import displacement_by_height, displacement_by_kappa, displacement_by_tilt

NUMBERS = ("--camera-constant", 150, "--height", 1500, "--format", 200, 200, "--pixel", 15)
GON = np.pi / 200


def test_tables_of_the_source_to_the_printed_digit(photoplan: Here) -> None:
    said = photoplan("budget", "--tables")
    assert said.code == 0, said.err
    rows = [re.split(r"\s{2,}|(?<=m)\s+", line.strip()) for line in said.out.splitlines()]
    numbers = {row[0]: row[1:] for row in rows if len(row) > 1}
    assert numbers["750 m"] == ["0.2", "0.9", "1.9", "4.7", "18.7"]
    assert numbers["1500 m"] == ["0.1", "0.5", "0.9", "2.3", "9.3"]
    assert numbers["3750 m"] == ["0.0", "0.2", "0.4", "0.9", "3.7"]
    assert numbers["7500 m"] == ["0.0", "0.1", "0.2", "0.5", "1.9"]
    assert numbers["X0, Y0"] == ["0.50 m"] and numbers["Z0"] == ["0.54 m"]
    assert numbers["ω, φ"] == ["0.013 gon"] and numbers["κ"] == ["0.020 gon"]
    assert numbers["5162"] == ["23", "27", "8", "37", "32", "8"]
    # Printed is 52 for φ: 0.0134 gon give 52.5, and that number itself is rounded.
    assert numbers["5164"] == ["40", "53", "30", "89", "53", "16"]
    found = json.loads(photoplan("budget", "--tables", "--json").out)
    assert found["orientation_8_2_2_um"]["5164"]["omega"] == pytest.approx(89, abs=0.5)


def test_budget_by_numbers_is_that_of_the_formulas(photoplan: Here) -> None:
    """Terrain, centre and angles at 100 mm from the principal point along both axes, on the ground."""
    stated = ("--sigma-terrain", 0.5, "--sigma-center", 0.2, 0.3, 0.1, "--sigma-angles", 0.01, 0.02, 0.03)
    said = photoplan("budget", *NUMBERS, *stated, "--json")
    assert said.code == 0, said.err
    (image,) = json.loads(said.out)["images"]
    parts = {name: values["corner"] for name, values in image["contributions_m"].items()}
    # The corner is the middle of the last pixel.
    side = 0.1 - 7.5e-6 + (200 / 0.015 - round(200 / 0.015)) * 7.5e-6
    w, ground = side / 0.15, 1500 / 0.15
    assert image["gsd_m"] == pytest.approx(0.15, rel=1e-6)
    expected = {
        "terrain": displacement_by_height(side * 2**0.5, 1500, 0.5) * ground,
        "X0": 0.2,
        "Y0": 0.3,
        "Z0": displacement_by_height(side * 2**0.5, 1500, 0.1) * ground,
        "omega": displacement_by_tilt(0.01 * GON, 0.15, w) * ground,
        "phi": displacement_by_tilt(0.02 * GON, 0.15, w) * ground,
        "kappa": displacement_by_kappa(0.03 * GON, 0.15, w) * ground,
    }
    assert parts == pytest.approx({**parts, **{k: float(v) for k, v in expected.items()}}, rel=1e-4)
    assert image["total_m"]["corner"] == pytest.approx(np.sqrt(sum(v**2 for v in parts.values())))
    assert image["limited_by"]["corner"]["cause"] == max(parts, key=lambda name: parts[name])


def test_what_is_not_stated_is_free_of_error_and_said(photoplan: Here) -> None:
    said = photoplan("budget", *NUMBERS, "--sigma-terrain", 1)
    assert said.code == 0, said.err
    assert "note: free of error, as nothing is stated: " in said.err and "--sigma-center" in said.err
    assert "limited by" in said.out and "corner: terrain (100%)" in said.out


@pytest.mark.drawn
def test_of_a_project(photoplan: Here, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    block = write_block(tmp_path)
    said = photoplan("budget", block.project)
    # Nothing is stated: the total is that of making the product, and notes say what is missing and what it costs.
    assert said.code == 0 and "the total holds only what is stated" in said.err
    assert "terrain: not stated; 0.1 m of height cost" in said.err and "--sigma-terrain" in said.err
    assert "orientation: not stated of 3 images" in said.err and "--sigma-center" in said.err
    bare = json.loads(photoplan("budget", block.project, "--json").out)
    assert set(bare["images"][0]["contributions_m"]) == {"resampling", "anchors"}
    edit(block.project, "[terrain]", "[terrain]\nsigma = 0.6")
    said = photoplan("budget", block.project)
    assert said.code == 0 and "orientation: not stated" in said.err and "terrain: not" not in said.err
    picture = tmp_path / "budget.png"
    stated = ("--sigma-center", 0.1, 0.1, 0.1, "--sigma-angles", 0.01, 0.01, 0.01)
    said = photoplan("budget", block.project, *stated, "--picture", picture)
    assert said.code == 0, said.err
    assert "3 images; the typical one" in said.out and "position and angles count as independent" in said.err
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "exists" in photoplan("budget", block.project, *stated, "--picture", picture).err
    found = json.loads(photoplan("budget", block.project, *stated, "--json").out)
    assert [image["image"] for image in found["images"]] == ["one", "three", "two"]
    for image in found["images"]:
        assert 1.2 < image["gsd_m"] < 1.8
        corner = np.hypot(100, 75) / FOCAL * 0.6
        assert image["contributions_m"]["terrain"]["corner"] == pytest.approx(corner, rel=0.2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "requires PROJECT, or --camera-constant and --height"),
        (("--camera-constant", 150), "set --height METRES"),
        (("--camera-constant", 150, "--height", -1), "must be positive"),
        ((*NUMBERS, "--kernel", "sharp"), "allowed are nearest"),
    ],
)
def test_wrong_use(photoplan: Here, words: tuple[object, ...], message: str) -> None:
    said = photoplan("budget", *words)
    assert said.code == 2 and message in said.err

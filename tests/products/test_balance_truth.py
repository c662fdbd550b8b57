"""Balanced mosaics of simulated blocks lie nearer to the truth than raw ones, at every degree."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tools.radiometric_block as blocks
from tools.command import Here
from tools.radiometric_block import RadiometricBlock, simulate

from photoplan.products.balance import BalanceRequest, balance_project

CASES: dict[str, dict[str, Any]] = {
    "2 strips of 3": {"strips": 2, "along": 3, "seed": 1},
    "1 strip of 6": {"strips": 1, "along": 6, "seed": 2},
    "3 strips of 10": {"strips": 3, "along": 10, "seed": 3},
    "strips in opposite directions": {"strips": 2, "along": 8, "seed": 4, "turned": True},
    "exposures that wander": {"strips": 1, "along": 12, "seed": 5, "wander": 0.08, "steps": 0.03},
    "small steps": {"strips": 3, "along": 4, "seed": 6, "steps": 0.05, "haze": 0.02},
    "one slope in all images": {"strips": 2, "along": 10, "seed": 7, "shared_haze": 0.06},
    "one slope over the ground": {"strips": 2, "along": 10, "seed": 8, "shared_haze": 0.06, "turned": True},
    "a steep slope over the ground": {"strips": 2, "along": 10, "seed": 33, "shared_haze": 0.2, "turned": True},
    "curves": {"strips": 3, "along": 3, "seed": 9, "gammas": 0.25},
    "no steps": {"strips": 1, "along": 8, "seed": 10, "steps": 0.0, "haze": 0.03},
    "no fall-off": {"strips": 2, "along": 3, "seed": 11, "fall_off": 0.0, "steps": 0.1},
    "a long strip": {"strips": 1, "along": 20, "seed": 12, "haze": 0.1},
}
EASY = ("2 strips of 3",)


def nearer(folder: Path, case: str, degrees: tuple[int | None, ...]) -> None:
    block = simulate(folder, **CASES[case])
    raw = list(block.images)
    for degree in degrees:
        out = folder / f"degree {degree}"
        request = BalanceRequest(block.project, degree=degree or 0, factor=degree is None, output=out)
        found = balance_project(request)
        even = block.balanced(out)
        assert block.error(even) < block.error(raw) and block.plain_error(even) < block.plain_error(raw), degree
        if degree:
            assert block.error(even) < 0.5 * block.error(raw)
            assert block.overlaps(even) < 4 and block.overlaps(even) < 0.5 * block.overlaps(raw)
            assert found.balanced is not None and len(found.balanced.modes) == 5


@pytest.mark.parametrize("case", EASY)
@pytest.mark.parametrize("degree", [None, 0, 1, 2])
def test_a_small_block_is_nearer_to_the_truth(tmp_path: Path, case: str, degree: int | None) -> None:
    nearer(tmp_path, case, (degree,))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_blocks_are_nearer_to_the_truth_at_every_degree(tmp_path: Path, case: str) -> None:
    nearer(tmp_path, case, (None, 0, 1, 2, 3, 4))


MIXED = ("straight", "gamma 0.7", "veil", "film", "dark", "equalised")
#: Blocks whose images have different characteristic curves, and others: how far their slopes are from the stated ones.
SLOPES: dict[str, dict[str, Any]] = {
    "very different curves": {"strips": 2, "along": 3, "seed": 21, "curves": MIXED, "steps": 0.0},
    "film and prints": {
        "strips": 3,
        "along": 4,
        "seed": 22,
        "curves": ("film", "straight", "veil", "gamma 1.3", "dark"),
    },
    "exponents": {"strips": 3, "along": 3, "seed": 9, "gammas": 0.25},
    "film": {"strips": 2, "along": 4, "seed": 23, "curves": ("film",), "steps": 0.15},
    "veils": {"strips": 2, "along": 5, "seed": 24, "curves": ("veil", "straight", "dark"), "steps": 0.1},
    "three exponents": {
        "strips": 2,
        "along": 5,
        "seed": 25,
        "curves": ("gamma 0.7", "gamma 1.3", "straight"),
        "steps": 0.1,
    },
    "no curves": {"strips": 2, "along": 3, "seed": 1},
    "exposures that wander": {"strips": 1, "along": 12, "seed": 5, "wander": 0.08, "steps": 0.03},
    "one slope over the ground": {"strips": 2, "along": 10, "seed": 8, "shared_haze": 0.06, "turned": True},
    "a strip of film": {"strips": 1, "along": 8, "seed": 26, "curves": ("film", "straight"), "steps": 0.1},
    "very different curves again": {"strips": 2, "along": 4, "seed": 27, "curves": MIXED[::-1], "steps": 0.1},
    "curves before the fall-off": {"strips": 2, "along": 4, "seed": 28, "curves": MIXED, "printed": True},
}


def balanced(folder: Path, **case: Any) -> tuple[RadiometricBlock, list[Any], dict[str, Any]]:
    block = simulate(folder, **case)
    found = balance_project(BalanceRequest(block.project))
    return block, block.balanced(folder / "balance"), found.json_fields()


@pytest.mark.parametrize("printed", [False, True])
def test_very_different_curves_after_or_before_the_fall_off(tmp_path: Path, printed: bool) -> None:
    block, even, record = balanced(tmp_path, **SLOPES["very different curves"], printed=printed)
    assert record["curve_last"] != printed
    assert block.error(even) < (0.15 if printed else 0.25) * block.error(list(block.images))
    assert block.overlaps(even) < 2.5


def test_a_note_names_slopes_that_depend_on_the_order_of_curve_and_fall_off(tmp_path: Path) -> None:
    _, _, record = balanced(tmp_path, **SLOPES["very different curves"])
    (note,) = record["notes"]
    assert "before or after the fall-off" in note and "reference" in note
    for name, mode in record["block_modes"].items():
        assert mode["sigma"] > mode["order"] and (name in note) == (mode["order"] > max(0.02, mode["sigma"] / 2))


@pytest.mark.slow
def test_stated_deviations_of_slopes_cover_what_is_there(tmp_path: Path) -> None:
    parts = []
    for number, case in enumerate(SLOPES.values()):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        block, even, record = balanced(folder, **case)
        sigmas = [mode["sigma"] for mode in record["block_modes"].values()]
        parts.append(np.abs(block.modes(even)) / sigmas)
    slopes = np.array(parts)[:, :2]
    assert 0.8 < np.sqrt(np.mean(slopes**2)) < 1.25, parts
    assert (slopes < 2).mean() >= 0.9 and (slopes < 2.6).all(), parts


def test_the_command_reports_what_overlaps_do_not_determine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    block = simulate(tmp_path, strips=1, along=3, seed=3)
    said = Here(capsys)("balance", block.project, "--no-picture")
    assert said.code == 0 and "standard deviations over the block, from its middle to its edge: slope east" in said.out
    record = json.loads((tmp_path / "balance" / "overlaps.run.json").read_text())
    modes = record["product"]["block_modes"]
    assert {"slope east", "slope north", "bend east", "bend north", "twist"} == set(modes)
    # One strip: nothing but the prior speaks of a slope across it.
    assert modes["slope north"]["sigma"] > 0.5 * modes["slope north"]["prior_sigma"] > 0


@pytest.mark.parametrize("size", [(300, 17), (60, 50), (40, 36), (24, 200)])
@pytest.mark.parametrize("factor", [False, True])
def test_narrow_blocks_with_few_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], factor: bool
) -> None:
    """Blocks of fewer cells than are left out in turn for standard deviations: an IndexError before."""
    monkeypatch.setattr(blocks, "WIDTH", size[0])
    monkeypatch.setattr(blocks, "HEIGHT", size[1])
    strips = 1 if size[0] > 30 else 3
    block = simulate(tmp_path, strips=strips, along=4 - strips, seed=1, forward=0.5, side=0.6, noise=0.5)
    found = balance_project(BalanceRequest(block.project, factor=factor))
    assert found.balanced is not None and len(found.balanced.images) == len(block.images)

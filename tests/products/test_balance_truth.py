"""Balanced mosaics of simulated blocks lie nearer to the truth than raw ones, at every degree."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import tools.radiometric_block as blocks
from tools.command import Here
from tools.radiometric_block import simulate

from photoplan.products.balance.run import BalanceRequest, balance_project

CASES: dict[str, dict[str, Any]] = {
    "2 strips of 3": {"strips": 2, "along": 3, "seed": 1},
    "1 strip of 6": {"strips": 1, "along": 6, "seed": 2},
    "3 strips of 10": {"strips": 3, "along": 10, "seed": 3},
    "strips in opposite directions": {"strips": 2, "along": 8, "seed": 4, "turned": True},
    "exposures that wander": {"strips": 1, "along": 12, "seed": 5, "wander": 0.08, "steps": 0.03},
    "small steps": {"strips": 3, "along": 4, "seed": 6, "steps": 0.05, "haze": 0.02},
    "one slope in all images": {"strips": 2, "along": 10, "seed": 7, "shared_haze": 0.06},
    "one slope over the ground": {"strips": 2, "along": 10, "seed": 8, "shared_haze": 0.06, "turned": True},
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

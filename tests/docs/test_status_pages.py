"""The status pages: short cells, tests that exist, and a row that says missed for every strict expected failure."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "status").glob("*.md"))
HEAD = ["asked", "measured", "missed because", "measured by", "date"]


def rows_of(page: Path) -> list[list[str]]:
    lines = [line for line in page.read_text("utf-8").splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


MEASURED = {page: [row for row in rows_of(page) if row[0] not in ("asked", "---")] for page in PAGES}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_listed_and_its_cells_are_short(page: Path) -> None:
    assert f"status/{page.name}" in (ROOT / "docs" / "status.md").read_text("utf-8")
    for row in rows_of(page):
        assert max(map(len, row)) <= 200, row
        if page.stem != "left-alone" and row[0] != "---":
            assert row == HEAD or re.fullmatch(r"20\d\d-\d\d-\d\d", row[-1]), row


@pytest.mark.parametrize("page", [page for page in PAGES if page.stem != "left-alone"], ids=lambda page: page.stem)
def test_what_is_missed_says_why_and_what_is_reached_does_not(page: Path) -> None:
    assert MEASURED[page]
    for asked, measured, why, _, _ in MEASURED[page]:
        assert asked and measured
        assert bool(why) == measured.startswith(("**missed", "**not verified")), (asked, measured)


def test_every_test_that_is_named_exists() -> None:
    for page in PAGES:
        for path in re.findall(r"`(tests/[\w/.-]+)`", page.read_text("utf-8")):
            assert (ROOT / path).exists(), f"{page.name}: {path}"


def test_every_strict_expected_failure_has_a_row_that_says_missed() -> None:
    missed = " ".join(row[3] for page in PAGES for row in MEASURED[page] if len(row) == 5 and row[2])
    strict = re.compile(r"xfail\((?:[^()]|\([^()]*\))*strict=True")
    expected = {path for path in (ROOT / "tests").rglob("test_*.py") if strict.search(path.read_text("utf-8"))}
    assert len(expected - {Path(__file__)}) >= 10
    assert not {path.name for path in expected - {Path(__file__)} if path.name not in missed}

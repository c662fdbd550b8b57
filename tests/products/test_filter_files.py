"""Filter files: written and read to the last digit, plain matrices, and whatever is wrong with a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError, UsageError
from photoplan.project.steps import load_filter, save_filter
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter

WEIGHTS = np.random.default_rng(0).normal(size=(5, 3)) * np.array([1e-9, 1.0, 1e6])

GOOD = """\
kind = "restoration filter"
image_size = [100, 80]
[[kernels]]
at = [1, 2.5]
values = [[0, -1, 0], [-1, 5, -1], [0, -1, 0]]
"""


def test_written_and_read_again_it_is_the_same(tmp_path: Path) -> None:
    facts = {
        "spread": np.array([0.02, 0.15, 0.66]),
        "condition": 'A < Z/2 "holds"',
        "band 1": {"noise gain": 1.25, "holds": True, "unknown": None},
        "numbers": [1, 2],
    }
    kernels = tuple(FilterKernel(WEIGHTS * k, (k * 10.5, 3.0), k) for k in (1, 2))
    given = RestorationFilter(kernels, (100, 80), 'from "edges"\nof roofs', facts)
    path = save_filter(tmp_path / "f.toml", given)
    read = load_filter(path)
    for before, after in zip(given.kernels, read.kernels, strict=True):
        assert np.array_equal(before.values, after.values)
        assert (before.at, before.band) == (after.at, after.band)
    assert (read.image_size, read.description) == (given.image_size, given.description)
    assert read.facts == {
        "spread": [0.02, 0.15, 0.66],
        "condition": 'A < Z/2 "holds"',
        "band 1": {"noise gain": 1.25, "holds": True},
        "numbers": [1, 2],
    }
    again = save_filter(tmp_path / "g.toml", read)
    assert again.read_bytes() == path.read_bytes()
    with pytest.raises(UsageError, match="exists already"):
        save_filter(path, read)
    with pytest.raises(UsageError, match=r"ends in \.toml"):
        save_filter(tmp_path / "f.csv", read)


@pytest.mark.parametrize("text", ["1,2,3\r\n4,5,6\r\n7,8,9\r\n", "\ufeff# 3 × 3\n1 2\t3\n\n4;5 ;6\n 7 , 8,9e0 # end"])
def test_fault_18_rows_of_numbers(tmp_path: Path, text: str) -> None:
    path = tmp_path / "weights.csv"
    path.write_text(text, newline="")
    (kernel,) = load_filter(path).kernels
    assert np.array_equal(kernel.values, np.arange(1, 10).reshape(3, 3))
    assert (kernel.at, kernel.band) == (None, None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5\n7 8 9", ":2: 2 numbers; the rows before have 3"),
        ("1 2 3\n4 nan 6\n7 8 9", ":2: nan given; a finite number is needed"),
        ("1 2 3\n4 5 six\n7 8 9", ":2: '4 5 six' is no row of numbers; write decimals with a point"),
        ("1 2\n3 4", "values of 2 rows and 2 columns; both must be odd"),
        ("# nothing\n", "holds no numbers"),
        ("1 " * 103, ":1: a filter has at most 101 rows and columns"),
        ("1\n" * 103, "at most 101 rows"),
        ("1e300", "values[1][1]: 1e+300 given; allowed is less than or equal to 1000000000000"),
        ("1,2,\n3,4,\n5,6,", ":1: '1,2,' is no row of numbers"),
    ],
)
def test_fault_18_rows_that_are_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "weights.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_filter(path)
    assert str(path) in str(caught.value) and message in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "restoration filter"', "", "no filter; a filter file states kind"),
        ("[100, 80]", "[100, 80.5]", ":2: image_size[2]: 80.5 given; allowed is a valid integer"),
        ("image_size = [100, 80]", "", "places states the size of the image"),
        ("at = [1, 2.5]", "at = [1, nan]", "kernels[1].at[2]: nan given"),
        ("at = [1, 2.5]", "band = 0", "kernels[1].band: 0 given; allowed is"),
        ("at = [1, 2.5]", "where = 1", "kernels[1].where: unknown entry"),
        ("[-1, 5, -1]", "[-1, 5]", "row 2 of values has 2 numbers, row 1 3"),
        ("[-1, 5, -1]", "[-1, inf, -1]", "values[2][2]: inf given; allowed is"),
        ("[-1, 5, -1]", '[-1, "5", -1]', "values[2][2]: '5' given"),
        ("[-1, 5, -1]", "[-1, true, -1]", "values[2][2]: True given"),
        (", [0, -1, 0]]", "]", "values of 2 rows and 3 columns; both must be odd"),
        ("values = [[0, -1, 0], [-1, 5, -1], [0, -1, 0]]", "values = 3", "kernels[1].values: 3 given"),
        ("values = [[0, -1, 0], [-1, 5, -1], [0, -1, 0]]", "", "kernels[1].values: is missing"),
        ("[[kernels]]", "[kernels]", "kernels: {"),
        ("image_size", "format = 2\nimage_size", "format: 2 given; allowed is 1"),
        ("image_size", "sise = 2\nimage_size", "sise: unknown entry"),
        ("at = [1, 2.5]", "at = [1, 2.5", "not valid TOML"),
    ],
)
def test_toml_that_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "f.toml"
    assert GOOD.count(old) == 1
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_filter(path)
    assert str(path) in str(caught.value) and message in str(caught.value)


def test_two_kernels_at_one_place(tmp_path: Path) -> None:
    path = tmp_path / "f.toml"
    path.write_text(GOOD + GOOD[GOOD.index("[[kernels]]") :])
    with pytest.raises(InputError, match="needs a different place for each of them"):
        load_filter(path)


def test_a_file_that_is_missing_or_no_text(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"f\.toml"):
        load_filter(tmp_path / "f.toml")
    (tmp_path / "f.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not UTF-8"):
        load_filter(tmp_path / "f.toml")

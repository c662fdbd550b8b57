"""Linearisation tables and laboratory MTF values: as they are written, or refused with file and line (fault 18)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.io.quality_files import read_mtf_table
from photoplan.project.steps import read_linearisation_table


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "table.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0.0\n1.5\n3\n", [[0.0], [1.5], [3.0]]),
        ("0 0 0 \t\n1\t1\t1\n", [[0, 0, 0], [1, 1, 1]]),
        ("grey,light\n0,0\n255,1\n", [[0, 0], [255, 1]]),
        ("# a comment\r\n\r\n0;0.5\r\n1;0.7\r\n", [[0, 0.5], [1, 0.7]]),
        (b"\xef\xbb\xbf0 1e-3\n1 2e-3\n", [[0, 1e-3], [1, 2e-3]]),
        ("0, 0.0\n10, 0.5\n", [[0, 0], [10, 0.5]]),
    ],
)
def test_tables_as_they_are_written(tmp_path: Path, text: str | bytes, values: list[list[float]]) -> None:
    np.testing.assert_allclose(read_linearisation_table(written(tmp_path, text)), values)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no line with data"),
        ("grey light\n", "a header and no line with numbers"),
        ("0 0\n1 nan\n", ":2: column 2 = 'nan' is not a number"),
        ("0 0\n1 inf\n", ":2: column 2 = 'inf' is not a number"),
        ("0 0\n1 2 3\n", ":2: 3 columns, the first line has 2"),
        ("0;0,5\n1;0,7\n", ":1: column 2 = '0,5' is not a number; write decimals with a point"),
        ("1 2 3 4 5\n", ":1: 5 columns, at most 4 are read"),
        ("0 0\nlight 1\n", ":2: column 1 = 'light' is not a number"),
        ("0,\n1,2\n", ":1: column 2 = '' is not a number"),
        (b"0 0\n\xff 1\n", ":2: not UTF-8"),
        (b"0 0\n1 \x00\n", ":2: holds a zero byte"),
    ],
)
def test_fault_18_linearisation_tables(tmp_path: Path, text: str | bytes, says: str) -> None:
    with pytest.raises(InputError) as caught:
        read_linearisation_table(written(tmp_path, text))
    assert says in str(caught.value)
    assert "table.txt" in str(caught.value)


def test_tables_of_the_sfrmat3_package(shared: Path) -> None:
    folder = shared / "data" / "slanted_edges" / "sfrmat3"
    assert read_linearisation_table(folder / "lut1.dat").shape == (256, 1)
    assert read_linearisation_table(folder / "lut3.dat").shape == (256, 3)


class TestLaboratory:
    def test_per_pixel_and_per_mm(self, tmp_path: Path) -> None:
        table = read_mtf_table(written(tmp_path, "cycles_per_px,modulation\n0.4,0.3\n0.1,0.9\n"))
        assert table.frequency.tolist() == [0.1, 0.4]
        assert table.modulation.tolist() == [0.9, 0.3]
        assert table.per_pixel(None).tolist() == [0.1, 0.4]
        table = read_mtf_table(written(tmp_path, "lp/mm;MTF\n20;0.8\n40;0.5\n"))
        np.testing.assert_allclose(table.per_pixel(6.5), [0.13, 0.26])
        with pytest.raises(InputError, match="`pixel_size`"):
            table.per_pixel(None)

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("cycles_per_px,modulation\n0.1,50\n", ":2: modulation 50"),
            ("cycles_per_px,modulation\n-0.1,0.5\n", ":2: frequency -0.1"),
            ("cycles_per_px,modulation\n0.1,0.5\n0.1,0.4\n", ":3: frequency 0.1 is given twice"),
            ("cycles_per_px,modulation\n0.1,nan\n", ":2: modulation = 'nan'"),
            ("cycles_per_px,modulation\n0.1,0.5,3\n", ":2: 3 columns"),
            ("cycles_per_px;modulation\n0,1;0,5\n", ":2: frequency = '0,1' is not a number"),
            ("cycles_per_px,modulation\n", "holds a header and no line"),
            ("a,b\n0.1,0.5\n", "frequency"),
            ("0.1,0.5\n0.2,0.4\n", "is no header"),
        ],
    )
    def test_fault_18_laboratory_values(self, tmp_path: Path, text: str, says: str) -> None:
        with pytest.raises(InputError) as caught:
            read_mtf_table(written(tmp_path, text))
        assert says in str(caught.value)

"""Linearisation tables: text files that say how much light a grey value stands for."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.plain_files import read_text
from photoplan.io.text_columns import NUMBER, has_decimal_comma

#: A table of 65536 lines of four long numbers.
MAX_BYTES = 8_000_000
_MOST_COLUMNS = 4


def read_linearisation_table(path: Path) -> NDArray[np.float64]:
    """The numbers of a linearisation table.

    Columns are separated by spaces, tabs, semicolons or commas; empty lines, lines that begin with ``#`` and a first
    line of words are passed over. One column holds the light of the grey values 0, 1, 2 …, two hold grey value and
    light, three the light in three bands, four the grey value and the light in three bands.

    Parameters
    ----------
    path : Path

    Returns
    -------
    array
        Shape (lines, columns).

    Raises
    ------
    InputError
        The file cannot be read, holds no numbers, or a line has another number of columns than the first, or what is
        no finite number; the message names the line.
    """
    rows: list[list[float]] = []
    passed_header = False
    for number, text in enumerate(read_text(path, MAX_BYTES).split("\n"), 1):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        fields = _fields(path, number, text)
        if not rows and not passed_header and not any(NUMBER.fullmatch(f) or _is_nothing(f) for f in fields):
            passed_header = True
            continue
        values = [_number(path, number, field) for field in fields]
        if len(values) > _MOST_COLUMNS or (rows and len(values) != len(rows[0])):
            wanted = f"the first line has {len(rows[0])}" if rows else f"at most {_MOST_COLUMNS} are read"
            raise InputError(f"{path}:{number}: {len(values)} columns, {wanted}")
        rows.append(values)
    if not rows:
        raise InputError(f"{path}: holds no line with numbers; a table has one to four columns of them")
    return np.array(rows)


def _fields(path: Path, line: int, text: str) -> list[str]:
    """Fields of a line; a comma inside a field that other signs separate is a decimal comma, which is refused."""
    others = [f for f in re.split(r"[;\s]+", text.strip().strip(";")) if f]
    if "," not in text:
        return others
    if len(others) > 1 and all(has_decimal_comma(f) or NUMBER.fullmatch(f) for f in others):
        raise InputError(f"{path}:{line}: {text.strip()[:40]!r} has decimal commas; write decimals with a point")
    return [f.strip() for f in text.strip().split(",")]


def _is_nothing(field: str) -> bool:
    return field.casefold().lstrip("+-") in ("", "nan", "inf", "infinity", "none", "null")


def _number(path: Path, line: int, field: str) -> float:
    value = float(field) if NUMBER.fullmatch(field) else float("inf")
    if not abs(value) < 1e300:
        raise InputError(f"{path}:{line}: {field[:40]!r} is not a number; every field of the table needs one")
    return value

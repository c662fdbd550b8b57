"""Small tables of points with a header: x, y and whatever else a point carries along."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.plain_files import read_text
from photoplan.io.text_columns import DELIMITERS, NUMBER

MAX_BYTES = 1_000_000_000


@dataclass(frozen=True, eq=False)
class XYTable:
    """Points of a table."""

    path: Path
    header: tuple[str, ...]
    """Names of all columns as the file writes them."""
    rows: tuple[tuple[str, ...], ...]
    """Fields of each line, as text."""
    lines: NDArray[np.int64]
    """Number of each line in the file."""
    xy: NDArray[np.float64]
    """The two columns that were asked for, shape (n, 2)."""
    roles: Mapping[str, int]
    """Column of each role that the file has."""

    def column(self, role: str) -> NDArray[np.float64] | None:
        """Numbers of a role's column, NaN where the field is empty; None if the file has no such column."""
        if role not in self.roles:
            return None
        return np.array([_number(self, i, self.roles[role], empty=True) for i in range(len(self.rows))], float)

    def texts(self, role: str) -> list[str] | None:
        """Fields of a role's column; None if the file has no such column."""
        return [row[self.roles[role]] for row in self.rows] if role in self.roles else None


def read_xy_table(path: Path, roles: Mapping[str, Sequence[str]]) -> XYTable:
    """A table whose first line names its columns; comma, semicolon, tab or spaces between them.

    Parameters
    ----------
    path : Path
    roles : mapping
        Names (small letters) under which a column may stand, for each role; `x` and `y` must be among the roles and
        in the file.

    Raises
    ------
    InputError
        A column is missing, a line has another number of fields than the header, or a coordinate is no number; the
        message names the line.
    """
    lines = [
        (number, text)
        for number, text in enumerate(read_text(path, MAX_BYTES).split("\n"), 1)
        if text.strip() and not text.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError(f"{path}: holds no line with data")
    delimiter = next((d for d in DELIMITERS if d in lines[0][1].strip()), ",")
    split = [_split(path, number, text, delimiter) for number, text in lines]
    header = split[0]
    known = [name.lower() for name in header]
    found = {role: next((known.index(n) for n in names if n in known), -1) for role, names in roles.items()}
    missing = [f"{role} ({', '.join(roles[role])})" for role in ("x", "y") if found[role] < 0]
    if missing:
        raise InputError(
            f"{path}:{lines[0][0]}: columns {', '.join(header)} given; the first line must name {' and '.join(missing)}"
        )
    if len(split) < 2:
        raise InputError(f"{path}: holds a header and no point")
    for (number, _), fields in zip(lines, split):
        if len(fields) != len(header):
            hint = "; decimal commas are not read, write points" if delimiter == "," else ""
            raise InputError(f"{path}:{number}: {len(fields)} fields, the header has {len(header)}{hint}")
    numbers = np.array([number for number, _ in lines[1:]], np.int64)
    roles_found = {role: column for role, column in found.items() if column >= 0}
    table = XYTable(path, header, tuple(split[1:]), numbers, np.empty((0, 2)), roles_found)
    xy = [[_number(table, i, found[role]) for role in ("x", "y")] for i in range(len(table.rows))]
    return XYTable(path, header, table.rows, numbers, np.array(xy), roles_found)


def _split(path: Path, line: int, text: str, delimiter: str) -> tuple[str, ...]:
    try:
        # Tabs at the end of a line are empty fields, spaces are not.
        fields = next(csv.reader([text.strip(" ")], delimiter=delimiter, skipinitialspace=True, strict=True))
    except (csv.Error, StopIteration) as error:
        raise InputError(f"{path}:{line}: cannot be split into columns ({error})") from None
    return tuple(field.strip() for field in fields)


def _number(table: XYTable, row: int, column: int, empty: bool = False) -> float:
    text = table.rows[row][column]
    if empty and not text:
        return math.nan
    if not NUMBER.fullmatch(text):
        hint = "; write decimals with a point" if "," in text else ""
        raise InputError(
            f"{table.path}:{table.lines[row]}: column {table.header[column]!r} holds {text[:40]!r}; a number is needed"
            + hint
        )
    return float(text)

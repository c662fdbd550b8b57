"""Tables of named things in text files: columns by header, as declared, or in the one order that a format has.

Separated by comma, semicolon, tab or spaces. Empty lines and lines that begin with ``#`` are passed over; a first line
with ``#`` that names the columns is the header. Every error names file and line.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.io.disk import disk_error, write_atomically
from photoplan.io.plain_files import read_text
from photoplan.io.text_columns import (
    DELIMITERS,
    NUMBER,
    decimal,
    find_delimiter,
    has_decimal_comma,
    number_of_columns,
    split_line,
)

MAX_BYTES = 1_000_000_000
_NOTHING = ("nan", "inf", "infinity", "null", "none", "na", "n/a")


@dataclass(frozen=True)
class TableColumns:
    """What columns a kind of table has, and what a user declares of one file."""

    roles: Mapping[str, Sequence[str]]
    """Header names, in small letters, of every role."""
    needed: tuple[str, ...]
    """Roles without which the table is of no use."""
    orders: tuple[tuple[str, ...], ...] = ()
    """Roles in their order where a table has no header, one for each number of columns; empty: a header is needed."""
    declared: str | None = None
    """Roles of the columns in their order as the user declares them, as in ``"name,-,x,y,z"``; ``-``: not used."""
    decimal_comma: bool = False
    """Whether numbers are written 1,5 instead of 1.5."""


@dataclass(frozen=True, eq=False)
class NamedTable:
    """A table that was split into fields."""

    path: Path
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    """Line of each row in the file."""
    roles: Mapping[str, int]
    """Column of every role that the table has."""
    decimal_comma: bool = False

    def where(self, k: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.path}:{self.lines[k]}"

    def texts(self, role: str) -> list[str]:
        """Fields of a role, stripped; empty strings where the table has no such column."""
        if role not in self.roles:
            return [""] * len(self.rows)
        at = self.roles[role]
        return [row[at] for row in self.rows]

    def names(self, role: str) -> list[str]:
        """Fields of a role, none of them empty.

        Raises
        ------
        InputError
            A field is empty, has control characters or more than 1000 characters.
        """
        found = self.texts(role)
        for k, text in enumerate(found):
            if not text or any(ord(c) < 32 for c in text) or len(text) > 1000:
                raise InputError(f"{self.where(k)}: {role} is {text[:40]!r}; a name of at most 1000 characters needed")
        return found

    def numbers(self, role: str, empty: bool = False) -> NDArray[np.float64]:
        """Numbers of a role, shape (n,); NaN where the field is empty (if `empty`) or there is no such column.

        Raises
        ------
        InputError
            A field is no finite number.
        """
        if role not in self.roles:
            return np.full(len(self.rows), np.nan)
        at = self.roles[role]
        return np.array([self._number(k, row[at], role, empty) for k, row in enumerate(self.rows)], float)

    def _number(self, k: int, text: str, role: str, empty: bool) -> float:
        if empty and not text:
            return math.nan
        value = decimal(text, self.decimal_comma)
        if value is not None:
            return value
        hint = ""
        if not self.decimal_comma and has_decimal_comma(text):
            hint = "; write decimals with a point"
        elif not text or text.casefold().lstrip("+-") in _NOTHING:
            hint = "; leave the field empty where it is not known" if empty else "; give it or delete the line"
        raise InputError(f"{self.where(k)}: {role} = {text[:40]!r} is not a number{hint}")


def read_named_table(path: Path, columns: TableColumns) -> NamedTable:
    """The fields of a text table.

    Raises
    ------
    InputError
        The file cannot be read or holds no data, needed columns are missing, or a line has another number of fields
        than the first; the message names the line.
    """
    lines = [(n, text) for n, text in enumerate(read_text(path, MAX_BYTES).split("\n"), 1) if text.strip()]
    data = [(n, text) for n, text in lines if not text.lstrip().startswith("#")]
    if columns.declared is None and lines and lines[0][1].lstrip().startswith("#"):
        head = (lines[0][0], lines[0][1].lstrip()[1:].strip())
        splits = [d for d in DELIMITERS if number_of_columns(path, head, d) >= len(columns.needed)]
        if any(_header(split_line(path, head, d), columns) is not None for d in splits):
            data.insert(0, head)
    if not data:
        raise InputError(f"{path}: holds no line with data")
    allowed = [d for d in DELIMITERS if d != "," or not columns.decimal_comma]
    delimiter = find_delimiter(path, data, columns.needed, allowed)
    first = split_line(path, data[0], delimiter)
    roles, skip = _roles(f"{path}:{data[0][0]}", first, columns)
    body = data[skip:]
    if not body:
        raise InputError(f"{path}: holds a header and no line with data")
    rows = tuple(split_line(path, item, delimiter) for item in body)
    for (line, _), row in zip(body, rows):
        if len(row) != len(first):
            hint = "; is the decimal sign a comma? write decimals with a point" if delimiter == "," else ""
            raise InputError(f"{path}:{line}: {len(row)} columns, the first line has {len(first)}{hint}")
    return NamedTable(path, rows, tuple(line for line, _ in body), roles, columns.decimal_comma)


def _roles(where: str, first: tuple[str, ...], columns: TableColumns) -> tuple[dict[str, int], int]:
    """Column of every role, and how many lines the header has."""
    if columns.declared is not None:
        return _declared(where, first, columns)
    found = _header(first, columns)
    if found is not None:
        return found, 1
    order = next((o for o in columns.orders if len(o) == len(first)), None)
    numeric = sum(bool(NUMBER.fullmatch(f.replace(",", "."))) for f in first)
    if order is not None and numeric >= 2:
        return {role: k for k, role in enumerate(order)}, 0
    if numeric >= 2:
        raise InputError(
            f"{where}: {' '.join(first)[:80]!r} is no header; what the {len(first)} columns mean is not guessed: put a "
            f"first line that names them ({', '.join(columns.needed)} …, `-` for one that is not used)"
        )
    names = [f.casefold() for f in first]
    wrong = []
    for role in columns.needed:
        if not any(name in columns.roles[role] for name in names):
            wrong.append(f"{role} (no column called {' or '.join(columns.roles[role])})")
    what = "; ".join(wrong) or "two columns of one name"
    raise InputError(f"{where}: header {', '.join(first)[:200]}: {what}; name the columns so")


def _header(row: tuple[str, ...], columns: TableColumns) -> dict[str, int] | None:
    """Column of every role, by the first of its names that the header has; None where a needed one is missing."""
    names = [field.casefold() for field in row]
    found: dict[str, int] = {}
    for role, synonyms in columns.roles.items():
        own = next((name for name in synonyms if name in names), None)
        if own is None:
            continue
        if names.count(own) > 1:
            return None
        found[role] = names.index(own)
    return found if all(role in found for role in columns.needed) else None


def _declared(where: str, first: tuple[str, ...], columns: TableColumns) -> tuple[dict[str, int], int]:
    given = [c for c in re.split(r"[,\s]+", (columns.declared or "").strip()) if c]
    roles = {role: k for k, role in enumerate(given) if role != "-"}
    unknown = [r for r in roles if r not in columns.roles]
    missing = [r for r in columns.needed if r not in roles]
    if unknown or missing or len(roles) != sum(r != "-" for r in given):
        reason = f"unknown {', '.join(unknown)}" if unknown else f"missing {', '.join(missing)}" if missing else "twice"
        raise UsageError(f"declared columns {columns.declared!r}: {reason}; allowed are {', '.join(columns.roles)}, -")
    if len(given) != len(first):
        raise InputError(
            f"{where}: {len(first)} columns, {len(given)} are declared ({', '.join(given)}); write `-` for columns "
            "that are not used"
        )
    numbers = [first[roles[r]] for r in roles if r in ("x", "y", "z", "sigma")]
    header = bool(numbers) and not any(re.match(r"[-+.]?\d", text) for text in numbers)
    return roles, int(header)


def write_named_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a comma-separated table with a header; it appears complete or not at all, in a folder that is made.

    Raises
    ------
    ResourceError, UsageError
        The disk is full, or the folder cannot be written to.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(path, error) from error
    write_atomically(path, text.getvalue().encode())

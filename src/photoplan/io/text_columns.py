"""Lines of text tables: split into columns by the delimiter that fits, and decimal numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

from photoplan.errors import InputError

#: In the order in which they are tried.
DELIMITERS = (";", "\t", ",", " ")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
#: Lines that decide the delimiter.
_SNIFFED = 20


def split_line(path: Path, item: tuple[int, str], delimiter: str) -> tuple[str, ...]:
    """Fields of a line, stripped; quotes hold a delimiter together.

    Parameters
    ----------
    path : Path
        For the message.
    item : tuple of int and str
        Number of the line, from 1, and its text.
    delimiter : str
        One of `DELIMITERS`; a table in columns by spaces may hold tabs too.

    Raises
    ------
    InputError
        Its quotes are not closed.
    """
    line, text = item
    if '"' not in text:
        fields = text.split() if delimiter == " " else text.split(delimiter)
        return tuple(field.strip() for field in fields)
    text = text.expandtabs(1).strip() if delimiter == " " else text
    try:
        fields = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True))
    except (csv.Error, StopIteration) as error:
        raise InputError(f"{path}:{line}: cannot be split into columns ({error})") from None
    return tuple(field.strip() for field in fields)


def number_of_columns(path: Path, item: tuple[int, str], delimiter: str) -> int:
    """Columns of a line; 0 where quotes do not allow this delimiter."""
    try:
        return len(split_line(path, item, delimiter))
    except InputError:
        return 0


def find_delimiter(
    path: Path, data: Sequence[tuple[int, str]], needed: Sequence[str], allowed: Sequence[str] = DELIMITERS
) -> str:
    """The first that splits the first lines into equally many and enough columns, or at least the first line.

    Parameters
    ----------
    path : Path
        For the message.
    data : sequence of (int, str)
        Numbered lines, at least one.
    needed : sequence of str
        Columns without which the table is of no use.
    allowed : sequence of str
        Those of `DELIMITERS` that are tried.

    Raises
    ------
    InputError
        The first line has too few columns by any of them.
    """
    enough = []
    for delimiter in allowed:
        counts = [number_of_columns(path, item, delimiter) for item in data[:_SNIFFED]]
        if counts[0] >= len(needed):
            if len(set(counts)) == 1:
                return delimiter
            enough.append(delimiter)
    if enough:
        return enough[0]
    line, text = data[0]
    raise InputError(
        f"{path}:{line}: {text.strip()[:80]!r} has fewer than {len(needed)} columns by comma, semicolon, tab or space; "
        f"needed are {', '.join(needed)}"
    )


def decimal(text: str, decimal_comma: bool) -> float | None:
    """A number written with a decimal point (or comma, if `decimal_comma`); None for anything else and from 1e300."""
    plain = text.replace(",", ".") if decimal_comma and "." not in text else text
    value = float(plain) if NUMBER.fullmatch(plain) else float("inf")
    return value if abs(value) < 1e300 else None


def has_decimal_comma(text: str) -> bool:
    """Whether a text is a number such as 1,5."""
    return re.fullmatch(r"[-+]?\d+,\d+", text) is not None

"""Tables of conditions: a column ``file`` and one column for each condition."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.plain_files import read_text
from photoplan.io.series.names import Values, condition
from photoplan.io.text_columns import DELIMITERS, decimal, split_line

_MAX_BYTES = 100_000_000


def read_columns(path: Path) -> tuple[tuple[str, ...], list[tuple[int, tuple[str, ...]]]]:
    """Header (small letters) and numbered lines of a table with comma, semicolon, tab or spaces between its columns.

    Lines that are empty or begin with ``#`` are passed over. Where the delimiter is no comma, decimal commas are read.

    Raises
    ------
    InputError
        There is no line of data, or a line has another number of fields than the header.
    """
    lines = [
        (number, text)
        for number, text in enumerate(read_text(path, _MAX_BYTES).split("\n"), 1)
        if text.strip() and not text.lstrip().startswith("#")
    ]
    if len(lines) < 2:
        raise InputError(f"{path}: holds {'a header and no line' if lines else 'no line'} of data")
    delimiter = next((d for d in DELIMITERS if d in lines[0][1].strip()), ",")
    header = tuple(name.lower() for name in split_line(path, lines[0], delimiter))
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise InputError(f"{path}:{lines[0][0]}: column {twice[0]!r} stands twice")
    rows = []
    for line in lines[1:]:
        fields = split_line(path, line, delimiter)
        if len(fields) != len(header):
            hint = "; decimal commas need semicolons between the columns" if delimiter == "," else ""
            raise InputError(f"{path}:{line[0]}: {len(fields)} fields, the header has {len(header)}{hint}")
        rows.append((line[0], tuple(_pointed(field, delimiter) for field in fields)))
    return header, rows


def _pointed(field: str, delimiter: str) -> str:
    if delimiter == "," or field.count(",") != 1:
        return field
    number = decimal(field, True)
    return field if number is None else repr(number)


def read_conditions(path: Path) -> dict[str, Values]:
    """Conditions of each file by its name; empty fields state nothing.

    Raises
    ------
    InputError
        There is no column ``file``, a file stands twice, or a condition is no number; the message names the line.
    """
    header, rows = read_columns(path)
    if "file" not in header:
        raise InputError(f"{path}: columns {', '.join(header)} given; one must be called file")
    found: dict[str, Values] = {}
    for line, fields in rows:
        values = dict(zip(header, fields))
        name = values.pop("file")
        if not name or name in found:
            raise InputError(f"{path}:{line}: file {name!r} {'stands twice' if name else 'is empty'}")
        found[name] = dict(condition(key, text, f"{path}:{line}") for key, text in values.items() if text)
    return found

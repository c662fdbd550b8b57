"""Tables of points read in parts and written again with more columns: any number of lines, little memory."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError

DELIMITERS = (",", ";", "\t", " ")
_NAMES = {
    "x": ("x", "east", "easting", "e", "x_m", "rechtswert", "point_x", "longitude", "lon"),
    "y": ("y", "north", "northing", "n", "y_m", "hochwert", "point_y", "latitude", "lat"),
}
_LINE = 1_000_000
"""Characters of a line at most."""


@dataclass(frozen=True)
class PointTableFormat:
    """What a table does not say of itself."""

    x: str | None = None
    """Name of the column of X, or its number from 1; None: `x`, `east`, `easting` …"""
    y: str | None = None
    delimiter: str | None = None
    """None: the one among comma, semicolon, tab and space that splits the first line."""
    decimal_comma: bool = False
    """Whether numbers are written 1,5 instead of 1.5."""
    header: bool = True
    """Whether the first line names the columns."""

    def __post_init__(self) -> None:
        if self.delimiter is not None and self.delimiter not in DELIMITERS:
            raise UsageError(f"delimiter {self.delimiter!r}; allowed are comma, semicolon, tab and space")
        if self.delimiter == "," and self.decimal_comma:
            raise UsageError("a comma cannot be both delimiter and decimal sign")


@dataclass(frozen=True, eq=False)
class PointPart:
    """Some lines of the table."""

    rows: list[list[str]]
    """Their fields, as the file has them."""
    xy: NDArray[np.float64]
    """X, Y, shape (n, 2)."""


class PointTable:
    """A text file of points with a header; opened by `parts`, as often as wanted.

    Raises
    ------
    InputError
        When made: the file cannot be read, holds no points, or its columns are not found. In `parts`: a line cannot
        be read as declared; the message names the line and the column.
    """

    def __init__(self, path: Path, form: PointTableFormat = PointTableFormat()) -> None:
        self.path, self.form = Path(path), form
        with self._open() as file:
            lines = self._lines(file)
            line, text = next(lines, (0, ""))
            if not line:
                raise InputError(f"{self.path}: holds no line with data")
            self.delimiter = form.delimiter or self._sniffed(text)
            fields = self._split(line, text)
            self.names = fields if form.header else [str(i + 1) for i in range(len(fields))]
            if form.header and all(_number(f, form.decimal_comma) is not None for f in fields):
                raise InputError(
                    f"{self.path}:{line}: the first line holds numbers, no names of columns; say `header=False`, "
                    "and which columns are X and Y if not the first two"
                )
            self._x, self._y = self._column("x", line), self._column("y", line)
            if form.header and next(lines, None) is None:
                raise InputError(f"{self.path}: holds a header and no point")

    def parts(self, size: int) -> Iterator[PointPart]:
        """The points, in parts of at most `size` lines."""
        with self._open() as file:
            lines = self._lines(file)
            if self.form.header:
                next(lines)
            rows: list[list[str]] = []
            xy: list[tuple[float, float]] = []
            for line, text in lines:
                fields = self._split(line, text)
                if len(fields) != len(self.names):
                    hint = "; is the decimal sign a comma? then say `decimal_comma`" if self.delimiter == "," else ""
                    raise InputError(
                        f"{self.path}:{line}: {len(fields)} columns, the first line has {len(self.names)}{hint}"
                    )
                rows.append(fields)
                xy.append((self._value(fields, self._x, line), self._value(fields, self._y, line)))
                if len(rows) == size:
                    yield PointPart(rows, np.array(xy))
                    rows, xy = [], []
            if rows:
                yield PointPart(rows, np.array(xy))

    @contextmanager
    def _open(self) -> Iterator[IO[str]]:
        try:
            with self.path.open(encoding="utf-8-sig", newline=None) as file:
                yield file
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: not UTF-8 ({error.reason}); save the file as UTF-8") from None
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror or error})") from None

    def _lines(self, file: IO[str]) -> Iterator[tuple[int, str]]:
        """Number and text of the lines that are not empty."""
        number = 0
        while text := file.readline(_LINE):
            number += 1
            if len(text) >= _LINE or "\0" in text:
                raise InputError(f"{self.path}:{number}: is no line of a table of points")
            if text.strip():
                yield number, text.rstrip("\n")

    def _sniffed(self, text: str) -> str:
        if self.form.decimal_comma:
            return next((d for d in DELIMITERS[1:] if d in text.strip()), ";")
        return next((d for d in DELIMITERS if d in text.strip()), ",")

    def _split(self, line: int, text: str) -> list[str]:
        if self.delimiter == " ":
            return text.split()
        if '"' not in text:
            return [field.strip() for field in text.split(self.delimiter)]
        try:
            fields = next(csv.reader([text], delimiter=self.delimiter, skipinitialspace=True, strict=True))
        except (csv.Error, StopIteration) as error:
            raise InputError(f"{self.path}:{line}: cannot be split into columns ({error})") from None
        return [field.strip() for field in fields]

    def _column(self, axis: str, line: int) -> int:
        """Where the column of an axis is."""
        wanted = getattr(self.form, axis)
        lower = [name.casefold() for name in self.names]
        if wanted is None:
            if not self.form.header:
                wanted = "1" if axis == "x" else "2"
            else:
                wanted = next((name for name in _NAMES[axis] if name in lower), None)
                if wanted is None:
                    raise InputError(
                        f"{self.path}:{line}: no column for {axis.upper()} in {', '.join(self.names)[:200]}; name it "
                        f"with --{axis} NAME"
                    )
        found = [i for i, name in enumerate(lower) if name == wanted.casefold()]
        if len(found) == 1:
            return found[0]
        if wanted.isdigit() and 1 <= int(wanted) <= len(self.names):
            return int(wanted) - 1
        raise InputError(
            f"{self.path}:{line}: {len(found) or 'no'} columns {wanted!r} for {axis.upper()}; "
            f"the columns are {', '.join(self.names)[:200]}"
        )

    def _value(self, fields: list[str], column: int, line: int) -> float:
        value = _number(fields[column], self.form.decimal_comma)
        if value is None:
            text = fields[column]
            comma = re.fullmatch(r"[-+]?\d+,\d+", text) and not self.form.decimal_comma
            hint = "; if the table uses decimal commas, say `decimal_comma`" if comma else ""
            raise InputError(f"{self.path}:{line}: {self.names[column]} = {text[:40]!r} is not a finite number{hint}")
        return value


def _number(text: str, decimal_comma: bool) -> float | None:
    """A finite number, or None."""
    if decimal_comma:
        text = text.replace(",", ".")
    try:
        value = float(text)
    except ValueError:
        return None
    # float() takes 1_000 for a number; nobody who writes a table means it.
    return value if abs(value) < 1e12 and "_" not in text else None

"""Tables of points read in parts and written again with more columns: any number of lines, little memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.plain_files import whole_number
from photoplan.io.table_lines import DELIMITERS, Line, decimal, line_blocks, number, split_line
from photoplan.io.tables import Dialect, TableLayout, wrong_width

_NAMES = {
    "x": ("x", "east", "easting", "e", "x_m", "rechtswert", "point_x", "longitude", "lon"),
    "y": ("y", "north", "northing", "n", "y_m", "hochwert", "point_y", "latitude", "lat"),
}


@dataclass(frozen=True)
class PointTableFormat:
    """What a table does not say of itself."""

    x: str | None = None
    """Name of the column of X, or its number from 1; None: `x`, `east`, `easting` …"""
    y: str | None = None
    dialect: Dialect = field(default_factory=Dialect)
    """Delimiter and decimal sign."""
    header: bool = True
    """Whether the first line names the columns."""


@dataclass(frozen=True, eq=False)
class PointPart:
    """Some lines of the table."""

    rows: list[tuple[str, ...]]
    """Their fields, as the file has them."""
    xy: NDArray[np.float64]
    """X, Y, shape (n, 2)."""


class PointTable:
    """A text file of points with a header; opened by `parts`, as often as wanted."""

    def __init__(self, path: Path, form: PointTableFormat = PointTableFormat()) -> None:
        self.path, self.form = Path(path), form
        head = list(islice(self._lines(), 2))
        if not head:
            raise InputError(f"{self.path}: holds no line with data")
        self.delimiter = form.dialect.delimiter or self._sniffed(head[0][1])
        fields = split_line(self.path, head[0], self.delimiter)
        self.names = fields if form.header else tuple(str(i + 1) for i in range(len(fields)))
        if form.header and all(decimal(f, form.dialect.decimal_comma) is not None for f in fields):
            raise InputError(
                f"{self.path}:{head[0][0]}: the first line holds numbers, no names of columns; say `header=False`, "
                "and which columns are X and Y if not the first two"
            )
        self._x, self._y = self._column("x", head[0][0]), self._column("y", head[0][0])
        if form.header and len(head) < 2:
            raise InputError(f"{self.path}: holds a header and no point")

    def parts(self, size: int) -> Iterator[PointPart]:
        """The points, in parts of at most `size` lines."""
        lines = islice(self._lines(), int(self.form.header), None)
        layout = TableLayout(delimiter=self.delimiter, roles={}, names=self.names, header=0)
        comma = self.form.dialect.decimal_comma
        while part := list(islice(lines, size)):
            rows = [split_line(self.path, item, self.delimiter) for item in part]
            xy = np.empty((len(rows), 2))
            for k, ((line, _), row) in enumerate(zip(part, rows)):
                where = f"{self.path}:{line}"
                if len(row) != len(self.names):
                    raise InputError(f"{where}: {wrong_width(len(row), layout)}")
                xy[k] = [number(row[at], f"{where}: {self.names[at]}", comma) for at in (self._x, self._y)]
            yield PointPart(rows, xy)

    def _lines(self) -> Iterator[Line]:
        """The lines that are not empty."""
        for first, lines in line_blocks(self.path):
            yield from (item for item in enumerate(lines, first) if item[1].strip())

    def _sniffed(self, text: str) -> str:
        """The delimiter that the first line holds, a comma before all others where it is no decimal sign."""
        tried = [d for d in (",", *DELIMITERS) if d != "," or not self.form.dialect.decimal_comma]
        return next((d for d in tried if d in text.strip()), tried[0])

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
                        f"with `{axis}` NAME"
                    )
        found = [i for i, name in enumerate(lower) if name == wanted.casefold()]
        if len(found) == 1:
            return found[0]
        if 1 <= (whole_number(wanted) or 0) <= len(self.names):
            return int(wanted) - 1
        raise InputError(
            f"{self.path}:{line}: {len(found) or 'no'} columns {wanted!r} for {axis.upper()}; "
            f"the columns are {', '.join(self.names)[:200]}"
        )

"""Columns of a text file of points: what they hold, and blocks of lines turned into numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.table_lines import NOTHING, decimal, has_decimal_comma, number, split_line
from photoplan.io.tables import Columns, Dialect, TableLayout, find_layout, wrong_width
from photoplan.io.terrain.options import CodeClass

LookUp = Callable[[str, int], CodeClass]
"""Class of a code; the line is for messages."""

#: Header names (in small letters) of every role.
HEADERS = {
    "x": ("x", "east", "easting", "e", "rechtswert"),
    "y": ("y", "north", "northing", "n", "hochwert"),
    "z": ("z", "height", "h", "elevation", "elev", "altitude", "z_left"),
    "code": ("code", "kind", "class", "type"),
    "sigma": ("sigma", "stddev", "sd", "accuracy"),
    "name": ("name", "id", "point", "nr", "number", "label"),
    "line": ("line", "line_id", "lineid", "string"),
    "z_right": ("z_right", "right", "zright"),
}
NEEDED = ("x", "y", "z")
NUMBERS = ("x", "y", "z", "sigma", "z_right")
TEXT = 32
"""Characters of a text that the fast way keeps; blocks with longer ones are read the slow way."""
_NONE = (*NOTHING, "-")


def _explain(first: tuple[str, ...], why: str) -> str | None:
    """What a first line is that holds no record: no header either."""
    if all(decimal(f) is not None for f in first[:3]):
        return None
    hint = ""
    if any(has_decimal_comma(f) or re.fullmatch(r"\d+ [-+]?\d+", f) for f in first):
        hint = "; decimal commas have to be declared (`decimal_comma`)"
    return (
        f"{', '.join(first)[:120]!r} is neither a record nor a header with X, Y and Z: {why}; declare the columns, for "
        f"example x,y,z,code or x=East,y=North,z=Height{hint}"
    )


COLUMNS = Columns(
    roles=HEADERS,
    needed=NEEDED,
    numbers=frozenset(NUMBERS),
    orders=tuple(tuple(HEADERS)[:n] for n in range(3, len(HEADERS) + 1)),
    one_each=True,
    explain=_explain,
)


@dataclass(frozen=True, eq=False)
class PointBlock:
    """Columns of a block of lines."""

    xyz: NDArray[np.float64]
    records: NDArray[np.int64]
    code: list[str] | None
    line: list[str] | None
    name: list[str] | None
    sigma: NDArray[np.float64] | None
    right: NDArray[np.float64] | None


def points_layout(path: Path, lines: Sequence[str], dialect: Dialect) -> TableLayout | None:
    """What the columns hold, from the first lines of a file; None: they hold no data."""
    head = [item for item in enumerate(lines[:1000], 1) if item[1].strip()]
    data = [item for item in head if not item[1].lstrip().startswith("#")]
    if not data:
        return None
    found = find_layout(path, head, COLUMNS, dialect)
    if not found.by_order or found.width == 3:
        return found
    where = f"{path}:{data[0][0]}"
    rows = [split_line(path, item, found.delimiter) for item in data[:20]]
    if _are_numbers_of_points(rows):
        raise InputError(
            f"{where}: the first column counts 1 by 1 like numbers of points, and there is no header; "
            "declare the columns, for example name,x,y,z (or x,y,z,code if it is X)"
        )
    for role in ("sigma", "z_right"):
        text = found.names[found.roles[role]] if role in found.roles else "0"
        if text.casefold() not in _NONE and decimal(text, dialect.decimal_comma) is None:
            raise InputError(
                f"{where}: {found.width} columns without a header that are not {', '.join(HEADERS)}; declare them, for "
                "example name,x,y,z,-,code (`-` for a column that is not used)"
            )
    return found


def _are_numbers_of_points(rows: Sequence[Sequence[str]]) -> bool:
    first = [row[0] for row in rows]
    if len(first) < 3 or not all(re.fullmatch(r"\d{1,9}", text) for text in first):
        return False
    return all(int(b) - int(a) == 1 for a, b in pairwise(first))


def parse_block(
    path: Path, layout: TableLayout, first: int, lines: list[str], look_up: LookUp, decimal_comma: bool
) -> PointBlock | None:
    """Columns of the lines of a block that hold data; None if there are none."""
    keep = [at for at, text in enumerate(lines) if text and not text.isspace() and text.lstrip()[0] != "#"]
    if keep and first + keep[0] == layout.header:
        keep = keep[1:]
    if not keep:
        return None
    if len(keep) < len(lines):
        lines = [lines[at] for at in keep]
    records = np.array(keep, np.int64) + first
    block = _fast(layout, lines, records, decimal_comma)
    return block if block is not None else _slow(path, layout, lines, records, look_up, decimal_comma)


def _fast(layout: TableLayout, lines: list[str], records: NDArray[np.int64], decimal_comma: bool) -> PointBlock | None:
    """Columns by NumPy's reader; None where anything is unusual."""
    texts = [r for r in layout.roles if r not in NUMBERS]
    if decimal_comma:
        lines = [text.replace(",", ".") for text in lines]
    of_column = {at: role for role, at in layout.roles.items()}
    plain = len(of_column) == layout.width and not texts
    kinds = [(f"c{at}", "f8" if of_column.get(at) in NUMBERS else f"U{TEXT}") for at in range(layout.width)]
    try:
        table: Any = np.loadtxt(
            lines,
            dtype=np.float64 if plain else np.dtype(kinds),
            delimiter=None if layout.delimiter == " " else layout.delimiter,
            comments=None,
            quotechar='"',
            ndmin=2 if plain else 1,
        )
    except (ValueError, OverflowError):
        return None
    if len(table) != len(lines) or (plain and table.shape[1] != layout.width):
        return None

    def column(role: str) -> Any:
        at = layout.roles.get(role)
        return None if at is None else table[:, at] if plain else table[f"c{at}"]

    xyz = np.stack([column(r) for r in NEEDED], axis=1)
    sigma, right = column("sigma"), column("z_right")
    if not np.isfinite(xyz).all() or any(c is not None and not (c >= 0).all() for c in (sigma,)):
        return None
    if right is not None and not np.isfinite(right).all():
        return None
    found: dict[str, list[str] | None] = dict.fromkeys(("code", "line", "name"))
    for role in texts:
        values = column(role).tolist()
        if max(map(len, values)) >= TEXT or any("'" in v or (decimal_comma and "." in v) for v in values):
            return None  # the text may be cut off or in quotes, or its point may have been a comma
        found[role] = [v.strip() for v in values]
    return PointBlock(
        xyz=xyz,
        records=records,
        code=found["code"],
        line=found["line"],
        name=found["name"],
        sigma=None if sigma is None else np.array(sigma),
        right=None if right is None else np.array(right),
    )


def _slow(
    path: Path, layout: TableLayout, lines: list[str], records: NDArray[np.int64], look_up: LookUp, decimal_comma: bool
) -> PointBlock:
    """The same line by line: it names the line and the column that cannot be read."""
    rows: dict[str, list[Any]] = {role: [] for role in layout.roles}
    for record, text in zip(records.tolist(), lines):
        where = f"{path}:{record}"
        fields = split_line(path, (record, text), layout.delimiter)
        if len(fields) != layout.width:
            raise InputError(f"{where}: {wrong_width(len(fields), layout)}")
        code = fields[layout.roles["code"]] if "code" in layout.roles else ""
        for role, at in layout.roles.items():
            if role not in NUMBERS:
                rows[role].append(fields[at])
                continue
            value = decimal(fields[at], decimal_comma)
            if value is None:
                may_miss = role in ("sigma", "z_right") or (role == "z" and _without_height(look_up(code, record)))
                if not (may_miss and fields[at].casefold().lstrip("+-") in _NONE):
                    number(fields[at], f"{where}: {role}", decimal_comma)
                value = math.nan
            if role == "sigma" and value < 0:
                raise InputError(f"{where}: sigma = {fields[at]!r}; a standard deviation is zero or more")
            rows[role].append(value)
    found = {r: np.array(rows[r], np.float64) for r in NUMBERS if r in rows}
    xyz = np.stack([found[r] for r in NEEDED], axis=1)
    texts = (rows.get("code"), rows.get("line"), rows.get("name"))
    return PointBlock(xyz, records, *texts, found.get("sigma"), found.get("z_right"))


def _without_height(cls: CodeClass) -> bool:
    return cls.kind in ("border", "hole", "ignore")

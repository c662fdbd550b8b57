"""Columns of a text file of points: what they hold, and blocks of lines turned into numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.terrain.options import CodeClass, ReadOptions

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
ROLES = tuple(HEADERS)
NEEDED = ("x", "y", "z")
NUMBERS = ("x", "y", "z", "sigma", "z_right")
DELIMITERS = (";", "\t", ",", " ")
SNIFFED = 20
TEXT = 32
"""Characters of a text that the fast way keeps; blocks with longer ones are read the slow way."""

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?", re.ASCII)
_NONE = ("", "nan", "null", "none", "na", "n/a", "-")


@dataclass(frozen=True)
class Layout:
    """What the columns of a file are."""

    delimiter: str
    roles: dict[str, int]
    """Column of every role."""
    width: int
    """Number of columns; 0: lines may differ."""
    header: int
    """Line of the header; 0: there is none."""
    decimal_comma: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Block:
    """Columns of a block of lines."""

    xyz: NDArray[np.float64]
    records: NDArray[np.int64]
    code: list[str] | None
    line: list[str] | None
    name: list[str] | None
    sigma: NDArray[np.float64] | None
    right: NDArray[np.float64] | None


def _is_data(text: str) -> bool:
    bare = text.lstrip()
    return bool(bare) and not bare.startswith("#")


def split(text: str, delimiter: str) -> list[str]:
    """Fields of a line; a ValueError where quotes do not allow the delimiter."""
    if '"' not in text:
        return text.split() if delimiter == " " else [f.strip() for f in text.split(delimiter)]
    text = text.expandtabs().strip() if delimiter == " " else text
    try:
        return [f.strip() for f in next(csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True))]
    except (csv.Error, StopIteration) as error:
        raise ValueError(str(error)) from None


def find_layout(path: Path, lines: list[str], options: ReadOptions) -> Layout | None:
    """What the columns hold, from the first lines of a file; None: they hold no data.

    Raises
    ------
    InputError
        The lines cannot be split into three columns, or the header or the declaration does not name X, Y and Z.
    """
    data = [(n, text) for n, text in enumerate(lines[:1000], 1) if _is_data(text)]
    if not data:
        return None
    head = [(n, t.lstrip()[1:].strip()) for n, t in enumerate(lines[: data[0][0] - 1], 1) if t.lstrip().startswith("#")]
    delimiter = _delimiter(path, data[:SNIFFED], options)
    fields = _fields(path, data[0], delimiter)
    comma = options.decimal_comma
    if options.columns is not None and "=" not in options.columns:
        roles = _declared_order(options.columns, len(fields), f"{path}:{data[0][0]}")
        header = 0 if any(_number(fields[roles[r]], comma) is not None for r in NEEDED) else data[0][0]
        return Layout(delimiter, roles, len(fields), header, comma)
    renamed = None if options.columns is None else _declared_names(options.columns)
    numeric = sum(_number(f, comma) is not None for f in fields[:3]) == 3
    if renamed is None and numeric:
        commented = [(n, _roles_of(split(t, delimiter), None)) for n, t in head[-1:] if len(t) < 1000 and '"' not in t]
        if commented and isinstance(commented[0][1], dict):
            return Layout(delimiter, commented[0][1], len(fields), 0, comma)
        if len(fields) > 3 and _are_numbers_of_points([_fields(path, item, delimiter) for item in data[:SNIFFED]]):
            raise InputError(
                f"{path}:{data[0][0]}: the first column counts 1 by 1 like numbers of points, and there is no header; "
                "declare the columns, for example name,x,y,z (or x,y,z,code if it is X)"
            )
        return _by_order(path, data[0][0], fields, delimiter, comma)
    found = _roles_of(fields, renamed)
    if isinstance(found, str):
        raise InputError(
            f"{path}:{data[0][0]}: {', '.join(fields)[:120]!r} is neither a record nor a header with X, Y and Z "
            f"({found}); declare the columns, for example x,y,z,code or x=East,y=North,z=Height"
            + _comma_hint(fields, comma)
        )
    return Layout(delimiter, found, len(fields), data[0][0], comma)


def _are_numbers_of_points(rows: list[list[str]]) -> bool:
    first = [row[0] for row in rows]
    if len(first) < 3 or not all(re.fullmatch(r"\d{1,9}", text) for text in first):
        return False
    return all(int(b) - int(a) == 1 for a, b in pairwise(first))


def _by_order(path: Path, line: int, fields: list[str], delimiter: str, comma: bool) -> Layout:
    """The layout of files without header and declaration: x, y, z and then the further roles in their order."""
    roles = {role: at for at, role in enumerate(ROLES[: len(fields)])}
    numbers = [r for r in ("sigma", "z_right") if r in roles and fields[roles[r]].casefold() not in _NONE]
    if len(fields) > len(ROLES) or any(_number(fields[roles[r]], comma) is None for r in numbers):
        raise InputError(
            f"{path}:{line}: {len(fields)} columns without a header that are not {', '.join(ROLES)}; declare them, "
            "for example name,x,y,z,-,code (`-` for a column that is not used)"
        )
    notes = (f"{path.name}: no header; columns taken as {', '.join(roles)}",) if len(fields) > 3 else ()
    return Layout(delimiter, roles, len(fields), 0, comma, notes)


def _fields(path: Path, item: tuple[int, str], delimiter: str) -> list[str]:
    try:
        return split(item[1], delimiter)
    except ValueError as error:
        raise InputError(f"{path}:{item[0]}: cannot be split into columns ({error})") from None


def _delimiter(path: Path, data: list[tuple[int, str]], options: ReadOptions) -> str:
    """The declared delimiter, or the first that splits the lines into equally many columns with numbers in three."""
    if options.delimiter is not None:
        return options.delimiter
    candidates: list[tuple[int, str]] = []
    for delimiter in DELIMITERS:
        if delimiter == "," and options.decimal_comma:
            continue
        try:
            rows = [split(text, delimiter) for _, text in data]
        except ValueError:
            continue
        wide = [row for row in rows if len(row) >= 3]
        if wide:
            numbers = sum(_number(f, options.decimal_comma) is not None for f in wide[-1])
            equal = len({len(row) for row in rows}) == 1
            candidates.append((-2 * (numbers >= 3) - equal, delimiter))
    if not candidates:
        line, text = data[0]
        raise InputError(
            f"{path}:{line}: {text[:80]!r} has fewer than three columns by comma, semicolon, tab or space; "
            "X, Y and Z are needed"
        )
    return min(candidates, key=lambda c: c[0])[1]


def _declared_order(text: str, width: int, where: str) -> dict[str, int]:
    declared = [c for c in re.split(r"[,\s]+", text.strip()) if c]
    roles = {role: at for at, role in enumerate(declared) if role != "-"}
    _check_roles(list(roles), sum(d != "-" for d in declared))
    if len(declared) != width:
        raise InputError(
            f"{where}: {width} columns, {len(declared)} are declared ({', '.join(declared)}); "
            "write `-` for columns that are not used"
        )
    return roles


def _declared_names(text: str) -> dict[str, str]:
    pairs = [item.partition("=") for item in text.split(",")]
    names = {role.strip(): name.strip() for role, _, name in pairs}
    _check_roles(list(names), len(pairs))
    return names


def _check_roles(roles: list[str], given: int) -> None:
    unknown = [r for r in roles if r not in HEADERS]
    missing = [r for r in NEEDED if r not in roles]
    if unknown or missing or given != len(roles):
        what = (
            f"unknown {', '.join(unknown)}" if unknown else f"missing {', '.join(missing)}" if missing else "repeated"
        )
        raise InputError(f"declared columns: {what}; allowed are {', '.join(ROLES)}, needed are x, y, z")


def _roles_of(fields: list[str], renamed: dict[str, str] | None) -> dict[str, int] | str:
    """Column of every role that a header names, or why it is no header."""
    header = [f.casefold() for f in fields]
    roles: dict[str, int] = {}
    for role, synonyms in HEADERS.items():
        wanted = synonyms if renamed is None else (renamed[role].casefold(),) if role in renamed else ()
        at = [i for i, name in enumerate(header) if name in wanted]
        if len(at) > 1:
            return f"{len(at)} columns for {role}"
        if at:
            roles[role] = at[0]
        elif role in NEEDED or (renamed is not None and role in renamed):
            return f"no column called {' or '.join(wanted)}"
    return roles


def _number(text: str, comma: bool) -> float | None:
    """The number of a field; None if it is none."""
    plain = text.replace(",", ".") if comma and "." not in text else text
    if not _NUMBER.fullmatch(plain):
        return None
    value = float(plain.replace("d", "e").replace("D", "e"))
    return value if abs(value) < 1e300 else None


def _comma_hint(fields: list[str], comma: bool) -> str:
    if not comma and any(re.fullmatch(r"[-+]?\d+,\d+|\d+ [-+]?\d+", f) for f in fields):
        return "; if the file uses decimal commas, declare it (`decimal_comma`)"
    return ""


def parse_block(
    path: Path, layout: Layout, first: int, lines: list[str], class_of: Callable[[str, int], CodeClass]
) -> Block | None:
    """Columns of the lines of a block that hold data; None if there are none.

    Raises
    ------
    InputError
        Naming the line that cannot be read.
    """
    keep = [at for at, text in enumerate(lines) if text and not text.isspace() and text.lstrip()[0] != "#"]
    if keep and first + keep[0] == layout.header:
        keep = keep[1:]
    if not keep:
        return None
    if len(keep) < len(lines):
        lines = [lines[at] for at in keep]
    records = np.array(keep, np.int64) + first
    block = _fast(layout, lines, records)
    return block if block is not None else _slow(path, layout, lines, records, class_of)


def _fast(layout: Layout, lines: list[str], records: NDArray[np.int64]) -> Block | None:
    """Columns by NumPy's reader; None where anything is unusual."""
    texts = [r for r in layout.roles if r not in NUMBERS]
    if layout.decimal_comma:
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
        if max(map(len, values)) >= TEXT or (layout.decimal_comma and any("." in v for v in values)):
            return None  # the text may be cut off, or its point may have been a comma
        found[role] = [v.strip() for v in values]
    return Block(
        xyz,
        records,
        found["code"],
        found["line"],
        found["name"],
        None if sigma is None else np.array(sigma),
        None if right is None else np.array(right),
    )


def _slow(
    path: Path,
    layout: Layout,
    lines: list[str],
    records: NDArray[np.int64],
    class_of: Callable[[str, int], CodeClass],
) -> Block:
    """The same line by line: it names the line and the column that cannot be read."""
    rows: dict[str, list[Any]] = {role: [] for role in layout.roles}
    for record, text in zip(records.tolist(), lines):
        where = f"{path}:{record}"
        fields = _fields(path, (record, text), layout.delimiter)
        if len(fields) != layout.width:
            hint = "; is the decimal sign a comma? then declare it" if len(fields) > layout.width else ""
            raise InputError(f"{where}: {len(fields)} columns, the lines before have {layout.width}{hint}")
        code = fields[layout.roles["code"]] if "code" in layout.roles else ""
        for role, at in layout.roles.items():
            if role not in NUMBERS:
                rows[role].append(fields[at])
                continue
            value = _number(fields[at], layout.decimal_comma)
            if value is None:
                value = _missing(fields[at], role, partial(class_of, code, record), where, layout)
            if role == "sigma" and value < 0:
                raise InputError(f"{where}: sigma = {fields[at]!r}; a standard deviation is zero or more")
            rows[role].append(value)
    number = {r: np.array(rows[r], np.float64) for r in NUMBERS if r in rows}
    xyz = np.stack([number[r] for r in NEEDED], axis=1)
    return Block(
        xyz, records, rows.get("code"), rows.get("line"), rows.get("name"), number.get("sigma"), number.get("z_right")
    )


def _missing(text: str, role: str, cls: Callable[[], CodeClass], where: str, layout: Layout) -> float:
    """NaN where a number may be missing; else an error."""
    empty = text.casefold().lstrip("+-") in _NONE
    if empty and (role in ("sigma", "z_right") or (role == "z" and cls().kind in ("border", "hole", "ignore"))):
        return float("nan")
    hint = _comma_hint([text], layout.decimal_comma)
    if empty or text.casefold().lstrip("+-") in ("inf", "infinity"):
        hint = "; give the number or delete the line"
    raise InputError(f"{where}: {role} = {text!r} is not a number{hint}")

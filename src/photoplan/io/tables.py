"""Tables of text: dialects, columns, numbers, and lines of CSV."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.arrays import Floats
from photoplan.codec import storable
from photoplan.errors import InputError, UsageError
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.files import decoded_text, format_hint
from photoplan.io.store import write_atomically

#: In the order in which they are tried.
DELIMITERS = (";", "\t", ",", " ")
#: Texts that stand for "not known".
NOTHING = ("", "nan", "null", "none", "na", "n/a")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?", re.ASCII)
_FORMULA = re.compile(r"'*\s*[=+\-@\t\r\n]")
_INFINITE = ("inf", "infinity")
_BLOCK = 8 << 20
"""Bytes that are read at once."""
_MAX_LINE = 1 << 20

Line = tuple[int, str]
"""Number of a line, from 1, and its text."""


def decimal(text: str, decimal_comma: bool = False) -> float | None:
    """A number written with a decimal point (or comma, if `decimal_comma`); None for anything else and from 1e300."""
    plain = text.replace(",", ".") if decimal_comma and "." not in text else text
    if not NUMBER.fullmatch(plain):
        return None
    value = float(plain.replace("d", "e").replace("D", "e"))
    return value if abs(value) < 1e300 else None


def has_decimal_comma(text: str) -> bool:
    """Return whether a text is a number such as 1,5."""
    return re.fullmatch(r"[-+]?\d+,\d+", text) is not None


def number(text: str, where: str, decimal_comma: bool = False, empty: bool = False) -> float:
    """The number of a field."""
    value = decimal(text, decimal_comma)
    if value is not None:
        return value
    hint = ""
    if not decimal_comma and has_decimal_comma(text):
        hint = "; write decimals with a point (`decimal_comma` declares commas)"
    elif text.casefold().lstrip("+-") in (*NOTHING, *_INFINITE):
        hint = "; leave the field empty where it is not known" if empty else "; give it or delete the line"
    raise InputError(f"{where} = {text[:40]!r} is not a number{hint}")


def plain_field(text: str) -> str:
    """Return a field without the apostrophe by which `csv_line` keeps spreadsheets from computing it."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def csv_line(fields: Iterable[object], delimiter: str = ",") -> str:
    """Return one line of a table: numbers as they are, NaN and infinity empty, text quoted where it must be.

    Names come from files of others, and spreadsheets compute fields that begin with ``=``, ``+``, ``-`` or ``@``: text
    that is not a number gets an apostrophe before it, which our readers take off again.
    """
    return delimiter.join(_field(each, delimiter) for each in fields) + "\n"


def _field(value: object, delimiter: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    text = str(value)
    if _FORMULA.match(text) and decimal(text) is None and not has_decimal_comma(text):
        text = f"'{text}"
    elif text == text.strip() and not any(c in text for c in (delimiter, '"', "\n", "\r")):
        return text
    return '"' + text.replace('"', '""') + '"'


def split_line(path: Path, item: Line, delimiter: str) -> tuple[str, ...]:
    """Fields of a line, stripped; quotes hold a delimiter together."""
    line, text = item
    if '"' not in text and "'" not in text:
        fields = text.split() if delimiter == " " else text.split(delimiter)
        return tuple(plain_field(field.strip()) for field in fields)
    spaced = text.expandtabs(1).strip() if delimiter == " " else text
    for quote in ('"', "'"):
        if quote not in text:
            continue
        try:
            found = next(csv.reader([spaced], delimiter=delimiter, quotechar=quote, skipinitialspace=True, strict=True))
            return tuple(plain_field(field.strip()) for field in found)
        except (csv.Error, StopIteration) as error:
            if quote == '"':
                raise InputError(f"{path}:{line}: cannot be split into columns ({error})") from None
    return tuple(plain_field(f.strip()) for f in (text.split() if delimiter == " " else text.split(delimiter)))


def line_blocks(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number of the first line, and whole lines, of one part of a file after the other."""
    number, rest = 1, b""
    try:
        with path.open("rb") as file:
            while raw := file.read(_BLOCK):
                if number == 1 and not rest and raw.startswith((b"\xff\xfe", b"\xfe\xff")):
                    raise InputError(f"{path}: UTF-16 text; save the file as UTF-8")
                raw = rest + raw
                cut = max(raw.rfind(b"\n"), raw.rfind(b"\r", 0, -1)) + 1
                if not cut and len(raw) > _MAX_LINE:
                    raise InputError(f"{path}:{number}: a line of more than {_MAX_LINE} bytes; this is no table")
                rest = raw[cut:]
                if cut:
                    lines = _lines(path, number, raw[:cut])
                    yield number, lines
                    number += len(lines)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if rest:
        yield number, _lines(path, number, rest)


def _lines(path: Path, number: int, raw: bytes) -> list[str]:
    lines = decoded_text(path, raw, number).split("\n")
    if not lines[-1]:
        lines.pop()
    return lines


MAX_BYTES = 1_000_000_000
#: Lines that decide the delimiter.
_SNIFFED = 20


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns of a kind of table."""

    roles: Mapping[str, Sequence[str]]
    """Header names, in small letters, of every role."""
    needed: tuple[str, ...]
    """Roles without which the table is of no use."""
    orders: tuple[tuple[str, ...], ...] = ()
    """Roles in their order where a table has no header, one for each number of columns; empty: a header is needed."""
    numbers: frozenset[str] = frozenset({"x", "y", "z", "sigma"})
    """Roles whose fields are numbers."""
    every: bool = False
    """True if the first line is a header whatever it says, and each of its names, in small letters, a role."""
    untitled: bool = False
    """True if columns count in their order, the last of `orders`; a first line of words is passed over."""
    one_each: bool = False
    """True if a header with two names for one role is refused; else the first in the order of `roles` counts."""
    row: str = "line with data"
    """Name of a line in messages."""
    explain: Callable[[tuple[str, ...], str], str | None] = lambda first, why: None
    """Function that explains why a first line is no header; None if it adds nothing."""


@storable
@dataclass(frozen=True)
class Dialect:
    """Properties that a table does not state itself; checked at birth."""

    columns: str | None = None
    """None: the header names the columns. ``"name=Label,x=East,…"``: roles and header names. ``"name,x,y,z,…"``: roles
    of the columns in their order, ``-`` for one that is not used; the table then needs no header."""
    delimiter: str | None = None
    """None: the one that splits all lines equally."""
    decimal_comma: bool = False
    """True if numbers are written 1,5 instead of 1.5."""

    def __post_init__(self) -> None:
        if self.delimiter not in (None, *DELIMITERS):
            raise UsageError(f"delimiter {self.delimiter!r}; allowed are comma, semicolon, tab and space")
        if self.delimiter == "," and self.decimal_comma:
            raise UsageError("a comma cannot be both delimiter and decimal sign")


@dataclass(frozen=True, kw_only=True)
class TableLayout:
    """Roles of the columns of a file."""

    delimiter: str
    roles: Mapping[str, int]
    """Column of every role that the table has."""
    names: tuple[str, ...]
    """The first line, as the file has it: the header where there is one."""
    header: int
    """Line of the header; 0: there is none."""
    by_order: bool = False
    """True if the roles are those of the format's own order."""

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.names)


@dataclass(frozen=True, eq=False, kw_only=True)
class TextTable:
    """A table that was split into fields."""

    path: Path
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    """Line of each row in the file."""
    layout: TableLayout
    decimal_comma: bool = False

    @property
    def roles(self) -> Mapping[str, int]:
        """Column of every role that the table has."""
        return self.layout.roles

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
        """Fields of a role, none of them empty."""
        found = self.texts(role)
        for k, text in enumerate(found):
            if not text or any(ord(c) < 32 for c in text) or len(text) > 1000:
                raise InputError(f"{self.where(k)}: {role} is {text[:40]!r}; a name of at most 1000 characters needed")
        return found

    def labels(self, role: str, form: str) -> list[str]:
        """Fields of a role; where there is no such column, names after `form` with ``{row}``, from 1, or ``{line}``."""
        if role in self.roles:
            return self.texts(role)
        return [form.format(row=k + 1, line=line) for k, line in enumerate(self.lines)]

    def numbers(self, *roles: str, empty: bool = False) -> Floats:
        """Numbers of a role, shape (n,), or of several, (n, roles).

        NaN where the field is empty (if `empty`) or there is no such column.
        """
        found = [self._numbers(role, empty) for role in roles]
        return found[0] if len(found) == 1 else np.stack(found, axis=1)

    def first_known(self, *roles: str) -> Floats:
        """Numbers of the first of several roles that has one, shape (n,); NaN where none has; raises as `numbers`."""
        found = self.numbers(roles[0], empty=True)
        for role in roles[1:]:
            found = np.where(np.isnan(found), self.numbers(role, empty=True), found)
        return found

    def _numbers(self, role: str, empty: bool) -> Floats:
        if role not in self.roles:
            return np.full(len(self.rows), np.nan)
        at, comma = self.roles[role], self.decimal_comma
        values = [math.nan if empty and not row[at] else decimal(row[at], comma) for row in self.rows]
        if None in values:
            k = values.index(None)
            number(self.rows[k][at], f"{self.where(k)}: {role}", comma, empty)
        return np.array(values, float)


def read_table(path: Path, columns: Columns, dialect: Dialect = Dialect(), max_bytes: int = MAX_BYTES) -> TextTable:
    """The fields of a text table."""
    size = path.stat().st_size if path.exists() else 0
    if size > max_bytes:
        raise InputError(f"{path}: {size} bytes; at most {max_bytes} are read from a file of this kind")
    lines = [item for first, block in line_blocks(path) for item in enumerate(block, first) if item[1].strip()]
    data = [item for item in lines if not item[1].lstrip().startswith("#")]
    if not data:
        raise InputError(f"{path}: holds no line with data")
    layout = find_layout(path, lines, columns, dialect)
    body = data[1:] if layout.header == data[0][0] else data
    if not body:
        raise InputError(f"{path}: holds a header and no {columns.row}")
    rows = tuple(split_line(path, item, layout.delimiter) for item in body)
    for (line, _), row in zip(body, rows):
        if len(row) != layout.width:
            raise InputError(f"{path}:{line}: {wrong_width(len(row), layout)}")
    return TextTable(
        path=path, rows=rows, lines=tuple(line for line, _ in body), layout=layout, decimal_comma=dialect.decimal_comma
    )


def wrong_width(width: int, layout: TableLayout) -> str:
    """Return the message for a line with another number of fields."""
    hint = "; is the decimal sign a comma? decimal commas need another delimiter" if layout.delimiter == "," else ""
    return f"{width} columns, the first line has {layout.width}{hint}"


def find_layout(path: Path, lines: Sequence[Line], columns: Columns, dialect: Dialect = Dialect()) -> TableLayout:
    """Return the roles of the columns, from the first lines of a file; at least one of them holds data."""
    data = [item for item in lines if not item[1].lstrip().startswith("#")][:_SNIFFED]
    line, delimiter = data[0][0], _delimiter(path, data, columns, dialect)
    first = split_line(path, data[0], delimiter)
    where = f"{path}:{line}"
    if columns.untitled:
        words = not any(decimal(f, dialect.decimal_comma) is not None or f.casefold() in NOTHING for f in first)
        roles = {role: k for k, role in enumerate(columns.orders[-1][: len(first)])}
        return TableLayout(delimiter=delimiter, roles=roles, names=first, header=line * words)
    if dialect.columns is not None and "=" not in dialect.columns:
        roles = _declared_order(where, first, columns, dialect.columns)
        fields = [first[at] for role, at in roles.items() if role in columns.numbers]
        header = bool(fields) and not any(re.match(r"[-+]?\.?\d", text) for text in fields)
        return TableLayout(delimiter=delimiter, roles=roles, names=first, header=line * header)
    renamed = None if dialect.columns is None else _declared_names(dialect.columns, columns)
    found = _header(where, first, columns, renamed)
    if not isinstance(found, str):
        return TableLayout(delimiter=delimiter, roles=found, names=first, header=line)
    if renamed is None:
        for item in (i for i in lines if i[0] < line):
            head = (item[0], item[1].lstrip()[1:].strip())
            for names in (_try_split(path, head, d) for d in DELIMITERS):
                roles_of_comment = _header(where, names, columns, None) if len(names) == len(first) else ""
                if not isinstance(roles_of_comment, str):
                    return TableLayout(delimiter=delimiter, roles=roles_of_comment, names=names, header=item[0])
        numeric = sum(decimal(f, dialect.decimal_comma) is not None for f in first)
        order = next((o for o in columns.orders if len(o) == len(first)), None)
        least = sum(role in columns.numbers for role in columns.needed)
        if order is not None and numeric >= least:
            roles = {role: k for k, role in enumerate(order)}
            return TableLayout(delimiter=delimiter, roles=roles, names=first, header=0, by_order=True)
        own = columns.explain(first, found)
        if own is not None:
            raise InputError(f"{where}: {own}")
        if numeric >= 2:
            raise InputError(
                f"{where}: {' '.join(first)[:80]!r} is no header; what the {len(first)} columns mean is not guessed: "
                f"put a first line that names them ({', '.join(columns.needed)} …, `-` for one that is not used), or "
                "declare them"
            )
    raise InputError(f"{where}: header {', '.join(first)[:200]}: {found}; name the columns so, or declare them")


def _try_split(path: Path, item: Line, delimiter: str) -> tuple[str, ...]:
    try:
        return split_line(path, item, delimiter)
    except InputError:
        return ()


def _delimiter(path: Path, data: Sequence[Line], columns: Columns, dialect: Dialect) -> str:
    """The declared one, or the first that gives enough columns with numbers in them, the same number in every line."""
    if dialect.delimiter is not None:
        return dialect.delimiter
    least, numbers = len(columns.needed), sum(role in columns.numbers for role in columns.needed)
    best = (-1, " ") if least < 2 else None
    for delimiter in DELIMITERS:
        if delimiter == "," and dialect.decimal_comma:
            continue
        rows = [_try_split(path, item, delimiter) for item in data]
        wide = [row for row in rows if len(row) >= least]
        if not wide or len(rows[0]) < 2:
            continue
        count = sum(decimal(f, dialect.decimal_comma) is not None for f in wide[-1])
        rank = 2 * (count >= numbers) + (len({len(row) for row in rows}) == 1)
        if best is None or rank > best[0]:
            best = (rank, delimiter)
    if best is not None:
        return best[1]
    line, text = data[0]
    raise InputError(
        f"{path}:{line}: {text.strip()[:80]!r} has fewer than {least} columns by comma, semicolon, tab or space; "
        f"needed are {', '.join(columns.needed)}{format_hint(path)}"
    )


def _header(
    where: str, row: tuple[str, ...], columns: Columns, renamed: Mapping[str, str] | None
) -> dict[str, int] | str:
    """Column of every role that a header names, or why it is no header."""
    names = [field.casefold() for field in row]
    if columns.every:
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"{where}: column {twice[0]!r} stands twice")
        return {name: k for k, name in enumerate(names)}
    found: dict[str, int] = {}
    wrong = []
    for role, synonyms in columns.roles.items():
        wanted = synonyms if renamed is None else (renamed[role].casefold(),) if role in renamed else ()
        at = [k for k, name in enumerate(names) if name in wanted]
        own = [k for name in wanted for k in at if names[k] == name]
        if len(at) > 1 and (columns.one_each or names[own[0]] == names[own[1]]):
            wrong.append(f"{role} ({len(at)} columns called {' or '.join(wanted)})")
        elif own:
            found[role] = own[0]
        elif role in columns.needed or (renamed is not None and role in renamed):
            wrong.append(f"{role} (no column called {' or '.join(wanted)})")
    return "; ".join(wrong) or found


def _declared_order(where: str, first: tuple[str, ...], columns: Columns, text: str) -> dict[str, int]:
    given = [c for c in re.split(r"[,\s]+", text.strip()) if c]
    roles = {role: k for k, role in enumerate(given) if role != "-"}
    _check_roles(list(roles), sum(role != "-" for role in given), columns, text)
    if len(given) != len(first):
        raise InputError(
            f"{where}: {len(first)} columns, {len(given)} are declared ({', '.join(given)}); write `-` for columns "
            "that are not used"
        )
    return roles


def _declared_names(text: str, columns: Columns) -> dict[str, str]:
    pairs = [item.partition("=") for item in text.split(",")]
    names = {role.strip(): name.strip() for role, _, name in pairs}
    _check_roles(list(names), len(pairs), columns, text)
    return names


def _check_roles(roles: Sequence[str], given: int, columns: Columns, text: str) -> None:
    unknown = [r for r in roles if r not in columns.roles]
    missing = [r for r in columns.needed if r not in roles]
    if unknown or missing or len(roles) != given:
        reason = (
            f"unknown {', '.join(unknown)}" if unknown else f"missing {', '.join(missing)}" if missing else "repeated"
        )
        raise UsageError(
            f"declared columns {text!r}: {reason}; allowed are {', '.join(columns.roles)} and -, needed "
            f"{', '.join(columns.needed)}"
        )


def write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a comma-separated table with a header; it appears complete or not at all, in a folder that is made.

    Fields are written as `photoplan.io.tables.csv_line` does.
    """
    try:
        make_parents(path.parent)
    except OSError as error:
        raise disk_error(path, error) from error
    write_atomically(path, "".join(map(csv_line, [header, *rows])).encode())

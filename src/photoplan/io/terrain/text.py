"""Terrain measurements in text files: columns and tables of points."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.arrays import Floats, Ints, Mask
from photoplan.errors import InputError
from photoplan.io.files import crs_beside, whole_number
from photoplan.io.tables import (
    DELIMITERS,
    NOTHING,
    Columns,
    Dialect,
    Line,
    TableLayout,
    decimal,
    find_layout,
    has_decimal_comma,
    line_blocks,
    number,
    split_line,
    wrong_width,
)
from photoplan.io.terrain.options import OTHER, CodeClass, ReadOptions
from photoplan.io.terrain.vector import CodeIndex, PointColumns, class_of, is_line, make_groups
from photoplan.surfaces.units import LineKind, MeasuredLine, MeasuredTerrain

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
    """Return the message for a first line that is neither record nor header."""
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


_Block = dict[str, Any]
"""Columns of a block of lines: ``records`` (numbers), ``xyz``, and by role arrays of numbers or lists of texts."""


def points_layout(path: Path, lines: Sequence[str], dialect: Dialect) -> TableLayout | None:
    """Return the roles of the columns, from the first lines of a file; None if they hold no data."""
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
) -> _Block | None:
    """Return the columns of the lines of a block that hold data; None if there are none."""
    keep = [at for at, text in enumerate(lines) if text and not text.isspace() and text.lstrip()[0] != "#"]
    if keep and first + keep[0] == layout.header:
        keep = keep[1:]
    if not keep:
        return None
    if len(keep) < len(lines):
        lines = [lines[at] for at in keep]
    records = np.array(keep, np.int64) + first
    found = _fast(layout, lines, decimal_comma) or _slow(path, layout, lines, records, look_up, decimal_comma)
    return {"records": records, **found}


def _fast(layout: TableLayout, lines: list[str], decimal_comma: bool) -> _Block | None:
    """Read columns by NumPy's reader; None if anything is unusual."""
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

    columns = {role: table[:, at] if plain else table[f"c{at}"] for role, at in layout.roles.items()}
    found: _Block = {"xyz": np.stack([columns[role] for role in NEEDED], axis=1)}
    found |= {role: np.array(columns[role]) for role in ("sigma", "z_right") if role in columns}
    if not all(np.isfinite(found[role]).all() for role in ("xyz", "z_right") if role in found):
        return None
    if "sigma" in found and not (found["sigma"] >= 0).all():
        return None
    for role in texts:
        values = columns[role].tolist()
        if max(map(len, values)) >= TEXT or any("'" in v or (decimal_comma and "." in v) for v in values):
            return None  # the text may be cut off or in quotes, or its point may have been a comma
        found[role] = [v.strip() for v in values]
    return found


def _slow(
    path: Path, layout: TableLayout, lines: list[str], records: Ints, look_up: LookUp, decimal_comma: bool
) -> _Block:
    """Read columns line by line, and name the line and the column that cannot be read."""
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
                flat = role == "z" and look_up(code, record).kind in ("border", "hole", "ignore")
                may_miss = flat or role in ("sigma", "z_right")
                if not (may_miss and fields[at].casefold().lstrip("+-") in _NONE):
                    number(fields[at], f"{where}: {role}", decimal_comma)
                value = math.nan
            if role == "sigma" and value < 0:
                raise InputError(f"{where}: sigma = {fields[at]!r}; a standard deviation is zero or more")
            rows[role].append(value)
    found: _Block = {"xyz": np.stack([np.array(rows.pop(role), np.float64) for role in NEEDED], axis=1)}
    return found | {role: np.array(column) if role in NUMBERS else column for role, column in rows.items()}


def read(path: Path, options: ReadOptions) -> MeasuredTerrain:
    """Points and lines of a text file."""
    layout: TableLayout | None = None
    index, out = {"code": CodeIndex(), "line": CodeIndex()}, defaultdict[str, list[Any]](list)
    notes: list[str] = []
    classes: list[CodeClass] = []

    def look_up(code: str, line: int) -> CodeClass:
        return class_of(code, options, "mass", f"{path}:{line}")

    for first, lines in line_blocks(path):
        if layout is None:
            layout = points_layout(path, lines, options.dialect)
            notes = [] if layout is None else _unused(path, layout, lines, options)
        comma = options.dialect.decimal_comma
        block = None if layout is None else parse_block(path, layout, first, lines, look_up, comma)
        if block is None:
            continue
        for role, values in block.items():
            known = index[role].numbers(values, len(values)) if role in index else np.asarray(values)
            out[role].append(known)
        # Classes of the codes that this block brought; unknown ones are named with their line.
        for code in index["code"].texts[len(classes) :]:
            own = block.get("code", ())
            classes.append(look_up(code, int(block["records"][own.index(code)]) if code in own else 0))
    if layout is None or not out:
        raise InputError(f"{path}: holds no line with data" + ("" if layout is None else ", only a header"))
    # The parts are not needed beside the whole.
    whole = {role: np.concatenate(out.pop(role)) for role in list(out)}
    return _terrain(path, layout, whole, (index["code"].texts, index["line"].texts), classes, notes)


def _unused(path: Path, layout: TableLayout, lines: list[str], options: ReadOptions) -> list[str]:
    """Return notes on columns that are not used. They are refused if they hold codes of the table and no column has
    codes."""
    if not layout.header:
        return []
    unused = {at: name for at, name in enumerate(layout.names) if at not in layout.roles.values()}
    head = [item for item in enumerate(lines[:1000], 1) if item[1].strip() and not item[1].lstrip().startswith("#")]
    rows = [split_line(path, item, layout.delimiter) for item in head if item[0] > layout.header]
    for at, name in unused.items() if "code" not in layout.roles else ():
        found = sorted({row[at] for row in rows if len(row) > at} & (options.codes.classes.keys() - {OTHER}))
        if found:
            raise InputError(
                f"{path}: column {name!r} holds codes of the table ({', '.join(found[:5])}), but is not read as codes; "
                f"the columns are {', '.join(layout.names)}: declare `columns` x=…,y=…,z=…,code={name}, or call it code"
            )
    return [f"{path.name}: columns not used: {', '.join(unused.values())}"] if unused else []


def _terrain(
    path: Path,
    layout: TableLayout,
    whole: _Block,
    names: tuple[list[str], list[str]],
    classes: list[CodeClass],
    notes: list[str],
) -> MeasuredTerrain:
    xyz, records = whole["xyz"], whole["records"]
    number: Any = whole.get("code")
    line: Any = whole.get("line")
    sigma, right, named = whole.get("sigma"), whole.get("z_right"), whole.get("name")
    columns = PointColumns(xyz=xyz, records=records, codes=number, sigma=sigma, names=named)
    if number is None and line is None:
        on_line: Any = np.zeros(len(xyz), bool)
    else:
        by_class = np.array([is_line(c) for c in classes] or [False])
        on_line = by_class[number] if number is not None else line > 0
        if number is not None and line is not None:
            on_line |= (line > 0) & (number == 0)
    if layout.by_order and layout.width > 3:
        notes.append(f"{path.name}: no header; columns taken as {', '.join(layout.roles)}")
    lines: list[MeasuredLine] = []
    alone = np.empty(0, np.int64)
    if on_line.any():
        lines, alone = _make_lines(path, columns, on_line, line, right, names, classes)
        if len(alone):
            some = ", ".join(str(r) for r in records[alone[:5]])
            notes.append(
                f"{path.name}: {len(alone)} lines have one record (line {some} of the file); read as mass points"
            )
    texts, kinds = names[0], list(classes)
    if len(alone):
        texts, kinds = [*texts, ""], [*kinds, CodeClass("mass")]
        number = np.zeros(len(xyz), np.int32) if number is None else number
        number[alone] = len(texts) - 1
        on_line[alone] = False
    columns = PointColumns(xyz=xyz, records=records, codes=number, sigma=sigma, names=named)
    if on_line.any():
        columns = columns.take(~on_line)
    groups = make_groups(path, columns, texts, kinds) if len(columns.xyz) else []
    left_out = len(columns.xyz) - sum(len(g.xyz) for g in groups)
    if left_out:
        notes.append(f"{path.name}: {left_out} points left out, their codes say `ignore`")
    stated = crs_beside(path)
    crs, heights = (None, None) if stated is None else (stated.crs, stated.height_system)
    return MeasuredTerrain(
        tuple(groups),
        tuple(lines),
        crs,
        heights,
        files=(path,),
        notes=tuple(notes),
        codes=frozenset(names[0]),
        fields=(f"{path.name}: {', '.join(layout.names if layout.header else layout.roles)}",),
    )


def _make_lines(
    path: Path,
    columns: PointColumns,
    on_line: Mask,
    ids: NDArray[np.int32] | None,
    right: Floats | None,
    texts: tuple[list[str], list[str]],
    classes: list[CodeClass],
) -> tuple[list[MeasuredLine], Ints]:
    """Lines, and the rows of those that would have one vertex; `texts` are codes and line ids by their numbers."""
    codes, id_texts = texts
    rows = np.flatnonzero(on_line)
    code = np.zeros(len(columns.xyz), np.int32) if columns.codes is None else columns.codes
    step = np.diff(rows) > 1
    step |= np.diff(code[rows]) != 0
    step |= (np.diff(ids[rows]) != 0) if ids is not None else (np.diff(columns.records[rows]) > 1)
    starts = np.concatenate([[0], np.flatnonzero(step) + 1, [len(rows)]])
    lines, alone = [], []
    for a, b in zip(starts[:-1].tolist(), starts[1:].tolist()):
        part = rows[a:b]
        if b - a == 1:
            alone.append(part[0])
            continue
        text = codes[code[part[0]]] if columns.codes is not None else ""
        cls = classes[code[part[0]]] if columns.codes is not None else CodeClass("breakline")
        own = id_texts[ids[part[0]]] if ids is not None else ""
        kind: LineKind = cls.kind if is_line(cls) else "breakline"  # type: ignore[assignment]
        name = f"{path.name}:{columns.records[part[0]]}" + "".join(f" {t}" for t in (text, own) if t)
        lines.append(
            MeasuredLine(
                name=name,
                kind=kind,
                xyz=columns.xyz[part],
                right=_right_heights(right, columns.xyz, part, kind),
                sigma=_line_sigma(columns.sigma, part, cls.sigma),
                code=text,
            )
        )
    return lines, np.array(alone, np.int64)


def _right_heights(right: Floats | None, xyz: Floats, part: Ints, kind: str) -> Floats | None:
    """Heights right of a line; records without one have one height. None: no record has one."""
    if right is None or kind != "breakline" or np.isnan(right[part]).all():
        return None
    return np.where(np.isnan(right[part]), xyz[part, 2], right[part])


def _line_sigma(sigma: Floats | None, part: Ints, default: float | None) -> float | None:
    """One standard deviation for a line: the root mean square of its records'."""
    if sigma is None or np.isnan(sigma[part]).all():
        return default
    return float(np.sqrt(np.nanmean(sigma[part] ** 2)))


_NAMES = {
    "x": ("x", "east", "easting", "e", "x_m", "rechtswert", "point_x", "longitude", "lon"),
    "y": ("y", "north", "northing", "n", "y_m", "hochwert", "point_y", "latitude", "lat"),
}


@dataclass(frozen=True)
class PointTableFormat:
    """Properties that a table does not state itself."""

    x: str | None = None
    """Name of the column of X, or its number from 1; None: `x`, `east`, `easting` …"""
    y: str | None = None
    dialect: Dialect = field(default_factory=Dialect)
    """Delimiter and decimal sign."""
    header: bool = True
    """True if the first line names the columns."""


@dataclass(frozen=True, eq=False)
class PointPart:
    """Some lines of the table."""

    rows: list[tuple[str, ...]]
    """Their fields, as the file has them."""
    xy: Floats
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
        """Return the index of the column of an axis."""
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

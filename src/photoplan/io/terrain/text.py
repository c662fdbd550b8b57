"""Measured terrain from text files: points, and lines as consecutive records.

Columns are separated by spaces, commas, semicolons or tabs; see `ReadOptions.columns` for what they hold. Lines that
are empty or begin with ``#`` are passed over. Records whose code is one of a line class make up lines: consecutive
records of one line id (and code), or, where there is no column of line ids, of one code without an empty line between
them. A breakline whose records have a second height (column ``z_right``) is two-sided: ``z`` is the height left of the
line in its direction, ``z_right`` the height to its right; records without it have one height. Heights may be empty
for border lines and holes. A file of the same name with the suffix ``.prj`` states the CRS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.plain_files import crs_beside
from photoplan.io.table_lines import line_blocks, split_line
from photoplan.io.tables import TableLayout
from photoplan.io.terrain.columns import PointBlock, parse_block, points_layout
from photoplan.io.terrain.groups import CodeIndex, PointColumns, class_of, is_line, make_groups
from photoplan.io.terrain.options import OTHER, CodeClass, ReadOptions
from photoplan.surfaces.measured import LineKind, MeasuredLine, MeasuredTerrain


@dataclass
class _Columns:
    """Columns of the file as they grow, block by block."""

    xyz: list[NDArray[np.float64]] = field(default_factory=list)
    records: list[NDArray[np.int64]] = field(default_factory=list)
    codes: list[NDArray[np.int32]] = field(default_factory=list)
    lines: list[NDArray[np.int32]] = field(default_factory=list)
    sigma: list[NDArray[np.float64]] = field(default_factory=list)
    right: list[NDArray[np.float64]] = field(default_factory=list)
    names: list[NDArray[Any]] = field(default_factory=list)


def read(path: Path, options: ReadOptions) -> MeasuredTerrain:
    """Points and lines of a text file."""
    layout: TableLayout | None = None
    codes, ids, out = CodeIndex(), CodeIndex(), _Columns()
    notes: list[str] = []
    classes: list[CodeClass] = []

    def look_up(code: str, line: int) -> CodeClass:
        return class_of(code, options, "mass", f"{path}:{line}")

    for first, lines in line_blocks(path):
        if layout is None:
            layout = points_layout(path, lines, options.dialect)
            notes = [] if layout is None else _unused(path, layout, lines, options)
        block = None
        if layout is not None:
            block = parse_block(path, layout, first, lines, look_up, options.dialect.decimal_comma)
        if block is not None:
            _append(out, block, codes, ids)
            _learn(classes, codes, block, look_up)
    if layout is None or not out.xyz:
        raise InputError(f"{path}: holds no line with data" + ("" if layout is None else ", only a header"))
    return _terrain(path, layout, out, codes, ids, classes, notes)


def _unused(path: Path, layout: TableLayout, lines: list[str], options: ReadOptions) -> list[str]:
    """What to note of columns that are not used; refused where they hold codes of the table and no column has codes."""
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


def _append(out: _Columns, block: PointBlock, codes: CodeIndex, ids: CodeIndex) -> None:
    out.xyz.append(block.xyz)
    out.records.append(block.records)
    count = len(block.xyz)
    if block.code is not None:
        out.codes.append(codes.numbers(block.code, count))
    if block.line is not None:
        out.lines.append(ids.numbers(block.line, count))
    if block.sigma is not None:
        out.sigma.append(block.sigma)
    if block.right is not None:
        out.right.append(block.right)
    if block.name is not None:
        out.names.append(np.array(block.name))


def _learn(
    classes: list[CodeClass], codes: CodeIndex, block: PointBlock, look_up: Callable[[str, int], CodeClass]
) -> None:
    """Classes of the codes that this block brought; unknown ones are named with their line."""
    for code in codes.texts[len(classes) :]:
        at = int(block.records[block.code.index(code)]) if block.code is not None and code in block.code else 0
        classes.append(look_up(code, at))


def _terrain(
    path: Path,
    layout: TableLayout,
    out: _Columns,
    codes: CodeIndex,
    ids: CodeIndex,
    classes: list[CodeClass],
    notes: list[str],
) -> MeasuredTerrain:
    def whole(parts: list[Any]) -> Any:
        joined = np.concatenate(parts) if parts else None
        parts.clear()  # the parts are not needed beside the whole
        return joined

    xyz, records, names = whole(out.xyz), whole(out.records), whole(out.names)
    sigma, right = whole(out.sigma), whole(out.right)
    number, line = whole(out.codes), whole(out.lines)
    columns = PointColumns(xyz=xyz, records=records, codes=number, sigma=sigma, names=names)
    if number is None and line is None:
        on_line = np.zeros(len(xyz), bool)
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
        lines, alone = _make_lines(path, columns, on_line, line, right, (codes.texts, ids.texts), classes)
        if len(alone):
            some = ", ".join(str(r) for r in records[alone[:5]])
            notes.append(
                f"{path.name}: {len(alone)} lines have one record (line {some} of the file); read as mass points"
            )
    texts, kinds = codes.texts, list(classes)
    if len(alone):
        texts, kinds = [*texts, ""], [*kinds, CodeClass("mass")]
        number = np.zeros(len(xyz), np.int32) if number is None else number
        number[alone] = len(texts) - 1
        on_line[alone] = False
    columns = PointColumns(xyz=xyz, records=records, codes=number, sigma=sigma, names=names)
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
        codes=frozenset(codes.texts),
        fields=(f"{path.name}: {', '.join(layout.names if layout.header else layout.roles)}",),
    )


def _make_lines(
    path: Path,
    columns: PointColumns,
    on_line: NDArray[np.bool_],
    ids: NDArray[np.int32] | None,
    right: NDArray[np.float64] | None,
    texts: tuple[list[str], list[str]],
    classes: list[CodeClass],
) -> tuple[list[MeasuredLine], NDArray[np.int64]]:
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


def _right_heights(
    right: NDArray[np.float64] | None, xyz: NDArray[np.float64], part: NDArray[np.int64], kind: str
) -> NDArray[np.float64] | None:
    """Heights right of a line; records without one have one height. None: no record has one."""
    if right is None or kind != "breakline" or np.isnan(right[part]).all():
        return None
    return np.where(np.isnan(right[part]), xyz[part, 2], right[part])


def _line_sigma(sigma: NDArray[np.float64] | None, part: NDArray[np.int64], default: float | None) -> float | None:
    """One standard deviation for a line: the root mean square of its records'."""
    if sigma is None or np.isnan(sigma[part]).all():
        return default
    return float(np.sqrt(np.nanmean(sigma[part] ** 2)))

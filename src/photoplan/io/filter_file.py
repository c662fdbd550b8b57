"""Restoration filters as files: TOML that can be read and edited, or one kernel as rows of plain numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.plain_files import finite, read_text, read_toml
from photoplan.io.project.write import toml_key, toml_value

#: Entry `kind` of a filter file, by which it is told from a project.
FILTER_KIND = "restoration filter"
#: A hundred kernels of 101 × 101 values stay below.
MOST_BYTES = 64_000_000
MOST_KERNELS = 1024
#: Kernels have at most this many rows and columns, see `FilterKernel`.
MOST_ROWS = 101
#: Weights beyond it would overflow in single precision, times grey values and summed.
MOST_WEIGHT = 1e12

_ENTRIES = {"kind", "format", "description", "image_size", "facts", "kernels"}
_KERNEL_ENTRIES = {"band", "at", "values"}
_HEADER = """\
# Restoration filter of photoplan: the restored image is the image convolved with it.
# values[m + i][n + k] is the weight of the pixel i rows above and k columns left of the restored one; m and n are the
# middle row and column. Values may be edited; a sum of 1 keeps the brightness. photoplan info plots it
"""


@dataclass(frozen=True, eq=False)
class KernelEntry:
    """One kernel of a file; see `photoplan.quality.restoration.filters.FilterKernel`."""

    values: NDArray[np.float64]
    """Rows and columns of finite numbers."""
    at: tuple[float, float] | None = None
    """Column and row."""
    band: int | None = None


@dataclass(frozen=True, eq=False)
class FilterEntries:
    """What a filter file says; see `photoplan.quality.restoration.filters.RestorationFilter`."""

    kernels: tuple[KernelEntry, ...]
    image_size: tuple[int, int] | None = None
    description: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)


def read_filter_file(path: Path) -> FilterEntries:
    """Read a filter: TOML by its ending `.toml`, rows of numbers otherwise."""
    path = Path(path)
    if path.suffix.lower() != ".toml":
        return FilterEntries((KernelEntry(_matrix(path)),), description=f"matrix of {path.name}")
    contents, _ = read_toml(path, MOST_BYTES)
    if contents.get("kind") != FILTER_KIND:
        raise InputError(f'{path}: no filter; a filter file states kind = "{FILTER_KIND}" and has [[kernels]]')
    _known(contents, _ENTRIES, str(path))
    if contents.get("format", 1) != 1:
        raise InputError(f"{path}: format = {contents['format']!r}; this version reads format 1")
    entries = contents.get("kernels")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_KERNELS:
        raise InputError(f"{path}: [[kernels]]: 1 to {MOST_KERNELS} kernels are needed")
    description, facts = contents.get("description", ""), contents.get("facts", {})
    if not isinstance(description, str) or not isinstance(facts, dict):
        raise InputError(f"{path}: description is a text and [facts] a table")
    size = contents.get("image_size")
    kernels = tuple(_kernel(entry, f"{path}: [[kernels]] {i}") for i, entry in enumerate(entries, 1))
    return FilterEntries(kernels, None if size is None else _size(size, path), description, facts)


def is_filter(path: Path) -> bool:
    """Whether a TOML file says that it is a filter."""
    return read_toml(path)[0].get("kind") == FILTER_KIND


def filter_text(filter_: FilterEntries) -> str:
    """The whole file as text."""
    lines = [_HEADER + f"kind = {toml_value(FILTER_KIND)}", "format = 1"]
    if filter_.description:
        lines.append(f"description = {toml_value(filter_.description)}")
    if filter_.image_size is not None:
        lines += ["# Width and height of the images that the places `at` refer to, pixels."]
        lines.append(f"image_size = {toml_value([int(side) for side in filter_.image_size])}")
    facts = {key: plain_fact(value) for key, value in filter_.facts.items() if value is not None}
    if facts:
        lines += ["", "# How it was made; no entry here changes the result.", "[facts]"]
        lines += [f"{toml_key(str(key))} = {toml_value(value)}" for key, value in facts.items()]
    for kernel in filter_.kernels:
        gain = float(np.sqrt((kernel.values**2).sum()))
        lines += ["", f"# Sum {kernel.values.sum():.6g}; noise grows {gain:.4g} times.", "[[kernels]]"]
        if kernel.band is not None:
            lines.append(f"band = {kernel.band}")
        if kernel.at is not None:
            lines.append(f"at = [{float(kernel.at[0])!r}, {float(kernel.at[1])!r}]")
        lines += ["values = [", *(f"  [{', '.join(map(repr, row))}]," for row in kernel.values.tolist()), "]"]
    return "\n".join(lines) + "\n"


def plain_fact(value: object) -> Any:
    """A fact as TOML can say it."""
    if isinstance(value, np.ndarray | np.generic):
        return plain_fact(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain_fact(item) for key, item in value.items() if item is not None}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain_fact(item) for item in value]
    return value if isinstance(value, str | bool | int | float) else str(value)


def _known(table: Mapping[str, Any], allowed: set[str], where: str) -> None:
    unknown = sorted(set(table) - allowed)
    if unknown:
        raise InputError(f"{where}: unknown entry {unknown[0]!r}; allowed are {', '.join(sorted(allowed))}")


def _size(value: Any, path: Path) -> tuple[int, int]:
    sides = isinstance(value, list) and len(value) == 2 and all(type(side) is int and side > 0 for side in value)
    if not sides:
        raise InputError(f"{path}: image_size = {value!r}; needed are two whole numbers, [width, height]")
    return value[0], value[1]


def _kernel(entry: Any, where: str) -> KernelEntry:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: is no table")
    _known(entry, _KERNEL_ENTRIES, where)
    band, at = entry.get("band"), entry.get("at")
    if band is not None and (type(band) is not int or band < 1):
        raise InputError(f"{where}: band = {band!r}; bands are counted from 1")
    if at is not None:
        at = finite(at, f"{where}: at", 2)
    rows = entry.get("values")
    if not isinstance(rows, list) or not rows or len(rows) > MOST_ROWS:
        raise InputError(f"{where}: values are 1 to {MOST_ROWS} rows of numbers")
    numbers = []
    for i, row in enumerate(rows, 1):
        if not isinstance(row, list) or len(row) != len(rows[0]) or len(row) > MOST_ROWS:
            count = len(row) if isinstance(row, list) else "no"
            first = len(rows[0]) if isinstance(rows[0], list) else "no"
            raise InputError(
                f"{where}: row {i} of values has {count} numbers, row 1 {first}; all need equally many, at most "
                f"{MOST_ROWS}"
            )
        numbers.append([finite(value, f"{where}: row {i} of values") for value in row])
    return KernelEntry(_odd(numbers, where), at, band)


def _odd(rows: list[list[float]], where: str) -> NDArray[np.float64]:
    """Rows as an array, whose sides must have a middle."""
    values = np.array(rows, np.float64)
    if values.ndim != 2 or values.shape[0] % 2 == 0 or values.shape[1] % 2 == 0:
        raise InputError(f"{where}: values of {len(rows)} rows and {len(rows[0])} columns; both must be odd")
    if np.abs(values).max() > MOST_WEIGHT:
        raise InputError(f"{where}: a weight of {np.abs(values).max():.3g}; at most {MOST_WEIGHT:g} are allowed")
    return values


def _matrix(path: Path) -> NDArray[np.float64]:
    """One kernel of rows of numbers, separated by blanks, tabs, commas or semicolons; `#` begins a comment."""
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path, MOST_BYTES).split("\n"), 1):
        text = line.split("#", 1)[0].strip()
        if not text:
            continue
        where = f"{path}:{number}"
        try:
            row = [finite(float(word), where) for word in re.split(r"\s*[,;]\s*|\s+", text)]
        except ValueError:
            raise InputError(f"{where}: {text[:60]!r} is no row of numbers; write decimals with a point") from None
        if rows and len(row) != len(rows[0]):
            raise InputError(f"{where}: {len(row)} numbers; the rows before have {len(rows[0])}")
        rows.append(row)
        if len(rows) > MOST_ROWS or len(row) > MOST_ROWS:
            raise InputError(f"{where}: a filter has at most {MOST_ROWS} rows and columns")
    if not rows:
        raise InputError(f"{path}: holds no numbers; a filter is a .toml file or rows of numbers")
    return _odd(rows, str(path))

"""Conditions of frames: in names of files with named fields, such as ``dark_{exposure_ms}ms_*.tif``, or in tables."""

from __future__ import annotations

import datetime
import math
import os
import re
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.names import check_input_name, resolve_input
from photoplan.io.table_lines import NUMBER, decimal
from photoplan.io.tables import Columns, read_table

Values = dict[str, float | str]

#: Names of fields and columns that stand for a condition, with the factor to its unit.
FIELDS: dict[str, tuple[str, float]] = {
    "exposure": ("exposure_ms", 1.0),
    "exposure_ms": ("exposure_ms", 1.0),
    "exposure_us": ("exposure_ms", 1e-3),
    "exposure_s": ("exposure_ms", 1e3),
    "temperature": ("temperature_c", 1.0),
    "temperature_c": ("temperature_c", 1.0),
    "wavelength": ("wavelength_nm", 1.0),
    "wavelength_nm": ("wavelength_nm", 1.0),
    "photons": ("photons_per_pixel", 1.0),
    "photons_per_pixel": ("photons_per_pixel", 1.0),
    "irradiance_uw_cm2": ("irradiance_uw_cm2", 1.0),
    "illumination": ("illumination", 1.0),
    "density": ("density", 1.0),
    "time_s": ("time_s", 1.0),
}
_TIMES = ("time", "time_s")
_MAX_ENTRIES = 1_000_000
_MAX_BYTES = 100_000_000
_NUMBER = "[-+]?[0-9]*[.]?[0-9]+"
#: Parts of a time of fixed length, as ``strptime`` knows them.
_DIGITS = {"%Y": "[0-9]{4}", "%j": "[0-9]{3}"} | {f"%{c}": "[0-9]{2}" for c in "mdHMSyI"} | {"%%": "%"}


def condition(name: str, text: str, where: str) -> tuple[str, float | str]:
    """A named text as a condition in its unit, or as itself where the name is no condition."""
    if name in _TIMES:
        return "time_s", number_of_time(float(text) if NUMBER.fullmatch(text) else text, where)
    if name not in FIELDS:
        return name, float(text) if NUMBER.fullmatch(text) else text
    key, factor = FIELDS[name]
    if not NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        hint = "; write decimals with a point" if "," in text else ""
        raise InputError(f"{where}: {name} is {text[:40]!r}; a number is needed{hint}")
    return key, float(text) * factor


def read_records(path: Path) -> tuple[tuple[str, ...], list[tuple[str, dict[str, str]]]]:
    """Header (small letters) of a table, and place and fields by it of each line.

    Where the delimiter is no comma, decimal commas are read.
    """
    table = read_table(path, Columns(roles={}, needed=(), every=True), max_bytes=_MAX_BYTES)
    commas = table.layout.delimiter != ","

    def pointed(field: str) -> str:
        value = decimal(field, True) if commas and field.count(",") == 1 else None
        return field if value is None else repr(value)

    header = tuple(table.roles)
    return header, [(table.where(k), dict(zip(header, map(pointed, row)))) for k, row in enumerate(table.rows)]


def read_conditions(path: Path) -> dict[str, Values]:
    """Conditions of each file by its name, from a table; empty fields state nothing."""
    header, records = read_records(path)
    if "file" not in header:
        raise InputError(f"{path}: columns {', '.join(header)} given; one must be called file")
    found: dict[str, Values] = {}
    for where, values in records:
        name = values.pop("file")
        if not name or name in found:
            raise InputError(f"{where}: file {name!r} {'stands twice' if name else 'is empty'}")
        found[name] = dict(condition(key, text, where) for key, text in values.items() if text)
    return found


def number_of_time(value: float | str, where: str) -> float:
    """Seconds as they are, or since 1970 of an ISO date (UTC where it names no zone)."""
    if not isinstance(value, str):
        return float(value)
    try:
        when = datetime.datetime.fromisoformat(value)
    except ValueError:
        raise InputError(
            f"{where}: time {value[:60]!r}; allowed are seconds or a date such as 2019-02-08T17:11:46"
        ) from None
    return (when if when.tzinfo else when.replace(tzinfo=datetime.UTC)).timestamp()


def find_files(folder: Path, pattern: str, where: str) -> dict[Path, Values]:
    """Files that fit a pattern, sorted by name, with the values of its fields."""
    check_input_name(re.sub(r"\{[^}]*\}", "0", pattern))
    head, name = os.path.split(pattern.replace("\\", "/"))
    if re.search(r"[*?{}]", head):
        raise InputError(f"{where}: files {pattern!r}: stars and fields may stand in the last part of the path only")
    place = resolve_input(folder, head) if head else folder
    if not re.search(r"[*?{}]", name):
        file = place / name
        return {file: {}} if file.is_file() else {}
    expression, fields = _expression(name, where)
    if not place.is_dir():
        raise InputError(f"{where}: files {pattern!r}: there is no folder {place}")
    names = []
    with os.scandir(place) as entries:
        for count, entry in enumerate(entries):
            if count >= _MAX_ENTRIES:
                raise InputError(f"{where}: {place} holds more than {_MAX_ENTRIES} files; move the frames elsewhere")
            if expression.fullmatch(entry.name) and entry.is_file():
                names.append(entry.name)
    found: dict[Path, Values] = {}
    for name in sorted(names):
        match = expression.fullmatch(name)
        assert match is not None
        found[place / name] = dict(
            _field(field, form, match[f"f{k}"], f"{where}: {name}") for k, (field, form) in enumerate(fields)
        )
    return found


def _field(name: str, form: str, text: str, where: str) -> tuple[str, float | str]:
    if not form:
        return condition(name, text, where)
    try:
        when = datetime.datetime.strptime(text, form).replace(tzinfo=datetime.UTC)
    except ValueError:
        raise InputError(f"{where}: {text[:60]!r} is no time of the form {form!r}") from None
    return "time_s", when.timestamp()


def _time_expression(form: str) -> str:
    """A regular expression for a time; digits are counted, so that what follows in the name is not taken for a year."""
    return "".join(
        _DIGITS.get(part, ".+?" if part[0] == "%" else re.escape(part)) for part in re.findall("%.|[^%]+|%$", form)
    )


def _expression(name: str, where: str) -> tuple[re.Pattern[str], list[tuple[str, str]]]:
    """A regular expression for the last part of a pattern, and its fields with their forms."""
    fields: list[tuple[str, str]] = []
    parts = []
    for part in re.split(r"(\{[^{}]*\}|\*|\?)", name):
        if part == "*":
            parts.append(r".*?")
        elif part == "?":
            parts.append(".")
        elif part.startswith("{"):
            field, _, form = part[1:-1].partition(":")
            if not re.fullmatch(r"[a-z][a-z0-9_]*", field) or (form and field not in _TIMES):
                raise InputError(
                    f"{where}: field {part} in {name!r}; write a name in small letters, and a form only for {{time:…}}"
                )
            if field in (f for f, _ in fields):
                raise InputError(f"{where}: field {part} stands twice in {name!r}")
            inside = _time_expression(form) if form else _NUMBER if field in FIELDS else ".+?"
            parts.append(f"(?P<f{len(fields)}>{inside})")
            fields.append((field, form))
        else:
            parts.append(re.escape(part))
    return re.compile("".join(parts)), fields

"""Conversion of values to JSON, for results of commands, run records, and other JSON files.

A data class becomes an object of its fields, under their names. One whose JSON has other keys says so with a method
``json_fields``; `pick` helps it.
"""

from __future__ import annotations

import dataclasses
import html
import json
import math
import re
from collections.abc import Mapping
from datetime import date, datetime
from enum import Enum
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from photoplan.errors import UsageError


@runtime_checkable
class HasJsonFields(Protocol):
    """A value whose JSON is not just its fields."""

    def json_fields(self) -> Mapping[str, Any]:
        """Values by key; they need not be plain."""
        ...


def pick(value: object, *names: str, **keys: str) -> dict[str, Any]:
    """Attributes of a value by their names, and by other keys: ``pick(run, "tiles", seconds="wall_seconds")``."""
    return {name: getattr(value, name) for name in names} | {key: getattr(value, name) for key, name in keys.items()}


#: What XML 1.0 cannot hold, in whatever form.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def xml_text(value: str) -> str:
    """Escape text for an element of XML; characters that XML cannot hold become U+FFFD."""
    return html.escape(_NOT_XML.sub("\ufffd", value), quote=False).replace("\r", "&#13;")


def xml_quoted(value: str) -> str:
    """Quote and escape text for an attribute of XML; characters that XML cannot hold become U+FFFD."""
    escaped = html.escape(_NOT_XML.sub("\ufffd", value))
    return '"' + re.sub("[\t\n\r]", lambda found: f"&#{ord(found[0])};", escaped) + '"'


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, which is plural unless the count is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def advised(least: float, figures: int = 2) -> str:
    """Write the smallest number of some figures that is not below a bound: a user who gives it passes the check."""
    if not (math.isfinite(least) and least > 0):
        return f"{least:g}"
    digits = figures - 1 - math.floor(math.log10(least))
    step = 10.0**-digits
    # What is the bound but for rounding errors stays.
    count = math.ceil(least / step * (1 - 1e-12))
    return f"{max(float(f'{count * step:.{max(digits, 0)}f}'), 0.0):g}"


def plain(value: Any, where: str = "value") -> Any:
    """What JSON can say of a value.

    Data classes and mappings become objects, arrays, tuples and sets (sorted) lists, enumerations their values, paths
    and dates text. NaN and infinity become None: JSON does not know them.
    """
    if value is None or type(value) in (str, bool, int):
        return value
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Enum):
        return plain(value.value, where)
    if isinstance(value, str | int):
        return value
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, HasJsonFields):
        value = value.json_fields()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = pick(value, *(field.name for field in dataclasses.fields(value)))
    if isinstance(value, Mapping):
        return {str(key): plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, set | frozenset):
        value = sorted(value)
    if isinstance(value, list | tuple):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), where)
    raise UsageError(f"{where} is a {type(value).__name__}; JSON holds numbers, texts, lists and tables")


def json_text(value: Any, where: str = "value", indent: int | None = 2) -> str:
    """A value as JSON text; see `plain`."""
    return json.dumps(plain(value, where), indent=indent, ensure_ascii=False, allow_nan=False)


def two_figures(size: float, least: int = 3) -> int:
    """Decimals that show two figures of a size: `least` of them, at most nine; `least` for what is below 1e-9."""
    size = abs(size)
    return min(max(least, 1 - math.floor(math.log10(size))), 9) if math.isfinite(size) and size > 1e-9 else least


def shown_metres(value: float, size: float) -> str:
    """A length in metres, to two figures of `size` (its standard deviation, or itself), and to millimetres at least."""
    return f"{value:.{two_figures(size)}f} m"

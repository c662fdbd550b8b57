"""Text, JSON and TOML files read whole, with limits: size, encoding."""

from __future__ import annotations

import json
import math
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from photoplan.errors import InputError
from photoplan.geometry.crs import split_compound
from photoplan.geometry.units import MetricSystem, metric_system
from photoplan.io.appearance import looks_like
from photoplan.io.project.errors import explain

M = TypeVar("M", bound=BaseModel)


def read_text(path: Path, max_bytes: int) -> str:
    """Text of a UTF-8 file (a byte order mark is dropped, line ends become newlines)."""
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise InputError(f"{path}: {size} bytes; at most {max_bytes} are read from a file of this kind")
        with path.open("rb") as file:  # devices and pipes have no size: never more is read than is allowed
            raw = file.read(max_bytes + 1)
        if len(raw) > max_bytes:
            raise InputError(
                f"{path}: more than {max_bytes} bytes; at most that many are read from a file of this kind"
            )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    return decoded_text(path, raw)


def decoded_text(path: Path, raw: bytes, first_line: int = 1) -> str:
    """UTF-8 text with plain line ends; `raw` begins with the file's line `first_line`."""
    try:
        text = raw.decode("utf-8-sig" if first_line == 1 else "utf-8")
        at, wrong = text.find("\0"), "holds a zero byte; this is not a text file"
        before = text[: max(at, 0)].count("\n")
    except UnicodeDecodeError as error:
        at, wrong = error.start, f"not UTF-8 (byte {raw[error.start]:#04x}); save the file as UTF-8"
        before = raw[:at].count(b"\n")
    if at >= 0:
        raise InputError(f"{path}:{first_line + before}: {wrong}{looks_like(path)}")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_head(path: Path) -> str:
    """The beginning of a text file, to tell formats apart; bytes that are not UTF-8 are replaced."""
    try:
        with path.open("rb") as file:
            raw = file.read(65_536)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    return raw.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path, max_bytes: int = 1_000_000_000) -> Any:
    """Plain contents of a JSON file; NaN and infinity are refused, since JSON has no such numbers."""
    return parse_json(read_text(path, max_bytes), str(path))


def read_json_lines(path: Path, max_bytes: int = 1_000_000_000) -> list[Any]:
    """Plain contents of a file that has a JSON document in each line, with the marks of a JSON sequence (RFC 8142) or
    without, or a single one in all lines.
    """
    text = read_text(path, max_bytes)
    lines = [line.lstrip("\x1e") for line in text.split("\n")]
    first = next((line for line in lines if line.strip()), "")
    # The first line of a document in many lines is no document.
    if not (first.rstrip().endswith("}") and first.lstrip().startswith("{")):
        return [parse_json(text, str(path))]
    return [parse_json(line, str(path), number) for number, line in enumerate(lines, 1) if line.strip()]


def parse_json(text: str, where: str, first_line: int = 1) -> Any:
    """Plain contents of a JSON text, the one place where foreign JSON is taken apart.

    Whole numbers beyond 64 bits become floats; NaN, infinity and numbers too large for a float are refused.
    """

    def refuse(word: str) -> NoReturn:
        raise InputError(f"{where}: holds {word[:40]}, which is no number in JSON; repair the file")

    def number(word: str) -> float:
        value = float(word)
        return value if math.isfinite(value) else refuse(word)

    def whole(word: str) -> int | float:
        return int(word) if len(word) < 19 else number(word)

    try:
        return json.loads(text, parse_constant=refuse, parse_int=whole, parse_float=number)
    except json.JSONDecodeError as error:
        raise InputError(f"{where}:{error.lineno + first_line - 1}: not valid JSON ({error.msg})") from None
    except RecursionError:
        raise InputError(f"{where}: nested far too deep for a file of this kind") from None


def json_object(text: Any, where: str) -> dict[str, Any]:
    """Members of a JSON text that must be an object."""
    if not isinstance(text, str):
        raise InputError(f"{where}: {type(text).__name__} instead of a text in JSON")
    return members(parse_json(text, where), where)


def members(value: Any, where: str) -> dict[str, Any]:
    """The value, if it is an object of JSON; None stands for an empty one."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f"{where}: {str(value)[:60]!r} given; named values in {{ }} are needed")
    return value


def elements(value: Any, where: str) -> list[Any]:
    """The value, if it is a list of JSON; None stands for an empty one."""
    if value is None:
        return []
    if not isinstance(value, list):
        raise InputError(f"{where}: {str(value)[:60]!r} given; a list is needed")
    return value


def number_rows(value: Any, where: str, width: int) -> NDArray[np.float64]:
    """A list of lists of `width` finite numbers, shape (n, width); None stands for an empty one."""
    rows = elements(value, where)
    try:
        out = np.array(rows, float).reshape(-1, width) if rows else np.empty((0, width))
    except (TypeError, ValueError, OverflowError, RecursionError):
        out = np.full((1, width), np.nan)
    if not np.isfinite(out).all() or len(out) != len(rows):
        raise InputError(f"{where}: a list of {width} finite numbers each is needed")
    return out


def build(model: type[M], values: dict[str, Any], source: str) -> M:
    """A model of plain values; errors become messages that begin with `source`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(explain(error, values, source)) from None


def finite(value: Any, where: str, count: int | None = None) -> Any:
    """A finite number, or `count` of them as a tuple of floats."""
    if count is not None:
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
            raise InputError(f"{where}: {value!r} given; {count} numbers are needed")
        return tuple(finite(v, where) for v in value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise InputError(f"{where}: {repr(value)[:80]} given; a finite number is needed")
    return float(value)


def whole_number(word: str) -> int | None:
    """Whole number of up to 18 ASCII digits; None if a word is anything else, such as a superscript."""
    return int(word) if word.isascii() and word.isdecimal() and len(word) <= 18 else None


_MAX_BYTES = 100_000


@dataclass(frozen=True)
class StatedCrs:
    """What such a file states."""

    file: Path
    crs: str
    """Horizontal CRS."""
    height_system: str | None
    """None: it states a horizontal CRS alone."""
    system: MetricSystem
    """The same in metres, with what leads coordinates there."""


def crs_beside(path: Path) -> StatedCrs | None:
    """CRS (EPSG code, WKT or PROJ string) in the file of the same name with the suffix ``.prj``; None: there
    is none.
    """
    side = next((p for p in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if p.is_file()), None)
    if side is None:
        return None
    text = read_text(side, _MAX_BYTES).strip()
    crs, heights = split_compound(text, str(side))
    return None if crs is None else StatedCrs(side, crs, heights, metric_system(text, str(side)))


#: A project of 100,000 images stays far below; anything larger is not a project file.
MAX_BYTES = 200_000_000


def read_toml(path: Path, max_bytes: int = MAX_BYTES) -> tuple[dict[str, Any], str]:
    """Contents of a TOML file and its text."""
    text = read_text(path, max_bytes)
    try:
        return tomllib.loads(text), text
    except (ValueError, RecursionError) as error:  # whole numbers of thousands of digits are no TOMLDecodeError
        raise InputError(f"{path}: not valid TOML: {error}") from None


def read_entries(path: Path, model: type[M], max_bytes: int = MAX_BYTES) -> M:
    """Contents of a TOML file as a checked value."""
    contents, text = read_toml(path, max_bytes)
    try:
        return model.model_validate(contents)
    except ValidationError as error:
        raise InputError(explain(error, contents, str(path), text)) from None

"""Lines of text files, whatever their line ends, their fields, and the numbers in these."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.plain_files import decoded_text

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
    """Whether a text is a number such as 1,5."""
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

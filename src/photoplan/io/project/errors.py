"""Validation errors rewritten for users: one line per error, with the entry and its line in the file."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

#: Errors that are listed; the rest is counted.
SHOWN = 8


def explain(
    error: ValidationError, data: dict[str, Any], source: str, text: str = "", below: Sequence[int | str] = ()
) -> str:
    """Message for a user: every error with the path of its entry, the line, what was given and what is allowed."""
    lines: list[str] = []
    for item in error.errors(include_url=False):
        location = [*below, *_in_data(item["loc"], data, item["type"])]
        line = line_of(text, location) if text else None
        where = f"{source}:{line}" if line else source
        entry = _entry(location)
        lines.append(f"{where}: {entry + ': ' if entry else ''}{_reason(item)}")
    lines = list(dict.fromkeys(lines))
    more = [f"… and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    return "\n".join(lines[:SHOWN] + more)


def _in_data(loc: Sequence[int | str], data: Any, kind: str) -> list[int | str]:
    """The location without the tags of alternatives that pydantic inserts."""
    found: list[int | str] = []
    here = data
    for k, step in enumerate(loc):
        last = k == len(loc) - 1
        if isinstance(here, dict) and step in here:
            here = here[str(step)]
        elif isinstance(here, list | tuple) and isinstance(step, int) and step < len(here):
            here = here[step]
        elif not (last and kind in ("missing", "extra_forbidden")):
            continue
        found.append(step)
    return found


def _entry(location: Sequence[int | str]) -> str:
    text = ""
    for step in location:
        if isinstance(step, int):
            text += f"[{step + 1}]"
        else:
            text += ("." if text else "") + (
                step if re.fullmatch(r"[A-Za-z0-9_-]+", step) else json.dumps(step, ensure_ascii=False)
            )
    return text


def _reason(item: Any) -> str:
    kind, given = item["type"], repr(item.get("input"))
    given = given if len(given) <= 80 else given[:77] + "…"
    if kind == "missing":
        return "is missing"
    if kind == "extra_forbidden":
        return "unknown entry; look at its spelling"
    if kind == "value_error":
        return str(item["ctx"]["error"])
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        allowed = item.get("ctx", {}).get("expected_tags", "")
        return f"type is not one of {allowed}" if allowed else "type is missing"
    message = item["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{given} given; allowed is {message}" if message != item["msg"] else f"{given} given; {message}"


def line_of(text: str, location: Sequence[int | str]) -> int | None:
    """Line (from 1) of an entry in TOML text as people write it; None where the entry is not found by this search."""
    lines = text.split("\n")
    if not location:
        return None
    if location[0] == "images" and len(location) > 1 and isinstance(location[1], int):
        starts = [n for n, line in enumerate(lines) if re.match(r"\s*\[\[\s*images\s*\]\]", line)]
        if location[1] >= len(starts):
            return None
        start = starts[location[1]]
        return _key_below(lines, start, location[2:]) or start + 1
    for depth in range(len(location), 0, -1):
        header = r"\s*\[\s*" + r"\s*\.\s*".join(_key(s) for s in location[:depth]) + r"\s*\]\s*(#.*)?$"
        for n, line in enumerate(lines):
            if re.match(header, line):
                return _key_below(lines, n, location[depth:]) or n + 1
    return _key_below(lines, -1, location)


def _key(step: int | str) -> str:
    quoted = re.escape(json.dumps(str(step), ensure_ascii=False))
    bare = re.escape(str(step))
    return rf"(?:{bare}|{quoted}|'{bare}')"


def _key_below(lines: list[str], start: int, rest: Sequence[int | str]) -> int | None:
    if not rest:
        return None
    for n in range(start + 1, len(lines)):
        if re.match(r"\s*\[", lines[n]):
            return None
        if re.match(r"\s*" + _key(rest[0]) + r"\s*[=.]", lines[n]):
            return n + 1
    return None

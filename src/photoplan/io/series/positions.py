"""Tables of positions of targets that were measured before: over a stage's field, or over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.series.model import PositionsEntry
from photoplan.io.series.names import number_of_time, read_records

_NEEDED = {"stage": ("x", "y", "stage_x", "stage_y"), "target": ("x", "y", "time_s")}
_MOST = 100_000


@dataclass(frozen=True)
class MeasuredPosition:
    """A line of the table."""

    name: str
    """Of the point (stage) or the target; its number where the table has none."""
    x: float
    y: float
    """Column and row, pixels."""
    stage: tuple[float, float] | None = None
    time_s: float | None = None


@dataclass(frozen=True)
class MeasuredPositions:
    """A ``[[positions]]`` entry with its lines."""

    entry: PositionsEntry
    file: Path
    lines: tuple[MeasuredPosition, ...]

    @property
    def label(self) -> str:
        """How messages and figures call it."""
        return self.entry.name or self.file.stem


def read_positions(path: Path, entry: PositionsEntry) -> MeasuredPositions:
    """Positions of a table.

    Raises
    ------
    InputError
        A column is missing, or a field is no number; the message names the line.
    """
    header, records = read_records(path)
    missing = [name for name in _NEEDED[entry.kind] if name not in header]
    if missing:
        raise InputError(
            f"{path}: columns {', '.join(header)} given; positions of kind {entry.kind} also need {', '.join(missing)}"
        )
    if len(records) > _MOST:
        raise InputError(f"{path}: {len(records)} lines; at most {_MOST} are read")
    label = "name" if entry.kind == "stage" else "target"
    lines = tuple(_line(where, fields, label, k) for k, (where, fields) in enumerate(records, 1))
    return MeasuredPositions(entry, path, lines)


def _line(where: str, fields: dict[str, str], label: str, number: int) -> MeasuredPosition:
    name = fields.get(label, "").strip() or (str(number) if label == "name" else "target")
    x, y = _numbers(where, fields, ("x", "y"))
    if label == "name":
        sx, sy = _numbers(where, fields, ("stage_x", "stage_y"))
        return MeasuredPosition(name, x, y, stage=(sx, sy))
    text = fields["time_s"].strip()
    if not text:
        raise InputError(f"{where}: time_s is empty; every measurement needs its time")
    try:
        seconds: float | str = float(text)
    except ValueError:
        seconds = text
    return MeasuredPosition(name, x, y, time_s=number_of_time(seconds, where))


def _numbers(where: str, fields: dict[str, str], names: Sequence[str]) -> list[float]:
    found = []
    for name in names:
        try:
            value = float(fields[name])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{where}: {name} is {fields[name][:40]!r}; a finite number is needed")
        found.append(value)
    return found

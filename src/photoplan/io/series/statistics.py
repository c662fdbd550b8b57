"""What was measured of a series elsewhere: means and variances, positions of targets over a stage's field or time."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.io.plain_files import read_text
from photoplan.io.series.model import PositionsEntry, StatisticsEntry
from photoplan.io.series.names import condition, number_of_time, read_records

_MAX_BYTES = 50_000_000


@dataclass(frozen=True)
class ReducedPoint:
    """Mean and temporal variance of the frames of one setting."""

    kind: str
    """``flat`` or ``dark``."""
    mean: float
    """Grey values."""
    variance: float
    """Temporal variance of a pixel, squared grey values."""
    pixels: int
    frames: int
    exposure_ms: float | None = None
    photons_per_pixel: float | None = None
    temperature_c: float | None = None
    wavelength_nm: float | None = None


def read_statistics(path: Path, entry: StatisticsEntry) -> list[ReducedPoint]:
    """Reduced figures of a file."""
    points = _emva(path, entry) if entry.format == "emva1288" else _csv(path, entry)
    if not points:
        raise InputError(f"{path}: holds no reduced figure")
    return points


_NEEDED = ("kind", "mean", "variance")


def _csv(path: Path, entry: StatisticsEntry) -> list[ReducedPoint]:
    header, records = read_records(path)
    missing = [name for name in _NEEDED if name not in header]
    if missing:
        raise InputError(f"{path}: columns {', '.join(header)} given; {', '.join(missing)} needed")
    if entry.pixels is None and "pixels" not in header:
        raise InputError(f"{path}: states no number of pixels; add a column pixels, or the entry pixels")
    points = []
    for where, fields in records:
        texts = {key: text for key, text in fields.items() if text}
        kind = texts.pop("kind", "")
        if kind not in ("flat", "dark"):
            raise InputError(f"{where}: kind {kind!r}; allowed are flat and dark")
        found = dict(condition(key, text, where) for key, text in texts.items())
        for name in ("mean", "variance", "pixels", "frames"):
            if name in found and (isinstance(found[name], str) or not math.isfinite(float(found[name]))):
                raise InputError(f"{where}: {name} is {texts[name][:40]!r}; a number is needed")
        if "mean" not in found or "variance" not in found:
            raise InputError(f"{where}: mean or variance is empty")
        points.append(_point(kind, found, entry, where))
    return points


def _point(kind: str, found: Mapping[str, Any], entry: StatisticsEntry, where: str) -> ReducedPoint:
    variance, pixels = float(found["variance"]), float(found.get("pixels", entry.pixels or 0))
    frames = float(found.get("frames", entry.frames))
    if variance < 0 or not 2 <= pixels < 1e12 or not 2 <= frames <= 1e6:
        raise InputError(
            f"{where}: variance {variance:g}, {pixels:g} pixels, {frames:g} frames; a variance is not negative and "
            "needs two pixels and two frames"
        )
    return ReducedPoint(
        kind=kind,
        mean=float(found["mean"]),
        variance=variance,
        pixels=int(pixels),
        frames=int(frames),
        exposure_ms=found.get("exposure_ms"),
        photons_per_pixel=found.get("photons_per_pixel"),
        temperature_c=found.get("temperature_c", entry.temperature_c),
        wavelength_nm=found.get("wavelength_nm", entry.wavelength_nm),
    )


def _emva(path: Path, entry: StatisticsEntry) -> list[ReducedPoint]:
    """Sums over two images and sums of squared differences, of the ``temporal`` part of such a dictionary.

    With N pixels: mean = sum / (2 N), variance = pvar / (4 N); exposures are in nanoseconds. The spatial arrays, which
    these files abbreviate, are left out.
    """
    text = read_text(path, _MAX_BYTES)
    size = {name: re.search(rf"'{name}':\s*(\d{{1,7}})\b", text) for name in ("width", "height")}
    width, height = size["width"], size["height"]
    pixels = entry.pixels or (int(width[1]) * int(height[1]) if width and height else 0)
    start = text.find("'temporal'")
    if start < 0 or pixels < 2:
        raise InputError(f"{path}: not a dictionary of the package emva1288 with 'temporal', 'width' and 'height'")
    temporal = _dictionary(path, text, text.find("{", start))
    points = []
    for exposure, at in _items(path, temporal.get("bright")):
        for photons, sums in _items(path, at):
            points.append(_of_sums(path, "flat", exposure, sums, pixels, entry, photons))
    for exposure, sums in _items(path, temporal.get("dark")):
        points.append(_of_sums(path, "dark", exposure, sums, pixels, entry, None))
    return points


def _dictionary(path: Path, text: str, start: int) -> dict[Any, Any]:
    """The literal that begins at `start`; nothing is executed."""
    depth = 0
    for match in re.compile(r"[{}]").finditer(text, max(start, 0)):
        depth += 1 if match[0] == "{" else -1
        if depth == 0 or depth > 8:
            break
    try:
        found = ast.literal_eval(text[start : match.end()])
    except (ValueError, SyntaxError, RecursionError, MemoryError, UnboundLocalError):
        found = None
    if not isinstance(found, dict):
        raise InputError(f"{path}: the part 'temporal' is no plain dictionary")
    return found


def _items(path: Path, found: Any) -> list[tuple[float, Any]]:
    if not isinstance(found, dict) or not all(isinstance(k, int | float) and math.isfinite(k) for k in found):
        raise InputError(f"{path}: the part 'temporal' lacks exposures with their figures")
    return sorted(found.items())


def _of_sums(
    path: Path, kind: str, exposure: float, sums: Any, pixels: int, entry: StatisticsEntry, photons: float | None
) -> ReducedPoint:
    values = [sums.get(name) if isinstance(sums, dict) else None for name in ("sum", "pvar")]
    if not all(isinstance(v, int | float) and math.isfinite(v) and v >= 0 for v in values):
        raise InputError(f"{path}: exposure {exposure:g}: 'sum' and 'pvar' must be numbers")
    total, pvar = (float(v) for v in values if v is not None)
    return ReducedPoint(
        kind=kind,
        mean=total / (2 * pixels),
        variance=pvar / (4 * pixels),
        pixels=pixels,
        frames=2,
        exposure_ms=exposure * 1e-6,
        photons_per_pixel=photons,
        temperature_c=entry.temperature_c,
        wavelength_nm=entry.wavelength_nm,
    )


_COLUMNS = {"stage": ("x", "y", "stage_x", "stage_y"), "target": ("x", "y", "time_s")}
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
    """Positions of a table."""
    header, records = read_records(path)
    missing = [name for name in _COLUMNS[entry.kind] if name not in header]
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

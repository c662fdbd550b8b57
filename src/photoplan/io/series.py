"""Image series: description, names, pixels and statistics."""

from __future__ import annotations

import ast
import datetime
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, Strict, field_validator, model_validator

from photoplan.arrays import Mask
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.camera.model import Entry, Name, Number, Positive
from photoplan.io.files import check_input_name, read_entries, read_text, resolve_input
from photoplan.io.raster import RasterReader
from photoplan.io.tables import NUMBER, Columns, decimal, read_table

#: Kinds of frames and what they show.
KINDS = {
    "dark": "no light reaches the sensor",
    "flat": "an evenly lit surface without structure",
    "wedge": "a grey wedge: patches of known density",
    "scene": "any fixed scene, exposed differently from frame to frame",
    "target": "a target taken again and again while the camera warms up",
    "drift": "an evenly lit surface taken again and again over time",
    "step": "frames that follow a sudden change of brightness",
    "plumb": "a straight vertical edge, or two parallel ones",
    "stage": "a target shifted by known steps of a stage",
}
#: Conditions that an entry may state for its frames, and their units.
CONDITIONS = {
    "exposure_ms": "ms",
    "temperature_c": "°C",
    "wavelength_nm": "nm",
    "photons_per_pixel": "photons",
    "irradiance_uw_cm2": "µW/cm²",
    "illumination": "",
    "density": "",
    "time_s": "s",
}

NotNegative = Annotated[float, Strict(), Field(ge=0, le=1e15, allow_inf_nan=False)]
Count = Annotated[int, Strict(), Field(ge=0, le=10_000_000)]
Side = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Roi = tuple[Count, Count, Side, Side]


def _not_absurd(pattern: str) -> str:
    # More would make the comparison with a hostile name take for ever.
    if len(pattern) > 1000 or pattern.count("*") > 4 or pattern.count("{") > 8:
        raise ValueError(f"pattern of {len(pattern)} characters; at most 1000 with 4 stars and 8 fields are read")
    return pattern


Pattern = Annotated[str, Field(min_length=1), AfterValidator(_not_absurd)]


class CameraFacts(Entry):
    """What is known of the camera before it is measured; all of it may be left out."""

    name: Name | None = None
    bits: Annotated[int, Strict(), Field(ge=1, le=32)] | None = None
    """Bits of a grey value, so that 2^bits − 1 is the largest; default: those of the files' type."""
    saturation_dn: Positive | None = None
    """Largest grey value that the camera writes, where it is less."""
    black_level_dn: NotNegative = 0.0
    """Grey value that the camera adds to every pixel, for linearity where dark frames are missing."""
    bayer: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    """Colours of the first four pixels of the sensor (two rows of two); None: no colour filters, or bands."""
    pixel_size_um: Positive | None = None
    gain_db: Number | None = None
    """Setting of the camera's amplifier; only printed."""
    focal_px: Positive | None = None
    """Camera constant in pixels, for the cos⁴ part of light fall-off."""
    principal_point_px: tuple[Number, Number] | None = None
    """Column and row where the axis of the lens meets the sensor; default the middle of the image."""
    interlaced: Annotated[bool, Strict()] = False
    """Whether even and odd rows were taken one after the other, as video cameras do."""
    line_frequency_hz: Positive | None = None
    """Rows per second, so that periods along rows become frequencies."""


class StepEntry(Entry):
    """One patch of a grey wedge."""

    density: NotNegative
    roi: Roi
    """Column and row of its first pixel, width and height."""


class EdgeEntry(Entry):
    """One straight edge in plumb frames."""

    name: Name
    roi: Roi
    """Window that the edge crosses from end to end: column and row of its first pixel, width and height."""
    direction: Literal["vertical", "horizontal"] = "vertical"
    """How it runs; a horizontal edge is free of jitter of the rows and shows the method's own noise."""


class TargetEntry(Entry):
    """One round target in target or stage frames."""

    name: Name
    roi: Roi | None = None
    """Window in which it lies in all frames; None: the roi of the frames."""
    bright: Annotated[bool, Strict()] = True
    """Whether it is brighter than its surroundings."""


class FramesEntry(Entry):
    """A group of image files of one kind."""

    files: Pattern | tuple[Pattern, ...]
    """Patterns of files, relative to the series file: ``*``, ``?`` and named fields such as ``{exposure_ms}``."""
    kind: str
    exposure_ms: NotNegative | None = None
    temperature_c: Number | None = None
    wavelength_nm: Positive | None = None
    photons_per_pixel: NotNegative | None = None
    """Mean number of photons that fall on a pixel during the exposure."""
    irradiance_uw_cm2: NotNegative | None = None
    """With wavelength, exposure and the pixel's size: photons per pixel."""
    illumination: Number | None = None
    """Number of a lamp's setting."""
    density: NotNegative | None = None
    """Optical density of what the frames show."""
    time_s: Number | str | None = None
    """Time of the frames: seconds, or an ISO date (``2019-02-08T17:11:46``)."""
    time_from: Literal["exif"] | None = None
    """Take the time of each frame from its EXIF entries."""
    table: str | None = None
    """CSV file with a column ``file`` and columns named as the conditions."""
    roi: Roi | None = None
    """Column and row of the first pixel that counts, width and height."""
    mask: str | None = None
    """Image of the frames' size; pixels that are not zero count."""
    brightest: Annotated[float, Strict(), Field(gt=0, le=1)] | None = None
    """Share of the pixels that counts: those of each plane above this quantile of a reference frame."""
    brightest_exposure_ms: Positive | None = None
    """Exposure of the reference frame; default the longest in which under 0.1 % of the pixels are saturated."""
    steps: tuple[StepEntry, ...] = ()
    """Patches of a grey wedge."""
    edges: Annotated[tuple[EdgeEntry, ...], Field(max_length=200)] = ()
    """Straight edges in plumb frames."""
    targets: Annotated[tuple[TargetEntry, ...], Field(max_length=200)] = ()
    """Round targets in target or stage frames; None named: one in the roi."""
    name: Name | None = None
    values: dict[Name, Number | str] = Field(default_factory=dict)
    """Anything else that an analysis asks for."""

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in KINDS:
            raise ValueError(f"kind {kind!r}; allowed are {', '.join(KINDS)}")
        return kind

    @field_validator("files")
    @classmethod
    def _some(cls, files: Any) -> tuple[str, ...]:
        listed = (files,) if isinstance(files, str) else tuple(files)
        if not listed:
            raise ValueError("no file given")
        return listed

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.time_from is not None and self.time_s is not None:
            raise ValueError("give either time_s or time_from")
        if self.brightest_exposure_ms is not None and self.brightest is None:
            raise ValueError("brightest_exposure_ms needs brightest")
        if self.steps and self.kind != "wedge":
            raise ValueError(f"steps belong to kind wedge; this entry is {self.kind}")
        if self.edges and self.kind != "plumb":
            raise ValueError(f"edges belong to kind plumb; this entry is {self.kind}")
        if self.targets and self.kind not in ("target", "stage"):
            raise ValueError(f"targets belong to kinds target and stage; this entry is {self.kind}")
        for what, listed in (("edges", self.edges), ("targets", self.targets)):
            if len({each.name for each in listed}) < len(listed):
                raise ValueError(f"two {what} have the same name")
        if self.mask is not None and (self.kind in ("plumb", "target", "stage") or self.steps):
            raise ValueError(f"a mask does not count for {'steps' if self.steps else f'kind {self.kind}'}; give rois")
        if self.brightest is not None and (self.kind in ("plumb", "target", "stage", "drift", "step") or self.steps):
            raise ValueError(f"brightest does not count for {'steps' if self.steps else f'kind {self.kind}'}")
        if self.steps and self.density is not None:
            raise ValueError("give either density (one patch fills the frame) or steps")
        return self


class StatisticsEntry(Entry):
    """Figures that were reduced from images before."""

    file: Annotated[str, Field(min_length=1, max_length=1000)]
    format: Literal["csv", "emva1288"] = "csv"
    """``csv``: kind, exposure_ms, photons_per_pixel, mean, variance, pixels, frames; ``emva1288``: the dictionary of
    sums and pseudo-variances of that package's descriptor files."""
    pixels: Side | None = None
    """Pixels of an image, where the file does not say it."""
    frames: Annotated[int, Strict(), Field(ge=2, le=100_000)] = 2
    """Frames of each setting."""
    wavelength_nm: Positive | None = None
    temperature_c: Number | None = None


class PositionsEntry(Entry):
    """Positions of targets that were measured before, as a table."""

    file: Annotated[str, Field(min_length=1, max_length=1000)]
    """CSV with columns x and y (pixels); kind stage also stage_x, stage_y, name; kind target also time_s, target."""
    kind: Literal["stage", "target"]
    unit: Annotated[str, Field(min_length=1, max_length=20)] = "um"
    """Of the stage's coordinates."""
    name: Name | None = None


class SeriesEntry(Entry):
    """The whole file."""

    camera: CameraFacts = CameraFacts()
    frames: tuple[FramesEntry, ...] = ()
    statistics: tuple[StatisticsEntry, ...] = ()
    positions: tuple[PositionsEntry, ...] = ()

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.frames and not self.statistics and not self.positions:
            raise ValueError("holds no [[frames]], [[statistics]] or [[positions]] table")
        return self


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


_MAX_BYTES_STATISTICS = 50_000_000


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
    text = read_text(path, _MAX_BYTES_STATISTICS)
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


#: A series of a hundred thousand frames is far below this.
_MAX_BYTES_FILE = 20_000_000
_MAX_FRAMES = 100_000


@dataclass(frozen=True)
class SeriesGroup:
    """A ``[[frames]]`` entry."""

    index: int
    """Number of the entry, from 0."""
    entry: FramesEntry
    window: Window
    """Pixels that count: the entry's `roi`, or all."""
    mask: Path | None
    label: str
    """How messages call it."""
    most_dn: float = inf
    """Largest grey value that the stated bits make."""


@dataclass(frozen=True)
class SeriesFrame:
    """One image of the series and its conditions; None: not stated."""

    file: Path
    group: SeriesGroup
    kind: str
    exposure_ms: float | None = None
    temperature_c: float | None = None
    wavelength_nm: float | None = None
    photons_per_pixel: float | None = None
    irradiance_uw_cm2: float | None = None
    illumination: float | None = None
    density: float | None = None
    time_s: float | None = None
    """Seconds; since 1970 where a date was given."""
    values: Mapping[str, float | str] = field(default_factory=dict)
    """Everything else that the entry, the name or the table states."""


@dataclass(frozen=True)
class Series:
    """A whole series."""

    path: Path
    camera: CameraFacts
    frames: tuple[SeriesFrame, ...]
    reduced: tuple[ReducedPoint, ...]
    size: tuple[int, int] | None
    """Width and height of all frames; None: there are reduced figures only."""
    bands: int
    dtype: str
    saturation_dn: float
    """Largest grey value that can occur; infinity for float images without a stated one."""
    positions: tuple[MeasuredPositions, ...]
    """Positions of targets that were measured before."""
    inputs: tuple[Path, ...]
    """All files that were read or will be."""

    def of(self, *kinds: str) -> tuple[SeriesFrame, ...]:
        """Frames of these kinds, in the order of the file."""
        return tuple(frame for frame in self.frames if frame.kind in kinds)

    def reduced_of(self, kind: str) -> tuple[ReducedPoint, ...]:
        """Reduced figures of a kind."""
        return tuple(point for point in self.reduced if point.kind == kind)


def read_series(path: Path) -> Series:
    """Read a series file and find the frames that it names; pixels are not read, headers are."""
    entries = read_entries(path, SeriesEntry, _MAX_BYTES_FILE)
    folder = path.absolute().parent
    frames: list[SeriesFrame] = []
    inputs: list[Path] = [path]
    facts = _Facts()
    bits = entries.camera.bits
    most = inf if bits is None or entries.camera.saturation_dn else 2.0**bits - 1
    for index, entry in enumerate(entries.frames):
        where = _where(path, index, entry)
        files = _files_of(folder, entry, where)
        table = None if entry.table is None else resolve_input(folder, entry.table)
        conditions = {} if table is None else read_conditions(table)
        mask = None if entry.mask is None else resolve_input(folder, entry.mask)
        if len(frames) + len(files) > _MAX_FRAMES:
            raise InputError(f"{where}: more than {_MAX_FRAMES} frames; split the series")
        for file, values in files.items():
            facts = facts.join(file, where)
            assert facts.size is not None
            group = SeriesGroup(
                index=index, entry=entry, window=_window(entry, facts.size, where), mask=mask, label=where, most_dn=most
            )
            frames.append(_frame(file, group, values, _row_of(conditions, file, table), entries.camera))
        if mask is not None:
            _check_mask(mask, facts, where)
        inputs += [*files, *(p for p in (table, mask) if p is not None)]
    reduced: list[ReducedPoint] = []
    for figures in entries.statistics:
        source = resolve_input(folder, figures.file)
        reduced += read_statistics(source, figures)
        inputs.append(source)
    positions: list[MeasuredPositions] = []
    for table_of in entries.positions:
        source = resolve_input(folder, table_of.file)
        positions.append(read_positions(source, table_of))
        inputs.append(source)
    _refuse_twice(path, frames)
    saturation = entries.camera.saturation_dn or (2.0**bits - 1.0 if bits else facts.largest)
    return Series(
        path=path,
        camera=entries.camera,
        frames=tuple(frames),
        reduced=tuple(reduced),
        size=facts.size,
        bands=facts.bands,
        dtype=facts.dtype,
        saturation_dn=saturation,
        positions=tuple(positions),
        inputs=tuple(dict.fromkeys(inputs)),
    )


def _where(path: Path, index: int, entry: FramesEntry) -> str:
    return f"{path}: frames[{index + 1}]" + (f" {entry.name!r}" if entry.name else f" ({entry.kind})")


@dataclass(frozen=True)
class _Facts:
    """What all frames have in common."""

    first: Path | None = None
    size: tuple[int, int] | None = None
    bands: int = 1
    dtype: str = ""

    @property
    def largest(self) -> float:
        return {"uint8": 255.0, "uint16": 65535.0, "int16": 32767.0}.get(self.dtype, float("inf"))

    def join(self, file: Path, where: str) -> _Facts:
        """The same with a file that must have the same size, bands and type."""
        reader = RasterReader(file)
        if self.first is None:
            return _Facts(file, reader.size, reader.bands, str(reader.dtype))
        for what, mine, given in (
            ("size", self.size, reader.size),
            ("number of bands", self.bands, reader.bands),
            ("type of pixels", self.dtype, str(reader.dtype)),
        ):
            if mine != given:
                raise InputError(
                    f"{where}: {file.name} has {what} {given}, {self.first.name} has {mine}; the frames of a series "
                    "are alike: take the others out, or give them a series file of their own"
                )
        return self


def _files_of(folder: Path, entry: FramesEntry, where: str) -> dict[Path, Values]:
    found: dict[Path, Values] = {}
    for pattern in entry.files:
        matches = find_files(folder, pattern, where)
        if not matches:
            raise InputError(f"{where}: files {pattern!r} match nothing in {folder}; correct the pattern or the folder")
        found.update(matches)
    return found


def _window(entry: Entry, size: tuple[int, int], where: str) -> Window:
    roi = getattr(entry, "roi", None)
    if roi is None:
        return Window(0, 0, *size)
    window = Window(*roi)
    if window.stop[0] > size[0] or window.stop[1] > size[1]:
        raise InputError(f"{where}: roi {list(roi)} leaves the image of {size[0]} × {size[1]} pixels")
    return window


def _check_mask(mask: Path, facts: _Facts, where: str) -> None:
    size = RasterReader(mask).size
    if size != facts.size:
        raise InputError(f"{where}: mask {mask.name} has size {size}, the frames have {facts.size}")


def _row_of(conditions: Mapping[str, Values], file: Path, table: Path | None) -> Values:
    if table is None:
        return {}
    if file.name not in conditions:
        raise InputError(f"{table}: has no line for {file.name}, which the series names")
    return conditions[file.name]


def _refuse_twice(path: Path, frames: list[SeriesFrame]) -> None:
    seen: dict[tuple[Path, str], int] = {}
    for frame in frames:
        key = (frame.file, frame.kind)
        if key in seen:
            raise InputError(
                f"{path}: frames[{seen[key] + 1}] and frames[{frame.group.index + 1}] both take {frame.file.name} as "
                f"{frame.kind}; leave it to one of them"
            )
        if frame.group.entry.steps == () and frame.group.window.size:
            seen[key] = frame.group.index


def _frame(file: Path, group: SeriesGroup, named: Values, row: Values, camera: CameraFacts) -> SeriesFrame:
    """A frame with its conditions: the table counts before the name, the name before the entry."""
    from_entry = {k: v for k in CONDITIONS if (v := getattr(group.entry, k)) is not None}
    values: dict[str, float | str] = {**group.entry.values, **from_entry, **named, **row}
    known: dict[str, float] = {}
    for key in CONDITIONS:
        value = values.pop(key, None)
        if value is None:
            continue
        known[key] = number_of_time(value, group.label) if key == "time_s" else _number(key, value, group.label, file)
    if group.entry.time_from == "exif":
        known["time_s"] = _exif_time(file, group.label)
    if "photons_per_pixel" not in known:
        photons = _photons(known, camera)
        if photons is not None:
            known["photons_per_pixel"] = photons
    return SeriesFrame(file, group, group.entry.kind, **known, values=values)


_NOT_NEGATIVE = ("exposure_ms", "photons_per_pixel", "irradiance_uw_cm2", "density", "wavelength_nm")


def _number(key: str, value: float | str, where: str, file: Path) -> float:
    if isinstance(value, str):
        raise InputError(f"{where}: {file.name}: {key} is {value!r}; a number is needed")
    if key in _NOT_NEGATIVE and value < 0:
        raise InputError(f"{where}: {file.name}: {key} is {value:g}; it must not be negative")
    return float(value)


def _exif_time(file: Path, where: str) -> float:
    from photoplan.io.image_metadata import read_image_metadata  # noqa: PLC0415 - rarely needed

    stated = read_image_metadata(file)
    time = stated.time
    if time is None:
        damaged = f" ({'; '.join(stated.faults)})" if stated.faults else ""
        raise InputError(
            f"{where}: {file.name} holds no time in EXIF{damaged}; give time_s, a field {{time}} or a table"
        )
    return time


def _photons(known: Mapping[str, float], camera: CameraFacts) -> float | None:
    """Photons per pixel from irradiance, EMVA 1288 release 4 linear, section 2: E A t λ / (h c)."""
    needed = ("irradiance_uw_cm2", "exposure_ms", "wavelength_nm")
    if camera.pixel_size_um is None or any(key not in known for key in needed):
        return None
    joule = known["irradiance_uw_cm2"] * 1e-2 * (camera.pixel_size_um * 1e-6) ** 2 * known["exposure_ms"] * 1e-3
    return joule * known["wavelength_nm"] * 1e-9 / (6.62607015e-34 * 299792458.0)


#: Pixels of a frame that are held in memory at once.
MAX_PIXELS = 400_000_000


@dataclass(frozen=True)
class Plane:
    """Pixels of one colour: every second row and column of a Bayer pattern, or a band."""

    name: str
    """``R``, ``G1`` (green in the rows of red), ``G2``, ``B``; ``band 2``; empty where there is one plane only."""
    band: int
    """From 0."""
    row: int = 0
    """First row and column that belong to it, counted from the image's corner."""
    col: int = 0
    step: int = 1

    def first(self, window: Window) -> tuple[int, int]:
        """Row and column of its first pixel inside a window, counted from the window's corner."""
        return (self.row - window.row) % self.step, (self.col - window.col) % self.step

    def to_image(self, window: Window, col: float, row: float) -> tuple[float, float]:
        """(x, y) in the image of a position in the plane's array of that window."""
        first_row, first_col = self.first(window)
        return window.col + first_col + col * self.step, window.row + first_row + row * self.step


def series_planes(series: Series) -> tuple[Plane, ...]:
    """The planes of a series."""
    pattern = series.camera.bayer
    if pattern is None:
        if series.bands == 1:
            return (Plane("", 0),)
        return tuple(Plane(f"band {k + 1}", k) for k in range(series.bands))
    if series.bands != 1:
        raise InputError(
            f"{series.path}: camera.bayer is {pattern}, but the frames have {series.bands} bands; a Bayer pattern "
            "belongs to raw frames of one band: leave it out"
        )
    planes = []
    for k, colour in enumerate(pattern):
        row, col = divmod(k, 2)
        name = colour if colour != "G" else "G1" if "R" in pattern[2 * row : 2 * row + 2] else "G2"
        planes.append(Plane(name=name, band=0, row=row, col=col, step=2))
    return tuple(sorted(planes, key=lambda plane: ("R", "G1", "G2", "B").index(plane.name)))


def frame_pixels(frame: SeriesFrame, window: Window | None = None) -> NDArray[Any]:
    """Pixels of a frame's window, all bands, shape (bands, h, w), in the type of the file."""
    window = frame.group.window if window is None else window
    if window.size > MAX_PIXELS:
        raise InputError(
            f"{frame.group.label}: {window.width} × {window.height} pixels; at most {MAX_PIXELS:.2g} are held at once: "
            "give a roi"
        )
    pixels, valid = RasterReader(frame.file).read(window)
    if valid is not None:
        raise InputError(
            f"{frame.group.label}: {frame.file.name} has {int((~valid).sum())} pixels without a value (nodata, alpha "
            "or NaN); raw frames have a value in every pixel"
        )
    largest = float(pixels.max())
    if largest > frame.group.most_dn:
        raise InputError(
            f"{frame.group.label}: {frame.file.name} has the grey value {largest:.10g}, but camera.bits allow "
            f"{frame.group.most_dn:.10g}; correct the bits (where they are the upper ones of the files' type, leave "
            "them out)"
        )
    return pixels


def plane_pixels(frame: SeriesFrame, plane: Plane, window: Window | None = None) -> NDArray[Any]:
    """Pixels of one plane inside the frame's window, shape (h, w), in the type of the file."""
    window = frame.group.window if window is None else window
    return split(frame_pixels(frame, window), plane, window)


def split(pixels: NDArray[Any], plane: Plane, window: Window) -> NDArray[Any]:
    """The pixels of a plane out of all bands of a window."""
    row, col = plane.first(window)
    return pixels[plane.band, row :: plane.step, col :: plane.step]


def plane_mask(group: SeriesGroup, plane: Plane) -> Mask | None:
    """Which pixels of a plane count by the group's mask, shape as `plane_pixels`; None: all of them."""
    if group.mask is None:
        return None
    pixels, valid = RasterReader(group.mask).read(group.window)
    counts = (pixels != 0).any(axis=0)
    if valid is not None:
        counts &= valid
    row, col = plane.first(group.window)
    found = counts[row :: plane.step, col :: plane.step]
    if not found.any():
        raise InputError(f"{group.label}: mask {group.mask.name} leaves no pixel")
    return np.asarray(found)


#: Frames that are looked at, and the side of the window in their middle.
_FRAMES, _SIDE = 48, 128
#: Different grey values from which on neighbouring ones occur among them.
_LEAST_VALUES = 8


def grey_step(series: Series) -> float:
    """Smallest distance of two grey values in a window of some frames; 1 where these have too few of them."""
    frames = series.frames
    chosen = frames if len(frames) <= _FRAMES else [frames[k * len(frames) // _FRAMES] for k in range(_FRAMES)]
    steps = [step for frame in chosen if (step := _step(frame)) is not None]
    return min(steps, default=1.0)


def _middle(frame: SeriesFrame) -> Window:
    window = frame.group.window
    width, height = min(_SIDE, window.width), min(_SIDE, window.height)
    return Window(window.col + (window.width - width) // 2, window.row + (window.height - height) // 2, width, height)


def _step(frame: SeriesFrame) -> float | None:
    """Smallest distance of two values; None: there are too few different ones, or the frame cannot be used."""
    try:
        pixels = frame_pixels(frame, _middle(frame))
    except InputError:  # said by the analysis that needs the frame
        return None
    values = np.unique(pixels).astype(np.float64)
    return float(np.diff(values).min()) if values.size >= _LEAST_VALUES else None


def largest_of_steps(largest: float, step: float) -> float:
    """The largest grey value that a number of whole steps makes."""
    return largest if step < 2 or not np.isfinite(largest) else float(largest // step * step)

"""Files of image quality and radiometry: balance, fall-off, filters, MTF, chromatic displacement, sensors."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, Strict, ValidationError, model_validator

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.camera.model import LARGEST, Entry, Name, NotNegative, Number, Pair, Pixels, Positive
from photoplan.io.disk import gdal_settings, open_raster
from photoplan.io.files import build, explain, finite, read_entries, read_head, read_text, read_toml
from photoplan.io.product import DESCRIPTION
from photoplan.io.project.file import toml_key, toml_value
from photoplan.io.raster import read_pixels
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.store import write_atomically
from photoplan.io.tables import Columns, read_table

_MAX_BYTES, _FEW_BYTES = 10_000_000, 1_000_000
_Side = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
_Power = Annotated[int, Strict(), Field(ge=0, le=8)]
_Numbers = Annotated[tuple[Number, ...], Field(min_length=2, max_length=65_536)]


class BalanceBand(Entry):
    """``[[bands]]``: one band, in the image's order."""

    grey: _Numbers
    """Grey values of the table, rising."""
    becomes: _Numbers
    """What they become, never falling; between them it is linear."""
    sigma: tuple[NotNegative, ...] = ()
    """Standard deviations; only information."""
    trend: Annotated[tuple[tuple[_Power, _Power, Number], ...], Field(max_length=60)] = ()
    """Terms i, j, c of 1 + Σ c (uⁱ vʲ − mean), by which grey values, or their light, are divided before the table."""
    curve_grey: _Numbers | tuple[()] = ()
    """Grey values of the image's characteristic curve, rising; none: grey values are light."""
    curve_light: _Numbers | tuple[()] = ()
    """The light that gives them, never falling; it is divided by the trend, and `grey` are values of it."""

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if len(self.grey) != len(self.becomes):
            raise ValueError(
                f"{len(self.grey)} entries of grey, but {len(self.becomes)} of becomes; give as many of both"
            )
        if len(self.curve_grey) != len(self.curve_light):
            raise ValueError(
                f"{len(self.curve_grey)} entries of curve_grey, but {len(self.curve_light)} of curve_light; give as "
                "many of both, or none"
            )
        return self


class BalanceFile(Entry):
    """A whole file."""

    format: Literal["photoplan balance 1"]
    size: tuple[_Side, _Side]
    """Width and height of the image, pixels."""
    description: Annotated[str, Field(max_length=10_000)] = ""
    bands: Annotated[tuple[BalanceBand, ...], Field(min_length=1, max_length=1000)]


def read_balance_file(path: Path) -> BalanceFile:
    """Contents of a balance file."""
    return read_entries(path, BalanceFile, _MAX_BYTES)


def write_balance_file(path: Path, size: tuple[int, int], description: str, bands: Sequence[BalanceBand]) -> None:
    """Write a balance file; the name holds the old or the whole new file."""
    lines = [
        "# What becomes of grey values: table(light / trend), light by curve_grey and curve_light; without these light",
        "# is grey. Between entries tables are linear, they may not fall.",
        "# A term [i, j, c] adds c (u^i v^j - its mean) to a trend of 1; u, v are columns and rows from the image's",
        "# middle, in half diagonals.",
        'format = "photoplan balance 1"',
        f"size = {toml_value(list(size))}",
        f"description = {toml_value(description)}",
    ]
    for band in bands:
        lines += ["", "[[bands]]"]
        span = max(abs(value) for value in (*band.grey, *band.becomes))
        places = max(2, 5 - math.ceil(math.log10(max(span, 1e-9))))
        for name in ("curve_grey", "curve_light", "grey", "becomes", "sigma"):
            if values := getattr(band, name):
                lines.append(f"{name} = [{', '.join(f'{value:.{places}f}' for value in values)}]")
        if band.trend:
            lines.append(f"trend = [{', '.join(f'[{i}, {j}, {c:.6f}]' for i, j, c in band.trend)}]")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


_Degree = Annotated[int, Strict(), Field(ge=-20, le=20)]


class TermEntry(Entry):
    """A term of the artificial part."""

    n: _Degree
    """Power of the radius, in half diagonals of the image."""
    m: _Degree
    """Multiple of the angle: cosine, where negative the sine of its amount; 0: the same all around."""
    coefficient: Number
    sigma: NotNegative | None = None
    """Standard deviation; only information."""


class FallOffEntry(Entry):
    """The whole file."""

    format: Literal["photoplan light fall-off 1"]
    size: tuple[_Side, _Side]
    """Width and height of the images that it corrects, pixels (of a Bayer pattern: of one colour)."""
    plane: Annotated[str, Field(max_length=100)] = ""
    """Which colour it corrects; empty: images of one band."""
    principal_point_px: tuple[Number, Number]
    camera_constant_px: Positive | None = None
    """Of the natural part cos⁴ω; left out: the terms hold everything."""
    dark_dn: Number = 0.0
    """Grey value of no light."""
    gain_image: Annotated[str, Field(max_length=1000)] | None = None
    """Image of the gains beside this file; only information, the gains follow from the terms."""
    gain_reduction: Annotated[int, Strict(), Field(ge=1)] | None = None
    """Pixels of the camera per pixel of the gain image, along each side."""
    terms: Annotated[tuple[TermEntry, ...], Field(max_length=200)] = ()


def read_fall_off_entry(path: Path) -> FallOffEntry:
    """Contents of a correction file."""
    return read_entries(path, FallOffEntry, _FEW_BYTES)


def fall_off_text(entry: FallOffEntry) -> str:
    """A correction file's text."""
    lines = [
        "# Light fall-off: grey values are multiplied by 1 / (cos⁴ω · (1 + sum of terms)) after dark_dn is taken off.",
        "# A term is coefficient · r^n · cos(m θ), for negative m r^n · sin(|m| θ); r in half diagonals from the",
        "# principal point, θ from columns to rows.",
        *_stated((name, value) for name, value in entry if name != "terms"),
    ]
    for term in entry.terms:
        lines += ["", "[[terms]]", *_stated(term)]
    return "\n".join(lines) + "\n"


def _stated(entries: Iterable[tuple[str, Any]]) -> list[str]:
    return [f"{name} = {toml_value(value)}" for name, value in entries if value not in (None, "")]


_Band = Annotated[int, Strict(), Field(ge=1, le=1000)]
_ChromaticPower = Annotated[int, Strict(), Field(ge=0, le=5)]
_Count = Annotated[int, Strict(), Field(ge=0)]


class ChromaticBand(Entry):
    """``[[bands]]``: one band."""

    band: _Band
    terms: Annotated[tuple[tuple[_ChromaticPower, _ChromaticPower, Number, Number], ...], Field(max_length=60)] = ()
    sigmas: Annotated[tuple[Pair, ...], Field(max_length=60)] = ()
    kind: Annotated[str, Field(max_length=100)] = "polynomial"
    residual: Number | None = None
    count: _Count = 0
    rejected: _Count = 0


class ChromaticFile(Entry):
    """A whole file."""

    format: Literal["photoplan chromatic 1"]
    image_size: tuple[Pixels, Pixels]
    reference: _Band
    description: Annotated[str, Field(max_length=10_000)] = ""
    bands: Annotated[tuple[ChromaticBand, ...], Field(max_length=1000)] = ()


def read_chromatic(path: Path) -> ChromaticFile:
    """A model of lateral chromatic aberration."""
    return read_entries(path, ChromaticFile, _FEW_BYTES)


def write_chromatic(path: Path, contents: Mapping[str, Any], bands: Sequence[Mapping[str, Any]]) -> None:
    """Write a model; the name holds the old or the whole new file."""
    lines = ["# Lateral chromatic aberration: where a band lies against the reference, pixels.",
             "# A term [i, j, a, b] adds (a, b) u^i v^j; u, v from the image's middle in units of half its diagonal.",
             'format = "photoplan chromatic 1"']  # fmt: skip
    lines += [f"{name} = {_text(value)}" for name, value in contents.items()]
    for band in bands:
        lines += ["", "[[bands]]"]
        for name, value in band.items():
            if name in ("terms", "sigmas"):
                lines += [f"{name} = [", *(f"  {_text(each)}," for each in value), "]"]
            elif not (isinstance(value, float) and not math.isfinite(value)):
                lines.append(f"{name} = {_text(value)}")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _text(value: Any) -> str:
    """A plain value as TOML; numbers with nine digits, which is far below what is measured."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_text(each) for each in value) + "]"
    return toml_value(float(f"{value:.9g}") if isinstance(value, float) else value)


#: Entry `kind` of a filter file, by which it is told from a project.
FILTER_KIND: Literal["restoration filter"] = "restoration filter"
#: A hundred kernels of 101 × 101 values stay below.
MOST_BYTES = 64_000_000
MOST_KERNELS = 1024
#: Kernels have at most this many rows and columns, see `FilterKernel`.
MOST_ROWS = 101
#: Weights beyond it would overflow in single precision, times grey values and summed.
MOST_WEIGHT = 1e12

_Weight = Annotated[float, Strict(), Field(ge=-MOST_WEIGHT, le=MOST_WEIGHT, allow_inf_nan=False)]
_HEADER = """\
# Restoration filter of photoplan: the restored image is the image convolved with it.
# values[m + i][n + k] is the weight of the pixel i rows above and k columns left of the restored one; m and n are the
# middle row and column. Values may be edited; a sum of 1 keeps the brightness. photoplan info plots it
"""


class KernelEntry(Entry):
    """``[[kernels]]``: one kernel; see `photoplan.quality.restoration.restorer.FilterKernel`."""

    values: Annotated[tuple[tuple[_Weight, ...], ...], Field(max_length=MOST_ROWS)]
    """Rows and columns, an odd number of both."""
    at: Pair | None = None
    """Column and row."""
    band: _Band | None = None

    @model_validator(mode="after")
    def _odd(self) -> Self:
        columns = len(self.values[0]) if self.values else 0
        uneven = next((i for i, row in enumerate(self.values, 1) if len(row) != columns), None)
        if uneven is not None or columns > MOST_ROWS:
            at, count = uneven or 1, len(self.values[(uneven or 1) - 1])
            raise ValueError(
                f"row {at} of values has {count} numbers, row 1 {columns}; all need equally many, at most {MOST_ROWS}"
            )
        if len(self.values) % 2 == 0 or columns % 2 == 0:
            raise ValueError(f"values of {len(self.values)} rows and {columns} columns; both must be odd")
        return self


class FilterEntries(Entry):
    """A whole filter file; see `photoplan.quality.restoration.restorer.RestorationFilter`."""

    kind: Literal["restoration filter"] = FILTER_KIND
    format: Literal[1] = 1
    kernels: Annotated[tuple[KernelEntry, ...], Field(max_length=MOST_KERNELS)]
    image_size: tuple[Pixels, Pixels] | None = None
    description: str = ""
    facts: Mapping[str, Any] = {}


def read_filter_file(path: Path) -> FilterEntries:
    """Read a filter: TOML by its ending `.toml`, rows of numbers otherwise."""
    path = Path(path)
    if path.suffix.lower() != ".toml":
        kernel = build(KernelEntry, {"values": _matrix(path)}, str(path))
        return FilterEntries(kernels=(kernel,), description=f"matrix of {path.name}")
    contents, text = read_toml(path, MOST_BYTES)
    if contents.get("kind") != FILTER_KIND:
        raise InputError(f'{path}: no filter; a filter file states kind = "{FILTER_KIND}" and has [[kernels]]')
    try:
        return FilterEntries.model_validate(contents)
    except ValidationError as error:
        raise InputError(explain(error, contents, str(path), text)) from None


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
        values = np.array(kernel.values)
        gain = float(np.sqrt((values**2).sum()))
        lines += ["", f"# Sum {values.sum():.6g}; noise grows {gain:.4g} times.", "[[kernels]]"]
        if kernel.band is not None:
            lines.append(f"band = {kernel.band}")
        if kernel.at is not None:
            lines.append(f"at = [{float(kernel.at[0])!r}, {float(kernel.at[1])!r}]")
        lines += ["values = [", *(f"  [{', '.join(map(repr, row))}]," for row in kernel.values), "]"]
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


def _matrix(path: Path) -> list[list[float]]:
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
    return rows


_FREQUENCY = {
    "px": ("cycles_per_px", "cycles_per_pixel", "cycles/px", "cycles/pixel", "cy/px", "lp/px"),
    "mm": ("cycles_per_mm", "cycles/mm", "cy/mm", "lp_per_mm", "lp/mm"),
}
_MODULATION = ("modulation", "mtf", "contrast")
_LARGEST = 1.5


@dataclass(frozen=True, eq=False)
class MtfTable:
    """Modulation at some frequencies."""

    frequency: Floats
    """Increasing, above or at 0, shape (n,)."""
    modulation: Floats
    """0 to 1.5, shape (n,)."""
    unit: Literal["px", "mm"]
    """Frequencies are cycles per pixel, or per millimetre on the sensor."""

    def per_pixel(self, pixel_um: float | None) -> Floats:
        """Frequencies in cycles per pixel."""
        if self.unit == "px":
            return self.frequency
        if pixel_um is None:
            raise InputError(
                "laboratory values in cycles per mm need the size of a pixel on the sensor: give `pixel_size` UM, or a "
                "column cycles_per_px"
            )
        return self.frequency * (pixel_um / 1000.0)


def read_mtf_table(path: Path) -> MtfTable:
    """MTF values of a text table with a header: ``cycles_per_px`` or ``cycles_per_mm``, and ``modulation``."""
    words = read_head(path).casefold()
    unit: Literal["px", "mm"] = "mm" if any(name in words for name in _FREQUENCY["mm"]) else "px"
    if unit == "mm" and any(name in words for name in _FREQUENCY["px"]):
        unit = "px"
    needed = ("frequency", "modulation")
    roles = {"frequency": _FREQUENCY[unit], "modulation": _MODULATION}
    table = read_table(path, Columns(roles=roles, needed=needed, numbers=frozenset(needed)))
    frequency, modulation = table.numbers("frequency"), table.numbers("modulation")
    for k in range(len(frequency)):
        if frequency[k] < 0.0:
            raise InputError(f"{table.where(k)}: frequency {frequency[k]:g}; it is 0 or larger")
        if not 0.0 <= modulation[k] <= _LARGEST:
            hint = "; write parts of 1, not per cent" if modulation[k] > _LARGEST else ""
            raise InputError(f"{table.where(k)}: modulation {modulation[k]:g}; 0 to {_LARGEST:g} are allowed{hint}")
    order = np.argsort(frequency, kind="stable")
    twice = np.flatnonzero(np.diff(frequency[order]) == 0.0)
    if twice.size:
        k = int(order[twice[0] + 1])
        raise InputError(f"{table.where(k)}: frequency {frequency[k]:g} is given twice")
    return MtfTable(frequency[order], modulation[order], unit)


#: Bands of a matrix and their units.
BANDS = (
    ("E", "metre"),
    ("N", "metre"),
    ("H", "metre"),
    ("distance", "metre"),
    ("incidence angle", "degree"),
    ("ground size of the pixel", "metre"),
    ("surface: 0 terrain, else number of the object", ""),
    ("normal, east", ""),
    ("normal, north", ""),
)


@dataclass(frozen=True, eq=False)
class MatrixFile:
    """A coordinate matrix on the disk."""

    path: Path
    info: RasterInfo = field(init=False, repr=False)
    description: str = field(init=False, repr=False)
    """The view that it was made for, as `photoplan view matrix` has described it."""

    def __post_init__(self) -> None:
        info = read_info(self.path)
        with open_raster(info.path, info.driver) as file, gdal_settings():
            text = file.tags().get(DESCRIPTION)
        if text is None or len(info.colours) != len(BANDS) or info.dtype != "float64":
            raise InputError(f"{self.path}: is no coordinate matrix; make one with `photoplan view matrix`")
        object.__setattr__(self, "info", info)
        object.__setattr__(self, "description", text)

    def read(self, window: Window) -> Floats:
        """All bands of a window, shape (9, height, width); NaN: sky."""
        pixels, valid = read_pixels(self.info, window)
        return np.where(True if valid is None else valid, pixels, np.nan)


#: Nothing that is described is larger than LARGEST, or smaller than its reciprocal; it keeps every figure finite.
Amount = Annotated[float, Strict(), Field(ge=1 / LARGEST, le=LARGEST, allow_inf_nan=False)]
Count = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Share = Annotated[float, Strict(), Field(ge=1 / LARGEST, le=1, allow_inf_nan=False)]
Celsius = Annotated[float, Strict(), Field(ge=-273.15, le=300, allow_inf_nan=False)]


def _together(table: Entry, *names: str) -> None:
    """All of these entries, or none."""
    given = [name for name in names if getattr(table, name) is not None]
    if given and len(given) < len(names):
        left = " and ".join(name for name in names if name not in given)
        raise ValueError(f"{' and '.join(given)} given without {left}; they go together")


def _one_of(table: Entry, *names: str) -> None:
    """At most one of these entries."""
    given = [name for name in names if getattr(table, name) is not None]
    if len(given) > 1:
        raise ValueError(f"{' and '.join(given)} given; they say the same, keep one")


class Viewing(Entry):
    """How the picture is looked at."""

    angle_deg: Annotated[float, Strict(), Field(ge=1e-6, le=180, allow_inf_nan=False)]
    eye_resolution_arcmin: Amount
    aspect: tuple[Amount, Amount] = (4.0, 3.0)
    distance_m: Amount | None = None


class Video(Entry):
    """A video norm."""

    lines: Count
    line_us: Amount
    line_blanking_us: NotNegative = 0.0
    frame_blanking_us: NotNegative = 0.0
    aspect: tuple[Amount, Amount] = (4.0, 3.0)
    kell_factor: Share = 1.0
    fields: Annotated[int, Strict(), Field(ge=1, le=16)] = 2

    @model_validator(mode="after")
    def _shorter(self) -> Self:
        if self.line_blanking_us >= self.line_us:
            raise ValueError("line_blanking_us is as long as line_us or longer")
        if self.frame_blanking_us >= self.lines * self.line_us:
            raise ValueError("frame_blanking_us is as long as all lines or longer")
        return self


class Chip(Entry):
    """The light-sensitive area."""

    elements: tuple[Count, Count]
    size_mm: tuple[Amount, Amount] | None = None
    element_um: tuple[Amount, Amount] | None = None
    sensitive_um: tuple[Amount, Amount] | None = None

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        _one_of(self, "size_mm", "element_um")
        if self.size_mm is None and self.element_um is None:
            raise ValueError("size_mm or element_um is needed beside elements")
        if self.sensitive_um is not None:
            for wide, pitch in zip(self.sensitive_um, self.pitch):
                if wide > pitch * (1 + 1e-6):
                    raise ValueError(f"sensitive_um {wide:g} is larger than the element, {pitch:g} µm")
        return self

    @property
    def pitch(self) -> tuple[float, float]:
        """Period of the elements across and down, micrometres."""
        if self.element_um is not None:
            return self.element_um
        assert self.size_mm is not None
        return (1000.0 * self.size_mm[0] / self.elements[0], 1000.0 * self.size_mm[1] / self.elements[1])

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, millimetres."""
        if self.size_mm is not None:
            return self.size_mm
        return (self.pitch[0] * self.elements[0] / 1000.0, self.pitch[1] * self.elements[1] / 1000.0)


class PictureEntry(Entry):
    """The digital image."""

    pixels: tuple[Count, Count] | None = None
    pixel_um: tuple[Amount, Amount] | None = None
    reference_mm: Amount | None = None
    reference_pixels: tuple[Amount, Amount] | None = None
    bits: Annotated[int, Strict(), Field(ge=1, le=32)] | None = None
    sampling_mhz: Amount | None = None
    jitter_ns: NotNegative | None = None
    grey_step: Amount | None = None

    @model_validator(mode="after")
    def _fits(self) -> Self:
        _one_of(self, "pixel_um", "reference_mm")
        _together(self, "reference_mm", "reference_pixels")
        if self.jitter_ns is not None and self.sampling_mhz is None:
            raise ValueError("jitter_ns given without sampling_mhz; they go together")
        return self


class ChargeTransfer(Entry):
    """Shifting of charges."""

    inefficiency: Share
    transfers: Count
    signal_to_clock: Annotated[
        tuple[Annotated[float, Strict(), Field(ge=0, le=0.5, allow_inf_nan=False)], ...], Field(max_length=100)
    ] = (0.1, 0.25, 0.5)


class Noise(Entry):
    """Electrons and where their noise comes from."""

    signal_e: Amount | None = None
    full_well_e: Amount | None = None
    dark_e: NotNegative | None = None
    dark_share: Share | None = None
    dark_current_e_per_s: NotNegative | None = None
    exposure_s: Amount | None = None
    temperature_c: Celsius | None = None
    dark_reference_c: Celsius | None = None
    dark_doubling_c: Annotated[float, Strict(), Field(ge=1, le=1000, allow_inf_nan=False)] = 10.0
    read_noise_e: NotNegative | None = None
    output_capacitance_pf: NotNegative | None = None

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.signal_e is None and self.full_well_e is None:
            raise ValueError("signal_e or full_well_e is needed: noise depends on the signal")
        if self.signal_e is not None and self.full_well_e is not None and self.signal_e > self.full_well_e:
            raise ValueError(f"signal_e {self.signal_e:g} is more than full_well_e {self.full_well_e:g} holds")
        _one_of(self, "dark_e", "dark_share", "dark_current_e_per_s")
        _one_of(self, "read_noise_e", "output_capacitance_pf")
        _together(self, "dark_current_e_per_s", "exposure_s")
        _together(self, "temperature_c", "dark_reference_c")
        if self.temperature_c is not None and self.dark_current_e_per_s is None:
            raise ValueError("temperature_c given without dark_current_e_per_s; they go together")
        return self


class OpticsEntry(Entry):
    """The lens at its limit."""

    f_number: Amount
    wavelength_nm: Amount = 550.0


class SensorDescription(Entry):
    """What a file says of a sensor; every table may be left out."""

    name: Name = "sensor"
    viewing: Viewing | None = None
    video: Video | None = None
    sensor: Chip | None = None
    image: PictureEntry | None = None
    transfer: ChargeTransfer | None = None
    noise: Noise | None = None
    optics: OpticsEntry | None = None
    stated: Annotated[dict[Name, Number], Field(max_length=200, default_factory=dict)]
    """Figures as somebody else states them, by the name of the figure."""


def read_sensor(path: Path) -> SensorDescription:
    """The description of a sensor."""
    described = read_entries(path, SensorDescription, _FEW_BYTES)
    if not described.model_fields_set - {"name", "stated"}:
        raise InputError(
            f"{path}: describes nothing; write at least one of the tables [viewing], [video], [sensor], [image], "
            "[transfer], [noise], [optics]"
        )
    return described

"""Series files: which images of a camera are what, and under which conditions they were taken.

The file is TOML; `photoplan.io.series.model` has its entries. Values may stand in the entry, in the name of each file
(a pattern with named fields), in a table, or in EXIF.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.camera.model import Entry
from photoplan.io.names import resolve_input
from photoplan.io.plain_files import read_entries
from photoplan.io.raster import RasterReader
from photoplan.io.series.model import CONDITIONS, CameraFacts, FramesEntry, SeriesEntry
from photoplan.io.series.names import Values, find_files, number_of_time, read_conditions
from photoplan.io.series.statistics import MeasuredPositions, ReducedPoint, read_positions, read_statistics

#: A series of a hundred thousand frames is far below this.
_MAX_BYTES = 20_000_000
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
    entries = read_entries(path, SeriesEntry, _MAX_BYTES)
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

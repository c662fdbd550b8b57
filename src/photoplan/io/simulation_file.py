"""Descriptions of image formation models: TOML with one table for each part.

Units, meaning and admissible values of the entries are those of `photoplan.quality.formation.optics_parts` and
`photoplan.quality.formation.sensor_parts`; what an entry that is left out stands for is said there too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from photoplan.io.camera.model import Entry, Number, Pair
from photoplan.io.toml_file import read_entries

#: A description with a table of defects for every element of a large sensor stays below.
_MAX_BYTES = 20_000_000
Whole = Annotated[int, Strict(), Field(ge=0, le=2**62)]
Flag = Annotated[bool, Strict()]
Row = Annotated[tuple[Number, ...], Field(max_length=201)]


class SpreadEntry(Entry):
    """``[spread]``."""

    gaussian: Number | Pair | None = None
    defocus: Number | None = None
    motion: Number | None = None
    motion_deg: Number | None = None
    diffraction: Number | None = None
    along_x: Row | None = None
    along_y: Row | None = None
    kernel: Annotated[tuple[Row, ...], Field(max_length=201)] | None = None
    tail_share: Number | None = None
    tail_length: Number | None = None
    field_square: Number | None = None
    field_fourth: Number | None = None


class ApertureEntry(Entry):
    """``[aperture]``."""

    shape: Literal["square", "round", "point"] | None = None
    width: Number | Pair | None = None


class LateralEntry(Entry):
    """``[[lateral]]``."""

    band: Whole
    shift: Pair | None = None
    scale: Number | None = None
    cubic: Number | None = None


class FalloffEntry(Entry):
    """``[falloff]``."""

    focal: Number | None = None
    centre: Pair | None = None
    artificial: Number | None = None
    power: Number | None = None
    polynomial: Annotated[tuple[tuple[Whole, Whole, Number], ...], Field(max_length=66)] | None = None


class JitterEntry(Entry):
    """``[jitter]``."""

    sigma: Number | None = None
    field: Number | None = None
    amplitude: Number | None = None
    period: Number | None = None
    phase_deg: Number | None = None


class ExposureEntry(Entry):
    """``[exposure]``."""

    light: Number | None = None
    quantum_efficiency: Number | None = None
    seconds: Number | None = None


class DarkEntry(Entry):
    """``[dark]``."""

    rate: Number | None = None
    at_deg: Number | None = None
    doubling_deg: Number | None = None
    temperature_deg: Number | None = None
    spread: Number | None = None


class FixedPatternEntry(Entry):
    """``[fixed_pattern]``."""

    response: Number | None = None
    offset: Number | None = None
    column: Number | None = None
    row: Number | None = None


class DefectEntry(Entry):
    """``[[defects]]``."""

    column: Whole
    row: Whole
    kind: Literal["dead", "weak", "hot", "stuck"]
    value: Number | None = None


class WellEntry(Entry):
    """``[well]``."""

    capacity: Number
    drain: Number | None = None
    tailing: Number | None = None
    circular: Number | None = None
    circular_width: Number | None = None


class ReadoutEntry(Entry):
    """``[readout]``."""

    shot_noise: Flag | None = None
    smear: Number | None = None
    transfer_product: Number | None = None
    noise: Number | None = None


class GainEntry(Entry):
    """``[gain]``."""

    factor: Number | None = None
    offset: Number | None = None
    noise: Number | None = None


class AutomaticGainEntry(Entry):
    """``[automatic_gain]``."""

    target: Number
    frames: Number | None = None
    least: Number | None = None
    most: Number | None = None


class EnhancementEntry(Entry):
    """``[enhancement]``."""

    amount: Number
    width: Number | None = None
    direction: Literal["both", "x"] | None = None


class ToneEntry(Entry):
    """``[tone]``."""

    curve: Literal["gamma", "srgb", "table"] | None = None
    white: Number | None = None
    gamma: Number | None = None
    table: Annotated[tuple[Pair, ...], Field(max_length=65536)] | None = None


class QuantisationEntry(Entry):
    """``[quantisation]``."""

    bits: Whole | None = None


class SimulationFile(Entry):
    """A whole file; what is left out is None."""

    seed: Whole | None = None
    spread: SpreadEntry | None = None
    aperture: ApertureEntry | None = None
    lateral: Annotated[tuple[LateralEntry, ...], Field(max_length=64)] | None = None
    falloff: FalloffEntry | None = None
    jitter: JitterEntry | None = None
    exposure: ExposureEntry | None = None
    dark: DarkEntry | None = None
    fixed_pattern: FixedPatternEntry | None = None
    defects: Annotated[tuple[DefectEntry, ...], Field(max_length=100_000)] | None = None
    well: WellEntry | None = None
    readout: ReadoutEntry | None = None
    gain: GainEntry | None = None
    automatic_gain: AutomaticGainEntry | None = None
    enhancement: EnhancementEntry | None = None
    tone: ToneEntry | None = None
    quantisation: QuantisationEntry | None = None

    def stated(self) -> dict[str, Any]:
        """What the file states, as plain values; tables without an entry are empty."""
        return self.model_dump(exclude_none=True)


def read_simulation(path: Path) -> SimulationFile:
    """Description of an image formation model.

    Raises
    ------
    InputError
        The file cannot be read, or an entry is unknown or of a wrong type; the message names its line.
    """
    return read_entries(path, SimulationFile, _MAX_BYTES)

"""The description of a sensor in TOML; every entry is explained on the reference page of `photoplan sensor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, Strict, model_validator

from photoplan.errors import InputError
from photoplan.io.camera.model import Entry, Name, Number
from photoplan.io.plain_files import read_entries

_MAX_BYTES = 1_000_000
#: Nothing that is described is larger, or smaller than its reciprocal; it keeps every figure finite.
_LARGEST = 1e15

Amount = Annotated[float, Strict(), Field(ge=1 / _LARGEST, le=_LARGEST, allow_inf_nan=False)]
NotNegative = Annotated[float, Strict(), Field(ge=0, le=_LARGEST, allow_inf_nan=False)]
Count = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Share = Annotated[float, Strict(), Field(ge=1 / _LARGEST, le=1, allow_inf_nan=False)]
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
    described = read_entries(path, SensorDescription, _MAX_BYTES)
    if not described.model_fields_set - {"name", "stated"}:
        raise InputError(
            f"{path}: describes nothing; write at least one of the tables [viewing], [video], [sensor], [image], "
            "[transfer], [noise], [optics]"
        )
    return described

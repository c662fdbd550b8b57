"""What happens to charge and signal, as values: exposure, dark current, fixed pattern, wells, read-out, grey values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from photoplan.errors import InputError
from photoplan.quality.formation.optics_parts import Part, Within


@dataclass(frozen=True)
class Exposure(Part, name="exposure"):
    """From the scene's values to electrons: value × light × quantum_efficiency × exposure."""

    light: Annotated[float, Within(0.0, 1e12)] = 1.0
    """Photons (electrons, where quantum_efficiency is 1) for each unit of the scene at exposure 1."""
    quantum_efficiency: Annotated[float, Within(1e-6, 1.0)] = 1.0
    """Electrons for each photon."""
    seconds: Annotated[float, Within(0.0, 1e6)] = 1.0
    """Time at exposure 1: dark current gathers over exposure × seconds."""


@dataclass(frozen=True)
class DarkCurrentPart(Part, name="dark"):
    """Charge without light, which doubles with temperature (Behr 1989, section 3.6.4: about every 10 °C)."""

    rate: Annotated[float, Within(0.0, 1e9)] = 0.0
    """Electrons per second in each pixel at the temperature `at_deg`."""
    at_deg: Annotated[float, Within(-273.15, 500.0)] = 20.0
    """Celsius."""
    doubling_deg: Annotated[float, Within(0.1, 1000.0)] = 10.0
    """Degrees over which it doubles."""
    temperature_deg: Annotated[float, Within(-273.15, 500.0)] = 20.0
    """Of the sensor, Celsius."""
    spread: Annotated[float, Within(0.0, 5.0)] = 0.0
    """Relative standard deviation of the pixels' own rates: fixed pattern of dark frames."""

    @property
    def electrons_per_second(self) -> float:
        """Mean rate at the sensor's temperature."""
        return float(self.rate * 2.0 ** ((self.temperature_deg - self.at_deg) / self.doubling_deg))


@dataclass(frozen=True)
class FixedPattern(Part, name="fixed_pattern"):
    """Differences between pixels that are the same in all frames of one seed."""

    response: Annotated[float, Within(0.0, 0.5)] = 0.0
    """Relative standard deviation of the pixels' sensitivity (PRNU)."""
    offset: Annotated[float, Within(0.0, 1e6)] = 0.0
    """Standard deviation of the pixels' offsets, electrons (DSNU); independent of time."""
    column: Annotated[float, Within(0.0, 1e6)] = 0.0
    """Standard deviation of offsets of whole columns, electrons."""
    row: Annotated[float, Within(0.0, 1e6)] = 0.0
    """The same of rows."""


@dataclass(frozen=True)
class DefectPart(Part, name="defect"):
    """A sensor element that does not do as the others."""

    column: Annotated[int, Within(0)]
    """Counted from 0."""
    row: Annotated[int, Within(0)]
    """Counted from 0."""
    kind: Literal["dead", "weak", "hot", "stuck"]
    """`dead`: no charge by light. `weak`: `value` times the sensitivity. `hot`: `value` electrons per second more dark
    current. `stuck`: always `value` electrons."""
    value: Annotated[float, Within(0.0, 1e12)] = 0.0
    """See `kind`."""


@dataclass(frozen=True)
class Well(Part, name="well"):
    """How much charge an element holds and where the rest goes: blooming and tailing (Behr 1989, section 3.6.5).

    The excess over `capacity` is divided: `drain` disappears, `tailing` flows along the line towards higher columns,
    `circular` spreads around, the rest overflows along the column, half up and half down. What finds no room flows on;
    what reaches the border is lost.
    """

    capacity: Annotated[float, Within(1e-9, 1e12)]
    """Electrons that an element holds."""
    drain: Annotated[float, Within(0.0, 1.0)] = 0.0
    """Share that an anti-blooming drain takes away."""
    tailing: Annotated[float, Within(0.0, 1.0)] = 0.0
    """Share that flows along the line."""
    circular: Annotated[float, Within(0.0, 1.0)] = 0.0
    """Share that spreads through the substrate."""
    circular_width: Annotated[float, Within(0.3, 50.0)] = 2.0
    """Standard deviation of that spreading, pixels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drain + self.tailing + self.circular > 1.0 + 1e-12:
            raise InputError(
                f"well: drain, tailing and circular share {self.drain + self.tailing + self.circular:g} of the excess; "
                "at most 1 is allowed"
            )


@dataclass(frozen=True)
class Readout(Part, name="readout"):
    """What is added while charge is gathered, moved and read."""

    shot_noise: bool = False
    """Photons and dark current follow the Poisson distribution (Behr 1989, section 3.6.4)."""
    smear: Annotated[float, Within(0.0, 1.0)] = 0.0
    """Share of the mean of its column that every pixel receives while the frame is moved under light."""
    transfer_product: Annotated[float, Within(0.0, 10.0)] = 0.0
    """nε, transfer inefficiency product along the lines: modulation by Behr 1989, eq. 3.15."""
    noise: Annotated[float, Within(0.0, 1e9)] = 0.0
    """Standard deviation of the read noise, electrons."""


@dataclass(frozen=True)
class Gain(Part, name="gain"):
    """From electrons to grey values."""

    factor: Annotated[float, Within(1e-12, 1e12)] = 1.0
    """Grey values for each electron (system gain K of EMVA 1288)."""
    offset: Annotated[float, Within(-1e9, 1e9)] = 0.0
    """Grey value without charge (black level)."""
    noise: Annotated[float, Within(0.0, 1e9)] = 0.0
    """Standard deviation of noise that is added behind the amplifier, grey values."""


@dataclass(frozen=True)
class AutomaticGain(Part, name="automatic_gain"):
    """A gain that follows the brightness from frame to frame (Behr 1989, section 4.2.5)."""

    target: Annotated[float, Within(1e-9, 1e9)]
    """Mean grey value above the offset that it aims at."""
    frames: Annotated[float, Within(0.0, 1e6)] = 3.0
    """Frames after which 1 − 1/e of a step is made up for; 0: at once, from the frame after."""
    least: Annotated[float, Within(1e-6, 1.0)] = 0.25
    """Smallest gain, relative to the fixed one."""
    most: Annotated[float, Within(1.0, 1e6)] = 4.0
    """Largest gain."""


@dataclass(frozen=True)
class EnhancementPart(Part, name="enhancement"):
    """Edge enhancement inside the camera: amount × (signal − signal smoothed by a Gaussian) is added.

    It makes the over- and undershoot beside edges of which Kölbl (2006, section 4) says that they limit restoration.
    """

    amount: Annotated[float, Within(0.0, 20.0)]
    """0: none."""
    width: Annotated[float, Within(0.2, 20.0)] = 1.0
    """Standard deviation of the Gaussian, pixels."""
    direction: Literal["both", "x"] = "both"
    """`x`: along the lines only, as a video amplifier does."""


@dataclass(frozen=True)
class Tone(Part, name="tone"):
    """The curve from linear to stored grey values, on values divided by `white`; below 0 becomes 0."""

    curve: Literal["gamma", "srgb", "table"] = "gamma"
    """`gamma`: value^(1 / gamma); `srgb`: IEC 61966-2-1; `table`: linear between the points of `table`."""
    white: Annotated[float, Within(1e-9, 1e12)] = 255.0
    """Grey value that is 1; it stays as it is under `gamma` and `srgb`."""
    gamma: Annotated[float, Within(0.1, 10.0)] = 2.2
    """Exponent of `gamma`."""
    table: tuple[tuple[float, float], ...] = ()
    """Points (linear, stored) in grey values, both increasing; beyond the ends: the ends."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.curve == "table":
            rises = all(b[0] > a[0] and b[1] >= a[1] for a, b in zip(self.table, self.table[1:]))
            if len(self.table) < 2 or len(self.table) > 65536 or not rises:
                raise InputError(
                    f"tone: a table of {len(self.table)} points; needed are 2 to 65536 that increase in both columns"
                )


@dataclass(frozen=True)
class Quantisation(Part, name="quantisation"):
    """Rounding to whole grey values and clipping at both ends (Behr 1989, eq. 3.14: noise 1 / √12)."""

    bits: Annotated[int, Within(1, 16)] = 8
    """8: 0 to 255; 12: 0 to 4095; at most 16."""

    @property
    def most(self) -> int:
        """The largest grey value."""
        return int(2**self.bits - 1)

"""What happens to charge and signal, as values: exposure, dark current, fixed pattern, wells, read-out, grey values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from photoplan.errors import InputError
from photoplan.quality.formation.optics_parts import check_range


@dataclass(frozen=True)
class Exposure:
    """From the scene's values to electrons: value × light × quantum_efficiency × exposure."""

    light: float = 1.0
    """Photons (electrons, where quantum_efficiency is 1) for each unit of the scene at exposure 1."""
    quantum_efficiency: float = 1.0
    """Electrons for each photon."""
    seconds: float = 1.0
    """Time at exposure 1: dark current gathers over exposure × seconds."""

    def __post_init__(self) -> None:
        check_range("exposure", "light", self.light, 0.0, 1e12)
        check_range("exposure", "quantum_efficiency", self.quantum_efficiency, 1e-6, 1.0)
        check_range("exposure", "seconds", self.seconds, 0.0, 1e6)


@dataclass(frozen=True)
class DarkCurrentPart:
    """Charge without light, which doubles with temperature (Behr 1989, section 3.6.4: about every 10 °C)."""

    rate: float = 0.0
    """Electrons per second in each pixel at the temperature `at_deg`."""
    at_deg: float = 20.0
    """Celsius."""
    doubling_deg: float = 10.0
    """Degrees over which it doubles."""
    temperature_deg: float = 20.0
    """Of the sensor, Celsius."""
    spread: float = 0.0
    """Relative standard deviation of the pixels' own rates: fixed pattern of dark frames."""

    def __post_init__(self) -> None:
        check_range("dark", "rate", self.rate, 0.0, 1e9)
        check_range("dark", "doubling_deg", self.doubling_deg, 0.1, 1000.0)
        for name in ("at_deg", "temperature_deg"):
            check_range("dark", name, getattr(self, name), -273.15, 500.0)
        check_range("dark", "spread", self.spread, 0.0, 5.0)

    @property
    def electrons_per_second(self) -> float:
        """Mean rate at the sensor's temperature."""
        return float(self.rate * 2.0 ** ((self.temperature_deg - self.at_deg) / self.doubling_deg))


@dataclass(frozen=True)
class FixedPattern:
    """Differences between pixels that are the same in all frames of one seed."""

    response: float = 0.0
    """Relative standard deviation of the pixels' sensitivity (PRNU)."""
    offset: float = 0.0
    """Standard deviation of the pixels' offsets, electrons (DSNU); independent of time."""
    column: float = 0.0
    """Standard deviation of offsets of whole columns, electrons."""
    row: float = 0.0
    """The same of rows."""

    def __post_init__(self) -> None:
        check_range("fixed_pattern", "response", self.response, 0.0, 0.5)
        for name in ("offset", "column", "row"):
            check_range("fixed_pattern", name, getattr(self, name), 0.0, 1e6)


@dataclass(frozen=True)
class DefectPart:
    """A sensor element that does not do as the others."""

    column: int
    """Counted from 0."""
    row: int
    """Counted from 0."""
    kind: Literal["dead", "weak", "hot", "stuck"]
    """`dead`: no charge by light. `weak`: `value` times the sensitivity. `hot`: `value` electrons per second more dark
    current. `stuck`: always `value` electrons."""
    value: float = 0.0
    """See `kind`."""

    def __post_init__(self) -> None:
        if self.kind not in ("dead", "weak", "hot", "stuck"):
            raise InputError(f"defect: kind {self.kind!r}; allowed are dead, weak, hot and stuck")
        check_range("defect", "column", self.column, 0)
        check_range("defect", "row", self.row, 0)
        check_range("defect", "value", self.value, 0.0, 1e12)


@dataclass(frozen=True)
class Well:
    """How much charge an element holds and where the rest goes: blooming and tailing (Behr 1989, section 3.6.5).

    The excess over `capacity` is divided: `drain` disappears, `tailing` flows along the line towards higher columns,
    `circular` spreads around, the rest overflows along the column, half up and half down. What finds no room flows on;
    what reaches the border is lost.
    """

    capacity: float
    """Electrons that an element holds."""
    drain: float = 0.0
    """Share that an anti-blooming drain takes away."""
    tailing: float = 0.0
    """Share that flows along the line."""
    circular: float = 0.0
    """Share that spreads through the substrate."""
    circular_width: float = 2.0
    """Standard deviation of that spreading, pixels."""

    def __post_init__(self) -> None:
        check_range("well", "capacity", self.capacity, 1e-9, 1e12)
        for name in ("drain", "tailing", "circular"):
            check_range("well", name, getattr(self, name), 0.0, 1.0)
        check_range("well", "circular_width", self.circular_width, 0.3, 50.0)
        if self.drain + self.tailing + self.circular > 1.0 + 1e-12:
            raise InputError(
                f"well: drain, tailing and circular share {self.drain + self.tailing + self.circular:g} of the excess; "
                "at most 1 is allowed"
            )


@dataclass(frozen=True)
class Readout:
    """What is added while charge is gathered, moved and read."""

    shot_noise: bool = False
    """Photons and dark current follow the Poisson distribution (Behr 1989, section 3.6.4)."""
    smear: float = 0.0
    """Share of the mean of its column that every pixel receives while the frame is moved under light."""
    transfer_product: float = 0.0
    """nε, transfer inefficiency product along the lines: modulation by Behr 1989, eq. 3.15."""
    noise: float = 0.0
    """Standard deviation of the read noise, electrons."""

    def __post_init__(self) -> None:
        check_range("readout", "smear", self.smear, 0.0, 1.0)
        check_range("readout", "transfer_product", self.transfer_product, 0.0, 10.0)
        check_range("readout", "noise", self.noise, 0.0, 1e9)


@dataclass(frozen=True)
class Gain:
    """From electrons to grey values."""

    factor: float = 1.0
    """Grey values for each electron (system gain K of EMVA 1288)."""
    offset: float = 0.0
    """Grey value without charge (black level)."""
    noise: float = 0.0
    """Standard deviation of noise that is added behind the amplifier, grey values."""

    def __post_init__(self) -> None:
        check_range("gain", "factor", self.factor, 1e-12, 1e12)
        check_range("gain", "offset", self.offset, -1e9, 1e9)
        check_range("gain", "noise", self.noise, 0.0, 1e9)


@dataclass(frozen=True)
class AutomaticGain:
    """A gain that follows the brightness from frame to frame (Behr 1989, section 4.2.5)."""

    target: float
    """Mean grey value above the offset that it aims at."""
    frames: float = 3.0
    """Frames after which 1 − 1/e of a step is made up for; 0: at once, from the frame after."""
    least: float = 0.25
    """Smallest gain, relative to the fixed one."""
    most: float = 4.0
    """Largest gain."""

    def __post_init__(self) -> None:
        check_range("automatic_gain", "target", self.target, 1e-9, 1e9)
        check_range("automatic_gain", "frames", self.frames, 0.0, 1e6)
        check_range("automatic_gain", "least", self.least, 1e-6, 1.0)
        check_range("automatic_gain", "most", self.most, 1.0, 1e6)


@dataclass(frozen=True)
class EnhancementPart:
    """Edge enhancement inside the camera: amount × (signal − signal smoothed by a Gaussian) is added.

    It makes the over- and undershoot beside edges of which Kölbl (2006, section 4) says that they limit restoration.
    """

    amount: float
    """0: none."""
    width: float = 1.0
    """Standard deviation of the Gaussian, pixels."""
    direction: Literal["both", "x"] = "both"
    """`x`: along the lines only, as a video amplifier does."""

    def __post_init__(self) -> None:
        check_range("enhancement", "amount", self.amount, 0.0, 20.0)
        check_range("enhancement", "width", self.width, 0.2, 20.0)
        if self.direction not in ("both", "x"):
            raise InputError(f"enhancement: direction {self.direction!r}; allowed are both and x")


@dataclass(frozen=True)
class Tone:
    """The curve from linear to stored grey values, on values divided by `white`; below 0 becomes 0."""

    curve: Literal["gamma", "srgb", "table"] = "gamma"
    """`gamma`: value^(1 / gamma); `srgb`: IEC 61966-2-1; `table`: linear between the points of `table`."""
    white: float = 255.0
    """Grey value that is 1; it stays as it is under `gamma` and `srgb`."""
    gamma: float = 2.2
    """Exponent of `gamma`."""
    table: tuple[tuple[float, float], ...] = ()
    """Points (linear, stored) in grey values, both increasing; beyond the ends: the ends."""

    def __post_init__(self) -> None:
        if self.curve not in ("gamma", "srgb", "table"):
            raise InputError(f"tone: curve {self.curve!r}; allowed are gamma, srgb and table")
        check_range("tone", "white", self.white, 1e-9, 1e12)
        check_range("tone", "gamma", self.gamma, 0.1, 10.0)
        if self.curve == "table":
            rises = all(b[0] > a[0] and b[1] >= a[1] for a, b in zip(self.table, self.table[1:]))
            if len(self.table) < 2 or len(self.table) > 65536 or not rises:
                raise InputError(
                    f"tone: a table of {len(self.table)} points; needed are 2 to 65536 that increase in both columns"
                )


@dataclass(frozen=True)
class Quantisation:
    """Rounding to whole grey values and clipping at both ends (Behr 1989, eq. 3.14: noise 1 / √12)."""

    bits: int = 8
    """8: 0 to 255; 12: 0 to 4095; at most 16."""

    def __post_init__(self) -> None:
        check_range("quantisation", "bits", self.bits, 1, 16)
        if not isinstance(self.bits, int):
            raise InputError(f"quantisation: bits = {self.bits!r}; a whole number from 1 to 16 is needed")

    @property
    def most(self) -> int:
        """The largest grey value."""
        return int(2**self.bits - 1)

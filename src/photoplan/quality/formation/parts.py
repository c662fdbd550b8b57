"""The parts of the image formation model as values: what light meets, then what happens to charge and signal."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError

Radius = TypeVar("Radius", float, NDArray[np.float64])
#: Widths beyond this many pixels come from a wrong unit rather than from optics.
MOST_WIDTH_PX = 200.0


@dataclass(frozen=True)
class Within:
    """The range of a field's number, or of each number of a pair."""

    least: float
    most: float = inf

    def check(self, what: str, value: Any, whole: bool = False) -> None:
        """Refuse a number outside, or one that is not finite (or not whole), with an `InputError`."""
        if not isinstance(value, int if whole else int | float) or isinstance(value, bool) or not isfinite(value):
            raise InputError(f"{what} = {value!r}; it must be a {'whole' if whole else 'finite'} number")
        if not self.least <= value <= self.most:
            to = f"to {self.most:g}" if isfinite(self.most) else "or more"
            raise InputError(f"{what} = {value:g}; allowed is {self.least:g} {to}")


class FormationPart:
    """A part of a model: ranges and words that its fields' types state are checked when it is made (`InputError`)."""

    name: ClassVar[str]
    rules: ClassVar[tuple[tuple[str, Any, Within | None], ...]]
    """Fields that are checked: name, type, and range (None: one of the words of a literal)."""

    def __init_subclass__(cls, name: str) -> None:
        """What descriptions and messages call the part."""
        kinds = get_type_hints(cls, include_extras=True).items()
        rules = ((key, *(get_args(kind) if get_origin(kind) is Annotated else (kind, None))) for key, kind in kinds)
        cls.name, cls.rules = name, tuple(rule for rule in rules if rule[2] or get_origin(rule[1]) is Literal)

    def __post_init__(self) -> None:
        for key, kind, limits in self.rules:
            value = getattr(self, key)
            if limits is None:
                *words, last = get_args(kind)
                if value not in (*words, last):
                    raise InputError(f"{self.name}: {key} {value!r}; allowed are {', '.join(words)} and {last}")
            elif isinstance(value, tuple):
                for axis, number in zip("xy", value):
                    limits.check(f"{self.name}: {key} ({axis})", number)
            elif value is not None:
                limits.check(f"{self.name}: {key}", value, kind is int)


@dataclass(frozen=True)
class Spread(FormationPart, name="spread"):
    """Spread function before the pixel's aperture: the convolution of all of its parts; lengths in pixels.

    The light that it spreads is kept: every part has the sum 1, and what falls beyond the reach of a tail is shared out
    over the rest.
    """

    gaussian: Annotated[tuple[float, float], Within(0.0, MOST_WIDTH_PX / 4.0)] = (0.0, 0.0)
    """Standard deviations of a Gaussian along x and y."""
    defocus: Annotated[float, Within(0.0, MOST_WIDTH_PX)] = 0.0
    """Diameter of the disc of a defocused lens."""
    motion: Annotated[float, Within(0.0, MOST_WIDTH_PX)] = 0.0
    """Length of a straight, even motion during exposure."""
    motion_deg: Annotated[float, Within(-360.0, 360.0)] = 90.0
    """Its direction: 0 along x, 90 along y (downwards)."""
    diffraction: Annotated[float, Within(0.0, 20.0)] = 0.0
    """λ N / pitch, wavelength × f-number in pixels: the cut-off frequency is its inverse; circular pupil."""
    along_x: tuple[float, ...] = ()
    """Discrete spread function along x, shares at whole pixels (`SpreadFunction.values`); divided by their sum."""
    along_y: tuple[float, ...] = ()
    """The same along y."""
    kernel: tuple[tuple[float, ...], ...] = ()
    """Rows of a two-dimensional spread function at whole pixels; odd sides; divided by its sum."""
    tail_share: Annotated[float, Within(0.0, 0.9)] = 0.0
    """Share of the light that is stray light near the image: exp(−r / tail_length), rotationally symmetric."""
    tail_length: Annotated[float, Within(0.1, 50.0)] = 10.0
    """Length over which that falls to 1/e; its reach is eight times this."""
    field_square: Annotated[float, Within(-0.9, 10.0)] = 0.0
    """Growth over the field: all lengths times 1 + field_square ρ² + field_fourth ρ⁴, ρ = 1 in the image's corners."""
    field_fourth: Annotated[float, Within(-0.9, 10.0)] = 0.0
    """See `field_square`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(self.scale_at(k / 20.0) < 0.05 for k in range(21)):
            raise InputError("spread: field_square and field_fourth shrink the spread function to nothing in the field")
        for name in ("along_x", "along_y"):
            _check_shares(name, (getattr(self, name),) if getattr(self, name) else ())
        _check_shares("kernel", self.kernel)

    def scale_at(self, radius: Radius) -> Radius:
        """Factor of all lengths at a radius, or radii, in units of half the image's diagonal."""
        return 1.0 + self.field_square * radius**2 + self.field_fourth * radius**4

    @property
    def varies(self) -> bool:
        """Whether it depends on the place in the field."""
        return self.field_square != 0.0 or self.field_fourth != 0.0


def _check_shares(name: str, rows: tuple[tuple[float, ...], ...]) -> None:
    """A discrete spread function: odd sides of at most 201, finite, positive sum."""
    if not rows:
        return
    widths = {len(row) for row in rows}
    if len(widths) != 1 or any(n % 2 == 0 or n > 201 for n in (*widths, len(rows))):
        raise InputError(
            f"spread: {name} has {len(rows)} rows of {sorted(widths)} values; needed are odd numbers up to 201, all "
            "rows alike"
        )
    values = [value for row in rows for value in row]
    if not all(isfinite(value) for value in values) or sum(values) <= 0.0:
        raise InputError(f"spread: the values of {name} must be finite and their sum positive")


@dataclass(frozen=True)
class Lateral(FormationPart, name="lateral"):
    """Lateral chromatic aberration of one band: where its image lies against the object.

    With (u, v) from the image's middle and ρ = 1 in its corners the band lies at (u, v) (1 + scale + cubic ρ²) + shift.
    """

    band: Annotated[int, Within(1, 64)] = 1
    """Counted from 1."""
    shift: Annotated[tuple[float, float], Within(-50.0, 50.0)] = (0.0, 0.0)
    """Pixels along x and y."""
    scale: Annotated[float, Within(-0.05, 0.05)] = 0.0
    """Relative; 0.001 moves the point at 1000 px from the middle by 1 px."""
    cubic: Annotated[float, Within(-0.05, 0.05)] = 0.0
    """Relative, at the corners."""


@dataclass(frozen=True)
class Falloff(FormationPart, name="falloff"):
    """Fall of light to the image's border: the product of its parts (Behr 1989, section 4.2.1)."""

    focal: Annotated[float | None, Within(1.0, 1e7)] = None
    """Camera constant in pixels: cos⁴ of the angle off the axis; None: no natural fall-off."""
    centre: tuple[float, float] | None = None
    """Column and row of the axis; None: the image's middle."""
    artificial: Annotated[float, Within(-1.0, 1.0)] = 0.0
    """Share that vignetting takes away at ρ = 1, half the image's diagonal from the axis: 1 − artificial ρᵖ."""
    power: Annotated[float, Within(0.5, 20.0)] = 4.0
    """p of the artificial part."""
    polynomial: tuple[tuple[int, int, float], ...] = ()
    """Terms (i, j, a) of Σ a uⁱ vʲ, u and v from the axis in units of half the diagonal; empty: 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.polynomial) > 66:
            raise InputError(f"falloff: {len(self.polynomial)} terms of the polynomial; at most 66 are allowed")
        for i, j, value in self.polynomial:
            Within(0, 10).check("falloff: power of u", i)
            Within(0, 10).check("falloff: power of v", j)
            Within(-1e6, 1e6).check("falloff: coefficient", value)


@dataclass(frozen=True)
class Aperture(FormationPart, name="aperture"):
    """The light-sensitive area of a sensor element; its mean is the pixel's value (Ecker 1991, section 4.3.1)."""

    shape: Literal["square", "round", "point"] = "square"
    """`square` (or a rectangle), `round` (or an ellipse); `point` takes the value at the pixel's centre."""
    width: Annotated[tuple[float, float], Within(0.01, 20.0)] = (1.0, 1.0)
    """Sides or diameters along x and y in units of the distance of two pixels: below 1 with gaps, above 1 overlapping.

    The fill factor is their product (times π / 4 if round).
    """


@dataclass(frozen=True)
class LineJitterPart(FormationPart, name="jitter"):
    """Displacement of whole lines along x, as faulty line synchronisation makes it (Behr 1989, section 4.1.2).

    A positive one moves what the line shows to the right. Random displacements are new in every frame.
    """

    sigma: Annotated[float, Within(0.0, 20.0)] = 0.0
    """Standard deviation of independent displacements of the lines, pixels."""
    field: Annotated[float, Within(-20.0, 20.0)] = 0.0
    """Distance of the odd lines (1, 3, …) from the even lines (0, 2, …), pixels: half of it to either side."""
    amplitude: Annotated[float, Within(0.0, 20.0)] = 0.0
    """Amplitude of a periodic displacement, pixels."""
    period: Annotated[float, Within(2.0, 1e7)] = 120.0
    """Its period, lines."""
    phase_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    """Its phase at line 0: amplitude · sin(2π line / period + phase)."""


@dataclass(frozen=True)
class Exposure(FormationPart, name="exposure"):
    """From the scene's values to electrons: value × light × quantum_efficiency × exposure."""

    light: Annotated[float, Within(0.0, 1e12)] = 1.0
    """Photons (electrons, where quantum_efficiency is 1) for each unit of the scene at exposure 1."""
    quantum_efficiency: Annotated[float, Within(1e-6, 1.0)] = 1.0
    """Electrons for each photon."""
    seconds: Annotated[float, Within(0.0, 1e6)] = 1.0
    """Time at exposure 1: dark current gathers over exposure × seconds."""


@dataclass(frozen=True)
class DarkCurrentPart(FormationPart, name="dark"):
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
class FixedPattern(FormationPart, name="fixed_pattern"):
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
class DefectPart(FormationPart, name="defect"):
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
class Well(FormationPart, name="well"):
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
class Readout(FormationPart, name="readout"):
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
class Gain(FormationPart, name="gain"):
    """From electrons to grey values."""

    factor: Annotated[float, Within(1e-12, 1e12)] = 1.0
    """Grey values for each electron (system gain K of EMVA 1288)."""
    offset: Annotated[float, Within(-1e9, 1e9)] = 0.0
    """Grey value without charge (black level)."""
    noise: Annotated[float, Within(0.0, 1e9)] = 0.0
    """Standard deviation of noise that is added behind the amplifier, grey values."""


@dataclass(frozen=True)
class AutomaticGain(FormationPart, name="automatic_gain"):
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
class EnhancementPart(FormationPart, name="enhancement"):
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
class ToneCurve(FormationPart, name="tone"):
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
class Quantisation(FormationPart, name="quantisation"):
    """Rounding to whole grey values and clipping at both ends (Behr 1989, eq. 3.14: noise 1 / √12)."""

    bits: Annotated[int, Within(1, 16)] = 8
    """8: 0 to 255; 12: 0 to 4095; at most 16."""

    @property
    def most(self) -> int:
        """The largest grey value."""
        return int(2**self.bits - 1)

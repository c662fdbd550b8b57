"""Optics of the image formation model: its parts, spread functions, and the light on every pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from math import ceil, cos, inf, isfinite, pi, radians, sin
from threading import Lock
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, signal

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.quality.curves import disc_transfer, pupil_transfer
from photoplan.quality.formation.scenes import LightScene, disc_share

Radius = TypeVar("Radius", float, Floats)
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


_Transfer = Callable[[Floats, Floats], NDArray[Any]]
#: Modulation that counts as none.
_NOTHING = 1e-4
#: Repetitions of the spectrum to each side that are added: a kernel of cells is a sampled function.
_ALIASES = 3
#: Kernels of more cells than this to a side are refused.
MOST_CELLS = 6000
#: Lengths of an exponential tail after which it ends: 0.3 % of its light lies beyond.
_TAIL_REACH = 8.0
#: The Airy pattern falls slowly; at this multiple of λN its rings hold 0.5 % of the light.
_AIRY_REACH = 40.0


def _sinc(x: Floats) -> Floats:
    return np.asarray(np.sinc(x))


def _smooth_transfer(spread: Spread, fx: Floats, fy: Floats, scale: float) -> Floats:
    """Transfer function of the parts that are functions of continuous place, without the tail; cycles per pixel."""
    sx, sy = (sigma * scale for sigma in spread.gaussian)
    result = np.exp(-2.0 * pi**2 * ((sx * fx) ** 2 + (sy * fy) ** 2))
    f = np.hypot(fx, fy)
    if spread.defocus:
        result = result * disc_transfer(spread.defocus * scale / 2.0, f)
    if spread.motion:
        along = radians(spread.motion_deg)
        result = result * _sinc(spread.motion * scale * (cos(along) * fx + sin(along) * fy))
    if spread.diffraction:
        result = result * pupil_transfer(spread.diffraction * scale * f)
    return np.asarray(result)


def _tail_transfer(spread: Spread, fx: Floats, fy: Floats, scale: float) -> Floats:
    """Transfer function of exp(−r / L) / (2π L²)."""
    length = spread.tail_length * scale
    return np.asarray((1.0 + (2.0 * pi * length) ** 2 * (fx**2 + fy**2)) ** -1.5)


def spread_transfer(spread: Spread, fx: Floats, fy: Floats, scale: float = 1.0) -> NDArray[np.complex128]:
    """Optical transfer function of a spread function, without the pixel's aperture."""
    result = _smooth_transfer(spread, fx, fy, scale).astype(complex)
    for values, f in ((spread.along_x, fx), (spread.along_y, fy)):
        if values:
            offsets = np.arange(len(values)) - len(values) // 2
            shares = np.array(values) / sum(values)
            result *= np.exp(-2j * pi * scale * np.multiply.outer(f, offsets)) @ shares
    if spread.kernel:
        kernel = np.array(spread.kernel) / np.sum(spread.kernel)
        rows, columns = (np.arange(n) - n // 2 for n in kernel.shape)
        down = np.exp(-2j * pi * scale * np.multiply.outer(fy, rows))
        across = np.exp(-2j * pi * scale * np.multiply.outer(fx, columns))
        result *= np.einsum("...r,rc,...c->...", down, kernel, across)
    if spread.tail_share:
        result *= 1.0 - spread.tail_share + spread.tail_share * _tail_transfer(spread, fx, fy, scale)
    return result


def aperture_transfer(aperture: Aperture, fx: Floats, fy: Floats) -> Floats:
    """Transfer function of a pixel's aperture at frequencies in cycles per pixel."""
    wx, wy = aperture.width
    if aperture.shape == "square":
        return _sinc(fx * wx) * _sinc(fy * wy)
    if aperture.shape == "round":
        return disc_transfer(0.5, np.hypot(fx * wx, fy * wy))
    return np.ones(np.broadcast_shapes(np.shape(fx), np.shape(fy)))


def _reach(spread: Spread, scale: float) -> float:
    """Pixels to each side beyond which the smooth parts without tail hold nothing of note."""
    reach = 6.0 * max(spread.gaussian) + spread.defocus / 2.0 + spread.motion / 2.0
    return float(scale * (reach + _AIRY_REACH * spread.diffraction))


def _is_smooth(transfer: _Transfer, cells: int) -> bool:
    """Whether next to nothing passes above half the frequency of the cells: values at the cells then say it all."""
    f = np.linspace(cells / 2.0, 1.5 * cells, 21)
    highest = max(np.abs(transfer(f, 0.0 * f)).max(), np.abs(transfer(0.0 * f, f)).max())
    return bool(highest < _NOTHING)


def _of_smooth(transfer: _Transfer, cells: int, reach: float) -> Floats:
    """Kernel on cells of a transfer function that is smooth; odd sides, sum 1."""
    half, base = _grid(cells, reach)
    fx, fy = np.meshgrid(np.abs(base[: 2 * half + 1]), base)
    return _cut(transfer(fx, fy), half)


def _of_squares(transfer: _Transfer, cells: int, reach: float) -> Floats:
    """Kernel between even cells: the light that the mean of a cell receives from another, for each offset.

    It is the spread function convolved with a cell twice and sampled once per cell; in frequencies: times sinc², and
    repeated.
    """
    half, base = _grid(cells, reach)
    fx, fy = np.meshgrid(np.abs(base[: 2 * half + 1]), base)
    spectrum = np.zeros(fx.shape, complex)
    for across in range(-_ALIASES, _ALIASES + 1):
        for down in range(-_ALIASES, _ALIASES + 1):
            x, y = fx + across * cells, fy + down * cells
            spectrum += transfer(x, y) * (_sinc(x / cells) * _sinc(y / cells)) ** 2
    return _cut(spectrum, half)


def _grid(cells: int, reach: float) -> tuple[int, Floats]:
    """Half a kernel's side in cells, and frequencies of a grid twice as wide: nothing returns from its other side."""
    half = max(1, ceil(reach * cells) + 1)
    if 2 * half + 1 > MOST_CELLS:
        raise InputError(
            f"spread: a kernel of {2 * half + 1} cells to a side (reach {reach:.0f} pixels × {cells} cells); at most "
            f"{MOST_CELLS} are allowed: choose a lower oversampling"
        )
    return half, np.asarray(np.fft.fftfreq(4 * half) * cells, np.float64)


def _cut(spectrum: NDArray[Any], half: int) -> Floats:
    n = 4 * half
    kernel = np.fft.fftshift(np.fft.irfft2(spectrum, (n, n)))[half : 3 * half + 1, half : 3 * half + 1]
    return np.asarray(kernel / kernel.sum())


def _spaced(values: Floats, spacing: float) -> Floats:
    """Values at whole pixels put on cells `spacing` apart, each divided between the two cells beside its place."""
    half = values.size // 2
    middle = ceil(half * spacing) + 1
    out = np.zeros(2 * middle + 1)
    place = middle + (np.arange(values.size, dtype=float) - half) * spacing
    low = np.floor(place + 1e-9).astype(int)
    part = np.maximum(place - low, 0.0)
    np.add.at(out, low, values * (1.0 - part))
    np.add.at(out, low + 1, values * part)
    return out


def _discrete(spread: Spread, spacing: float) -> Floats:
    """The discrete parts on cells, shape of odd sides; [[1]] if there are none."""
    result = np.ones((1, 1))
    if spread.along_x:
        result = result * _spaced(np.array(spread.along_x), spacing)[None, :]
    if spread.along_y:
        result = result * _spaced(np.array(spread.along_y), spacing)[:, None]
    if spread.kernel:
        rows = np.stack([_spaced(np.array(row), spacing) for row in spread.kernel])
        result = signal.convolve(result, np.stack([_spaced(column, spacing) for column in rows.T], 1))
    return np.asarray(result / result.sum())


@dataclass(frozen=True, eq=False)
class PixelKernel:
    """How cells become the values of pixels: they are spread, then summed with weights."""

    spread: Floats
    """Kernel with odd sides, sum 1."""
    weights: Floats
    """Weights of the cells of a pixel, sum 1."""
    row: int
    """Cell of ``weights[0, 0]``, counted from the first cell of the pixel; negative for wide apertures."""
    column: int
    """The same along x."""


@lru_cache(maxsize=256)
def pixel_kernel(spread: Spread, aperture: Aperture, scale: float, cells: int, continuous: bool) -> PixelKernel:
    """Kernel of spread function and aperture on the cells of a scene.

    Where the cells are means of a continuous scene and the spread function is smooth against them, both are one kernel
    that also undoes the averaging over the cells: the pixels' values are those of the continuous scene. Elsewhere cells
    that the aperture cuts are taken as even.
    """

    def smooth(fx: Floats, fy: Floats) -> NDArray[Any]:
        return _smooth_transfer(spread, fx, fy, scale)

    def tail(fx: Floats, fy: Floats) -> NDArray[Any]:
        return _tail_transfer(spread, fx, fy, scale)

    def with_aperture(fx: Floats, fy: Floats) -> NDArray[Any]:
        # The middle of a pixel lies between cells where their number is even.
        turn = np.exp(-1j * np.pi * (fx + fy) / cells) if cells % 2 == 0 else 1.0
        averaging = _sinc(np.clip(fx / cells, -0.5, 0.5)) * _sinc(np.clip(fy / cells, -0.5, 0.5))
        return np.asarray(smooth(fx, fy) * aperture_transfer(aperture, fx, fy) * turn / averaging)

    kernel, reach = _discrete(spread, scale * cells), _reach(spread, scale)
    weights, row, column = _aperture_weights(aperture, cells)
    if reach > 0.0 and continuous and _is_smooth(smooth, cells):
        wide = reach + max(aperture.width) + 1.0
        kernel = signal.convolve(kernel, _of_smooth(with_aperture, cells, wide))
        weights, row, column = np.ones((1, 1)), cells // 2, cells // 2
    elif reach > 0.0:
        kernel = signal.convolve(kernel, _of_squares(smooth, cells, reach))
    if spread.tail_share:
        reach = _TAIL_REACH * spread.tail_length * scale
        make = _of_smooth if continuous and _is_smooth(tail, cells) else _of_squares
        wings = make(tail, cells, reach) * spread.tail_share
        wings[wings.shape[0] // 2, wings.shape[1] // 2] += 1.0 - spread.tail_share
        kernel = signal.convolve(kernel, wings)
    return PixelKernel(_trimmed(kernel), weights, row, column)


def _trimmed(kernel: Floats) -> Floats:
    """Without borders that hold nothing, and with the sum 1."""
    for axis in (0, 1):
        lines = np.abs(kernel).sum(1 - axis)
        half = lines.size // 2
        outside = np.cumsum(lines[:half] + lines[:half:-1])
        cut = int(np.searchsorted(outside, 1e-10 * lines.sum()))
        kernel = kernel[cut : lines.size - cut] if axis == 0 else kernel[:, cut : lines.size - cut]
    return kernel / kernel.sum()


@lru_cache(maxsize=64)
def _aperture_weights(aperture: Aperture, cells: int) -> tuple[Floats, int, int]:
    """Shares of the cells in a pixel's value, and the cell of the first weight."""
    (wx, wy), middle = aperture.width, cells / 2.0
    if aperture.shape == "point":
        wx = wy = 0.0
    first = [int(np.floor(middle - w * cells / 2.0 + 1e-9)) for w in (wx, wy)]
    last = [max(f, int(np.ceil(middle + w * cells / 2.0 - 1e-9)) - 1) for f, w in zip(first, (wx, wy))]
    if aperture.shape == "point" and cells % 2 == 0:
        first = [cells // 2 - 1] * 2
        last = [cells // 2] * 2
    x, y = (np.arange(f, e + 1, dtype=np.float64) + 0.5 - middle for f, e in zip(first, last))
    if aperture.shape == "square":
        inside = [
            np.clip(np.minimum(v + 0.5, w * cells / 2.0) - np.maximum(v - 0.5, -w * cells / 2.0), 0.0, 1.0)
            for v, w in ((x, wx), (y, wy))
        ]
        weights = np.multiply.outer(inside[1], inside[0])
    elif aperture.shape == "round":
        weights = _ellipse(x, y, (wx * cells / 2.0, wy * cells / 2.0))
    else:
        weights = np.ones((y.size, x.size))
    weights = weights / weights.sum()
    weights.setflags(write=False)
    return weights, first[1], first[0]


def _ellipse(x: NDArray[Any], y: NDArray[Any], radii: tuple[float, float]) -> Floats:
    """Share of cells of side 1 that an ellipse covers; by parts of cells where it is no circle."""
    rx, ry = radii
    if rx == ry:
        return disc_share(x[None, :], y[:, None], 1.0, rx)
    parts = (np.arange(32) + 0.5) / 32.0 - 0.5
    fine_x = (x[:, None] + parts).ravel() / rx
    fine_y = (y[:, None] + parts).ravel() / ry
    inside = (fine_x[None, :] ** 2 + fine_y[:, None] ** 2 <= 1.0).astype(float)
    return np.asarray(inside.reshape(y.size, 32, x.size, 32).mean((1, 3)))


_Spectrum = NDArray[np.complex128]
#: Cells of a tile's side, without the margin of the spread function.
_TILE_CELLS = 1400
#: The least where the spread function varies: a small tile needs few of its scales, but is mostly margin.
_SMALL_TILE_CELLS = 350
#: Bytes of the transforms of kernels that are kept; one is kept in any case.
_KEPT_BYTES = 256 << 20
#: Ratio of neighbouring scales of a spread function that grows over the field; between them is interpolated.
_SCALE_STEP = 1.03
#: Cells around a tile that interpolation between cells may use.
_SPLINE_MARGIN = 20


@dataclass(frozen=True)
class Optics:
    """The parts of the model that decide how a scene is sampled."""

    spread: Spread
    aperture: Aperture
    lateral: tuple[Lateral, ...] = ()


def falloff_factors(falloff: Falloff, size: tuple[int, int], rows: slice | None = None) -> Floats:
    """Light of every pixel relative to the axis, shape (height, width); at least 0."""
    width, height = size
    cx, cy = falloff.centre if falloff.centre is not None else ((width - 1) / 2.0, (height - 1) / 2.0)
    half = np.hypot(width, height) / 2.0
    u = ((np.arange(width) - cx) / half)[None, :]
    v = ((np.arange(height) - cy) / half)[rows or slice(None), None]
    square = u**2 + v**2
    factors = np.ones(np.broadcast_shapes(u.shape, v.shape))
    if falloff.focal is not None:
        # cos α = f / √(f² + r²)
        factors *= (1.0 + square * (half / falloff.focal) ** 2) ** -2.0
    if falloff.artificial:
        factors *= 1.0 - falloff.artificial * square ** (falloff.power / 2.0)
    if falloff.polynomial:
        factors *= sum(a * u**i * v**j for i, j, a in falloff.polynomial)
    return np.maximum(factors, 0.0)


def line_displacements(jitter: LineJitterPart, lines: int, rng: np.random.Generator) -> Floats:
    """By how many pixels each line of a frame is moved to the right, shape (lines,)."""
    line = np.arange(lines)
    moved = jitter.amplitude * np.sin(2.0 * np.pi * line / jitter.period + np.radians(jitter.phase_deg))
    moved += np.where(line % 2 == 1, 0.5, -0.5) * jitter.field
    if jitter.sigma:
        moved += rng.normal(0.0, jitter.sigma, lines)
    return np.asarray(moved)


@dataclass(frozen=True, eq=False)
class Light:
    """Mean light on every pixel's aperture, in the units of the scene: computed tile by tile, in any order."""

    scene: LightScene
    optics: Optics
    falloff: Falloff = field(default_factory=Falloff)
    moved: Floats | None = None
    """By how many pixels each line shows the scene further right, shape (height,); None: not at all."""
    _transforms: _Transforms = field(default_factory=lambda: _Transforms(), repr=False)

    @property
    def tiles(self) -> list[Window]:
        """The tiles, from the middle outwards: those with the same scales of the spread function follow each other."""
        width, height = self.scene.size
        tiles = Window(0, 0, width, height).tiles(_tile_side(self.scene, self.optics))
        return sorted(tiles, key=lambda t: np.hypot(2 * t.col + t.width - width, 2 * t.row + t.height - height))

    def __call__(self, tile: Window) -> Floats:
        """Light on a tile, shape (bands, height, width); may be called from several threads."""
        rows = slice(tile.row, tile.stop[1])
        moved = None if self.moved is None else self.moved[rows]
        found = _tile(self.scene, self.optics, tile, moved, self._transforms)
        if self.falloff != Falloff():
            found *= falloff_factors(self.falloff, self.scene.size, rows)[:, tile.col : tile.stop[0]]
        return found

    def whole(self, known: Iterable[Floats] | None = None) -> Floats:
        """All tiles in their places, shape (bands, height, width); those of `tiles` that are known, or computed now."""
        width, height = self.scene.size
        out = np.empty((self.scene.bands, height, width))
        for tile, values in zip(self.tiles, map(self, self.tiles) if known is None else known):
            out[:, tile.row : tile.stop[1], tile.col : tile.stop[0]] = values
        return out


def _tile_side(scene: LightScene, optics: Optics) -> int:
    """Pixels of a tile's side."""
    k, cells = scene.oversampling, _TILE_CELLS
    if optics.spread.varies:
        ends = (Window(0, 0, 1, 1), Window(scene.size[0] // 2, scene.size[1] // 2, 1, 1))
        widest = max(_levels(optics.spread, scene.size, end)[-1] for end in ends)
        kernel = pixel_kernel(optics.spread, optics.aperture, widest, k, scene.continuous)
        cells = min(cells, max(_SMALL_TILE_CELLS, *kernel.spread.shape))
    return max(16, cells // k)


@dataclass(frozen=True)
class _Transforms:
    """Fourier transforms of kernels; those that fit into a bound of memory are kept."""

    kept: dict[tuple[PixelKernel, tuple[int, int]], _Spectrum] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    def of(self, kernel: PixelKernel, shape: tuple[int, int]) -> _Spectrum:
        """Transform of a kernel; the convolution holds a pixel's value at the first cell of the pixel."""
        with self.lock:
            known = self.kept.get((kernel, shape))
        return self._made(kernel, shape) if known is None else known

    def _made(self, kernel: PixelKernel, shape: tuple[int, int]) -> _Spectrum:
        cells = np.zeros(shape)
        rows, columns = kernel.spread.shape
        cells[:rows, :columns] = kernel.spread
        made = fft.rfft2(np.roll(cells, (-(rows // 2) - kernel.row, -(columns // 2) - kernel.column), (0, 1)))
        if kernel.weights.size > 1:
            made *= np.conj(fft.rfft2(kernel.weights, shape))
        with self.lock:
            while self.kept and sum(each.nbytes for each in self.kept.values()) + made.nbytes > _KEPT_BYTES:
                del self.kept[next(iter(self.kept))]
            self.kept[kernel, shape] = made
        return np.asarray(made)


def _displacement(
    lateral: tuple[Lateral, ...], band: int, size: tuple[int, int], tile: Window, moved: Floats | None
) -> tuple[Floats, Floats] | None:
    """Where a band's pixels take their light: distances (dx, dy) of that place from the pixel; None: none at all."""
    mine = [each for each in lateral if each.band == band + 1]
    if not mine and moved is None:
        return None
    u, v = _from_middle(size, tile)
    dx, dy = np.zeros((tile.height, tile.width)), np.zeros((tile.height, tile.width))
    if moved is not None:
        dx -= moved[:, None]
    corner = (np.hypot(*size) / 2.0) ** 2
    for each in mine:
        # The place that the optics brings to a pixel, by iterating the displacement (it contracts by its scale).
        px, py = u + dx, v + dy
        for _ in range(4):
            factor = each.scale + each.cubic * ((u + dx) ** 2 + (v + dy) ** 2) / corner
            dx = px - u - (u + dx) * factor - each.shift[0]
            dy = py - v - (v + dy) * factor - each.shift[1]
    return dx, dy


def _tile(scene: LightScene, optics: Optics, tile: Window, moved: Floats | None, transforms: _Transforms) -> Floats:
    """Light on the pixels of a tile, shape (bands, height, width)."""
    k = scene.oversampling
    moves = [_displacement(optics.lateral, b, scene.size, tile, moved) for b in range(scene.bands)]
    far = max((float(np.abs(d).max()) for m in moves if m is not None for d in m), default=0.0)
    extra = ceil(far) + -(-_SPLINE_MARGIN // k) if any(m is not None for m in moves) else 0
    levels = _levels(optics.spread, scene.size, tile)
    kernels = [pixel_kernel(optics.spread, optics.aperture, scale, k, scene.continuous) for scale in levels]
    shares = [_level_share(optics.spread, levels, index, scene.size, tile) for index in range(len(levels))]
    reach = max(
        max(each.spread.shape) // 2 + max(each.weights.shape) + max(-each.row, -each.column, 0) for each in kernels
    )
    margin = extra + -(-reach // k)
    window = Window(tile.col - margin, tile.row - margin, tile.width + 2 * margin, tile.height + 2 * margin)
    cells = scene.cells(window)
    light = np.zeros((scene.bands, tile.height, tile.width))
    for band, move in enumerate(moves):
        used = [(kernel, share) for kernel, share in zip(kernels, shares) if share.any()]
        means = _means(cells[band], [kernel for kernel, _ in used], transforms, k, k if move is None else 1)
        for (_, share), values in zip(used, means):
            light[band] += share * _at_pixels(values, margin, k, (tile.height, tile.width), move)
    return light


def _means(cells: Floats, kernels: list[PixelKernel], transforms: _Transforms, k: int, step: int) -> Iterator[Floats]:
    """For each kernel the values of pixels that begin at the cells, or at every `step`-th cell.

    The margin of the cells is wider than the kernels: what a periodic convolution brings from the other side stays
    there.
    """
    # Whole pixels, of a number whose transform is quick.
    rows, columns = (k * fft.next_fast_len(n // k, real=True) for n in cells.shape)
    shape = rows, columns
    spectrum: _Spectrum | None = None
    for kernel in kernels:
        if _is_direct(kernel):
            yield _convolved(cells, kernel)[::step, ::step]
            continue
        spectrum = fft.rfft2(cells, shape) if spectrum is None else spectrum
        # To take every step-th row is to add the parts of the spectrum that fall on each other.
        parts = (step, shape[0] // step, -1)
        folded = np.einsum("kij,kij->ij", spectrum.reshape(parts), transforms.of(kernel, shape).reshape(parts)) / step
        yield fft.irfft(fft.ifft(folded, axis=0), shape[1], axis=1)[:, ::step]


def _is_direct(kernel: PixelKernel) -> bool:
    """Whether a convolution without Fourier transforms is quick."""
    weights = kernel.weights
    separable = np.allclose(weights, np.multiply.outer(weights.sum(1), weights.sum(0)), rtol=0.0, atol=1e-15)
    return kernel.spread.size <= 9 and separable


def _convolved(cells: Floats, kernel: PixelKernel) -> Floats:
    """Values of pixels that begin at the cells, for a small kernel and weights that are a product."""
    if kernel.spread.size > 1:
        cells = ndimage.convolve(cells, kernel.spread)
    for axis, first in enumerate((kernel.row, kernel.column)):
        weights = kernel.weights.sum(1 - axis)
        if weights.size > 1:
            cells = ndimage.correlate1d(cells, weights, axis=axis, origin=-(weights.size // 2))
        cells = np.roll(cells, -first, axis)
    return cells


def _at_pixels(
    means: Floats, margin: int, k: int, shape: tuple[int, int], move: tuple[Floats, Floats] | None
) -> Floats:
    """Values at the pixels of a tile: chosen from one for each pixel, or from one for each cell by cubic splines."""
    height, width = shape
    if move is None:
        return means[margin : margin + height, margin : margin + width]
    dx, dy = move
    rows = (margin + np.arange(height)[:, None] + dy) * k
    columns = (margin + np.arange(width)[None, :] + dx) * k
    return np.asarray(ndimage.map_coordinates(means, [rows, columns], order=3, mode="nearest"))


def _levels(spread: Spread, size: tuple[int, int], tile: Window) -> list[float]:
    """Scales of the spread function that a tile needs: steps of a common ladder."""
    if not spread.varies:
        return [1.0]
    scales = _scales(spread, size, tile)
    first = int(np.floor(np.log(scales.min()) / np.log(_SCALE_STEP) + 1e-9))
    last = int(np.ceil(np.log(scales.max()) / np.log(_SCALE_STEP) - 1e-9))
    return [float(_SCALE_STEP**step) for step in range(first, max(last, first) + 1)]


def _scales(spread: Spread, size: tuple[int, int], tile: Window) -> Floats:
    """Scale of the spread function at the pixels of a tile."""
    u, v = _from_middle(size, tile)
    return np.asarray(spread.scale_at(np.hypot(u, v) / (np.hypot(*size) / 2.0)))


def _from_middle(size: tuple[int, int], tile: Window) -> tuple[Floats, Floats]:
    """Columns and rows of a tile's pixels from the image's middle; they broadcast."""
    y, x = np.ogrid[tile.row : tile.stop[1], tile.col : tile.stop[0]]
    return x - (size[0] - 1) / 2.0, y - (size[1] - 1) / 2.0


def _level_share(spread: Spread, levels: list[float], index: int, size: tuple[int, int], tile: Window) -> Floats:
    """Share of one scale in each pixel: linear in the square of the scale between neighbouring levels."""
    if len(levels) == 1:
        return np.ones((tile.height, tile.width))
    squares = np.array(levels) ** 2
    unit = np.zeros(len(levels))
    unit[index] = 1.0
    return np.asarray(np.interp(_scales(spread, size, tile) ** 2, squares, unit))

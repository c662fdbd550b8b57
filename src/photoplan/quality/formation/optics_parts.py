"""What light meets before it becomes charge, as values: spread, lateral colour, fall-off, aperture, line jitter."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Literal

from photoplan.errors import InputError

#: Widths beyond this many pixels come from a wrong unit rather than from optics.
MOST_WIDTH_PX = 200.0


def check_range(part: str, name: str, value: float, least: float, most: float = float("inf")) -> None:
    """Refuse a number of a part outside its range, or one that is not finite, with an `InputError`."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not isfinite(value):
        raise InputError(f"{part}: {name} = {value!r}; it must be a finite number")
    if not least <= value <= most:
        to = f"to {most:g}" if isfinite(most) else "or more"
        raise InputError(f"{part}: {name} = {value:g}; allowed is {least:g} {to}")


@dataclass(frozen=True)
class Spread:
    """Spread function before the pixel's aperture: the convolution of all of its parts; lengths in pixels.

    The light that it spreads is kept: every part has the sum 1, and what falls beyond the reach of a tail is shared out
    over the rest.
    """

    gaussian: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of a Gaussian along x and y."""
    defocus: float = 0.0
    """Diameter of the disc of a defocused lens."""
    motion: float = 0.0
    """Length of a straight, even motion during exposure."""
    motion_deg: float = 90.0
    """Its direction: 0 along x, 90 along y (downwards)."""
    diffraction: float = 0.0
    """λ N / pitch, wavelength × f-number in pixels: the cut-off frequency is its inverse; circular pupil."""
    along_x: tuple[float, ...] = ()
    """Discrete spread function along x, shares at whole pixels (`SpreadFunction.values`); divided by their sum."""
    along_y: tuple[float, ...] = ()
    """The same along y."""
    kernel: tuple[tuple[float, ...], ...] = ()
    """Rows of a two-dimensional spread function at whole pixels; odd sides; divided by its sum."""
    tail_share: float = 0.0
    """Share of the light that is stray light near the image: exp(−r / tail_length), rotationally symmetric."""
    tail_length: float = 10.0
    """Length over which that falls to 1/e; its reach is eight times this."""
    field_square: float = 0.0
    """Growth over the field: all lengths times 1 + field_square ρ² + field_fourth ρ⁴, ρ = 1 in the image's corners."""
    field_fourth: float = 0.0
    """See `field_square`."""

    def __post_init__(self) -> None:
        for axis, sigma in zip("xy", self.gaussian):
            check_range("spread", f"gaussian ({axis})", sigma, 0.0, MOST_WIDTH_PX / 4.0)
        for name in ("defocus", "motion"):
            check_range("spread", name, getattr(self, name), 0.0, MOST_WIDTH_PX)
        check_range("spread", "motion_deg", self.motion_deg, -360.0, 360.0)
        check_range("spread", "diffraction", self.diffraction, 0.0, 20.0)
        check_range("spread", "tail_share", self.tail_share, 0.0, 0.9)
        check_range("spread", "tail_length", self.tail_length, 0.1, 50.0)
        for name in ("field_square", "field_fourth"):
            check_range("spread", name, getattr(self, name), -0.9, 10.0)
        if any(self.scale_at(k / 20.0) < 0.05 for k in range(21)):
            raise InputError("spread: field_square and field_fourth shrink the spread function to nothing in the field")
        for name in ("along_x", "along_y"):
            _check_shares(name, (getattr(self, name),) if getattr(self, name) else ())
        _check_shares("kernel", self.kernel)

    def scale_at(self, radius: float) -> float:
        """Factor of all lengths at a radius in units of half the image's diagonal."""
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
class Lateral:
    """Lateral chromatic aberration of one band: where its image lies against the object.

    With (u, v) from the image's middle and ρ = 1 in its corners the band lies at (u, v) (1 + scale + cubic ρ²) + shift.
    """

    band: int = 1
    """Counted from 1."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Pixels along x and y."""
    scale: float = 0.0
    """Relative; 0.001 moves the point at 1000 px from the middle by 1 px."""
    cubic: float = 0.0
    """Relative, at the corners."""

    def __post_init__(self) -> None:
        check_range("lateral", "band", self.band, 1, 64)
        for axis, value in zip("xy", self.shift):
            check_range("lateral", f"shift ({axis})", value, -50.0, 50.0)
        check_range("lateral", "scale", self.scale, -0.05, 0.05)
        check_range("lateral", "cubic", self.cubic, -0.05, 0.05)


@dataclass(frozen=True)
class Falloff:
    """Fall of light to the image's border: the product of its parts (Behr 1989, section 4.2.1)."""

    focal: float | None = None
    """Camera constant in pixels: cos⁴ of the angle off the axis; None: no natural fall-off."""
    centre: tuple[float, float] | None = None
    """Column and row of the axis; None: the image's middle."""
    artificial: float = 0.0
    """Share that vignetting takes away at ρ = 1, half the image's diagonal from the axis: 1 − artificial ρᵖ."""
    power: float = 4.0
    """p of the artificial part."""
    polynomial: tuple[tuple[int, int, float], ...] = ()
    """Terms (i, j, a) of Σ a uⁱ vʲ, u and v from the axis in units of half the diagonal; empty: 1."""

    def __post_init__(self) -> None:
        if self.focal is not None:
            check_range("falloff", "focal", self.focal, 1.0, 1e7)
        check_range("falloff", "artificial", self.artificial, -1.0, 1.0)
        check_range("falloff", "power", self.power, 0.5, 20.0)
        if len(self.polynomial) > 66:
            raise InputError(f"falloff: {len(self.polynomial)} terms of the polynomial; at most 66 are allowed")
        for i, j, value in self.polynomial:
            check_range("falloff", "power of u", i, 0, 10)
            check_range("falloff", "power of v", j, 0, 10)
            check_range("falloff", "coefficient", value, -1e6, 1e6)


@dataclass(frozen=True)
class Aperture:
    """The light-sensitive area of a sensor element; its mean is the pixel's value (Ecker 1991, section 4.3.1)."""

    shape: Literal["square", "round", "point"] = "square"
    """`square` (or a rectangle), `round` (or an ellipse); `point` takes the value at the pixel's centre."""
    width: tuple[float, float] = (1.0, 1.0)
    """Sides or diameters along x and y in units of the distance of two pixels: below 1 with gaps, above 1 overlapping.

    The fill factor is their product (times π / 4 if round).
    """

    def __post_init__(self) -> None:
        if self.shape not in ("square", "round", "point"):
            raise InputError(f"aperture: shape {self.shape!r}; allowed are square, round and point")
        for axis, value in zip("xy", self.width):
            check_range("aperture", f"width ({axis})", value, 0.01, 20.0)


@dataclass(frozen=True)
class LineJitterPart:
    """Displacement of whole lines along x, as faulty line synchronisation makes it (Behr 1989, section 4.1.2).

    A positive one moves what the line shows to the right. Random displacements are new in every frame.
    """

    sigma: float = 0.0
    """Standard deviation of independent displacements of the lines, pixels."""
    field: float = 0.0
    """Distance of the odd lines (1, 3, …) from the even lines (0, 2, …), pixels: half of it to either side."""
    amplitude: float = 0.0
    """Amplitude of a periodic displacement, pixels."""
    period: float = 120.0
    """Its period, lines."""
    phase_deg: float = 0.0
    """Its phase at line 0: amplitude · sin(2π line / period + phase)."""

    def __post_init__(self) -> None:
        for name in ("sigma", "amplitude"):
            check_range("jitter", name, getattr(self, name), 0.0, 20.0)
        check_range("jitter", "field", self.field, -20.0, 20.0)
        check_range("jitter", "period", self.period, 2.0, 1e7)
        check_range("jitter", "phase_deg", self.phase_deg, -360.0, 360.0)

"""Curves of imaging systems: characteristic curves (linearisation) and clipping; MTF curves and spread functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log, pi, sqrt
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike, DTypeLike, NDArray

from photoplan.arrays import Floats
from photoplan.errors import InputError

#: Pixels that are looked at.
_SAMPLE = 1 << 18
#: Share of the pixels, and their number, from which on an end is a pile.
_MANY, _LEAST = 0.01, 20
#: How many times as many pixels as the value beside it an end must hold: noise rounds to both.
_HEAP = 4
#: Share of the pixels that the other end may hold: more is a drawing, whose even areas have no noise.
_FEW = 0.002


def clipped_levels(values: NDArray[Any]) -> tuple[float, float]:
    """Smallest and largest value where many pixels have exactly that value, and the other end shows noise.

    A sensor that is full, an amplifier or a developing program that cuts off, leaves such piles. A picture without
    noise has them at both ends and is not cut off.
    """
    flat = values.ravel()
    flat = flat[:: max(1, flat.size // _SAMPLE)]
    distinct, counts = np.unique(flat, return_counts=True)
    if distinct.size < 4:
        return -inf, inf
    first, second, before, last = (int(counts[k]) for k in (0, 1, -2, -1))
    many, few = max(_MANY * flat.size, _LEAST), _FEW * flat.size
    low = float(distinct[0]) if first >= max(many, _HEAP * second) and last < few else -inf
    high = float(distinct[-1]) if last >= max(many, _HEAP * before) and first < few else inf
    return low, high


#: Longest table that is read: one line for each value of 16 bits.
MOST_LINES = 65536


@dataclass(frozen=True, eq=False)
class Linearisation:
    """How grey values of an image become proportional to light, and back."""

    kind: Literal["linear", "srgb", "table"] = "linear"
    """``linear``: they are already; ``srgb``: IEC 61966-2-1, of the full scale; ``table``: by a table."""
    grey: Floats | None = None
    """Grey values of a table, increasing, shape (n,)."""
    light: Floats | None = None
    """Light of a table, strictly monotone, shape (n, bands): one column is for all bands."""

    def __post_init__(self) -> None:
        if self.kind not in ("linear", "srgb", "table"):
            raise InputError(
                f"linearisation {self.kind!r}; allowed are linear, srgb, or a table of grey values and light"
            )
        if self.kind != "table":
            if self.grey is not None or self.light is not None:
                raise InputError(f"the linearisation {self.kind} has no table of grey values")
            return
        grey, light = _checked_table(self.grey, self.light)
        grey.setflags(write=False)
        light.setflags(write=False)
        object.__setattr__(self, "grey", grey)
        object.__setattr__(self, "light", light)

    @classmethod
    def from_table(cls, rows: Floats | list[list[float]]) -> Linearisation:
        """Linearisation of a table as its file holds it.

        Parameters
        ----------
        rows
            Shape (n,) or (n, 1): light of the grey values 0, 1, … n − 1. Shape (n, 2): grey value and light. Shape
            (n, 3): light of the grey values 0, 1, … n − 1 in each of three bands. Shape (n, 4): grey value, then light
            of three bands.

        Raises
        ------
        InputError
            For another shape, numbers that are not finite, grey values that do not increase, or light that is not
            strictly monotone.
        """
        table = np.array(rows, np.float64)
        if table.ndim == 1:
            table = table[:, None]
        if table.ndim != 2 or table.shape[1] not in (1, 2, 3, 4):
            raise InputError(
                "a linearisation table has one column (light of grey value 0, 1, …), two (grey value, light), "
                f"three (light in three bands) or four (grey value, light in three bands); given is shape {table.shape}"
            )
        if table.shape[1] in (2, 4):
            return cls("table", table[:, 0], table[:, 1:])
        return cls("table", np.arange(table.shape[0], dtype=float), table)

    @property
    def is_linear(self) -> bool:
        """Whether grey values are light already."""
        return self.kind == "linear"

    def full_scale(self, dtype: DTypeLike) -> float:
        """Largest grey value of an image's type: 255, 65535, …; 1 for floating point."""
        kind = np.dtype(dtype)
        if kind.kind in "ui":
            return float(np.iinfo(kind).max)
        if kind.kind == "f":
            return 1.0
        raise InputError(f"an image of type {kind} has no grey values; allowed are integers and floating point")

    def to_linear(self, values: NDArray[np.generic], band: int = 1) -> Floats:
        """Light of grey values, same shape, NaN stays; ``srgb`` gives light of 0 to full scale in 0 to full scale.

        Parameters
        ----------
        values
            Grey values; their type states the full scale (floating point: 1).
        band
            Band counted from 1, for tables with a column per band.
        """
        grey = np.asarray(values)
        scale = self.full_scale(grey.dtype)
        grey = grey.astype(np.float64)
        if self.kind == "linear":
            return grey
        if self.kind == "srgb":
            return _srgb_to_light(grey / scale) * scale
        table, light = self._column(band)
        low, high = table[0], table[-1]
        finite = grey[np.isfinite(grey)]
        if finite.size and (finite.min() < low or finite.max() > high):
            raise InputError(
                f"the image has grey values {finite.min():g} to {finite.max():g}, the linearisation table holds "
                f"{low:g} to {high:g}; give a table for all of them"
            )
        return np.interp(grey, table, light)

    def to_values(self, light: Floats, dtype: DTypeLike = np.float64, band: int = 1) -> Floats:
        """Grey values (not rounded, not clipped to the type) of light: the inverse of `to_linear` for that type.

        A table is not continued: light beyond its ends becomes its first or last grey value.
        """
        scale = self.full_scale(dtype)
        amount = np.asarray(light, np.float64)
        if self.kind == "linear":
            return amount
        if self.kind == "srgb":
            return _light_to_srgb(amount / scale) * scale
        table, column = self._column(band)
        return np.interp(amount, column, table) if column[-1] > column[0] else np.interp(-amount, -column, table)

    def limits(self, dtype: DTypeLike, band: int = 1) -> tuple[float, float]:
        """Light at which a sensor's grey values are clipped: that of 0 and of the full scale, low before high."""
        scale = self.full_scale(dtype)
        if self.kind == "table":
            grey, light = self._column(band)
            ends = np.interp([0.0, scale], grey, light)
            return float(ends.min()), float(ends.max())
        return 0.0, scale

    def describe(self) -> str:
        """In words, for reports."""
        if self.kind == "linear":
            return "linear: grey values are taken as light"
        if self.kind == "srgb":
            return "sRGB (IEC 61966-2-1)"
        assert self.grey is not None and self.light is not None
        return f"table of {self.grey.size} grey values, {self.light.shape[1]} column(s)"

    def _column(self, band: int) -> tuple[Floats, Floats]:
        assert self.grey is not None and self.light is not None
        columns = self.light.shape[1]
        if columns > 1 and not 1 <= band <= columns:
            raise InputError(f"band {band} has no column in the linearisation table, which holds {columns}")
        return self.grey, self.light[:, 0 if columns == 1 else band - 1]


def _checked_table(grey: Floats | None, light: Floats | None) -> tuple[Floats, Floats]:
    if grey is None or light is None:
        raise InputError("a linearisation by a table needs grey values and their light")
    first, second = np.array(grey, np.float64), np.array(light, np.float64)
    if second.ndim == 1:
        second = second[:, None]
    if first.ndim != 1 or second.ndim != 2 or second.shape[0] != first.size or second.shape[1] < 1:
        raise InputError(f"grey values of shape {first.shape} and light of shape {second.shape} are not a table")
    if not 2 <= first.size <= MOST_LINES:
        raise InputError(f"a linearisation table has 2 to {MOST_LINES} lines; given: {first.size}")
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise InputError("a linearisation table holds finite numbers only")
    steps = np.diff(first)
    if not (steps > 0.0).all():
        line = int(np.argmin(steps > 0.0)) + 2
        raise InputError(f"grey values of a linearisation table increase; line {line} holds {first[line - 1]:g}")
    for column in range(second.shape[1]):
        rise = np.diff(second[:, column]) * np.sign(second[-1, column] - second[0, column])
        if not (rise > 0.0).all():
            line = int(np.argmin(rise > 0.0)) + 2
            raise InputError(
                f"the light of a linearisation table rises, or falls, from line to line (else one light had "
                f"several grey values); line {line} of column {column + 1} holds {second[line - 1, column]:g} after "
                f"{second[line - 2, column]:g}"
            )
    return first, second


def _srgb_to_light(value: Floats) -> Floats:
    """IEC 61966-2-1, eq. 5 and 6, of values 0 to 1; odd for negative ones, continued above 1."""
    amount = np.abs(value)
    return np.sign(value) * np.where(amount <= 0.04045, amount / 12.92, ((amount + 0.055) / 1.055) ** 2.4)


def _light_to_srgb(light: Floats) -> Floats:
    """IEC 61966-2-1, eq. 9 and 10: the inverse; the border is the image of 0.04045 so that both are exact inverses."""
    amount = np.abs(light)
    low = amount <= 0.04045 / 12.92
    return np.sign(light) * np.where(low, amount * 12.92, 1.055 * np.where(low, 1.0, amount) ** (1 / 2.4) - 0.055)


def disc_transfer(radius: float, f: Floats) -> Floats:
    """Transfer function of an even disc: 2 J1(2π r f) / (2π r f)."""
    z = 2.0 * pi * radius * f
    small = z < 1e-6
    return np.where(small, 1.0, 2.0 * scipy.special.j1(z) / np.where(small, 1.0, z))


def pupil_transfer(part: Floats) -> Floats:
    """Transfer function of a circular pupil without aberrations, in incoherent light, at a part v of its limit.

    2/π (arccos v − v √(1 − v²)), the autocorrelation of a disc (Goodman, Introduction to Fourier Optics, chapter 6);
    0 from v = 1 on.
    """
    v = np.clip(part, 0.0, 1.0)
    return np.asarray(2.0 / pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v)))


@dataclass(frozen=True, eq=False)
class MtfCurve:
    """Modulation against spatial frequency."""

    frequency: Floats
    """Cycles per pixel, increasing from 0, shape (n,)."""
    modulation: Floats
    """Modulation transfer, 1 at frequency 0, shape (n,)."""
    sigma: Floats | None = None
    """Standard deviations of the modulation, shape (n,); None if unknown."""

    def __post_init__(self) -> None:
        frequency, modulation = np.array(self.frequency, float), np.array(self.modulation, float)
        if frequency.ndim != 1 or frequency.shape != modulation.shape or frequency.size < 2:
            raise InputError(
                f"an MTF has as many frequencies as modulations, at least two; given: {frequency.shape} and "
                f"{modulation.shape}"
            )
        if frequency[0] != 0.0 or not (np.diff(frequency) > 0.0).all():
            raise InputError("the frequencies of an MTF increase from 0")
        object.__setattr__(self, "frequency", frequency)
        object.__setattr__(self, "modulation", modulation)

    @classmethod
    def from_zero(cls, frequency: ArrayLike, modulation: ArrayLike, sigma: ArrayLike) -> MtfCurve:
        """Curve of measured frequencies, with modulation 1 at frequency 0 before them."""
        rest = zip((0.0, 1.0, 0.0), (frequency, modulation, sigma))
        return cls(*(np.concatenate([[first], np.asarray(values, float)]) for first, values in rest))

    def at(self, frequency: float) -> float:
        """Modulation at a frequency in cycles per pixel, linear between its neighbours; NaN beyond the last one."""
        return float(np.interp(frequency, self.frequency, self.modulation, right=np.nan))

    def falls_to(self, modulation: float) -> float:
        """The first frequency at which the curve falls to a modulation; NaN if it stays above."""
        below = np.flatnonzero(self.modulation <= modulation)
        if below.size == 0 or below[0] == 0:
            return float("nan")
        i = int(below[0])
        high, low = self.modulation[i - 1], self.modulation[i]
        part = (high - modulation) / (high - low)
        return float(self.frequency[i - 1] + part * (self.frequency[i] - self.frequency[i - 1]))

    @property
    def mtf50(self) -> float:
        """Frequency at modulation 0.5, cycles per pixel; NaN if it is not reached."""
        return self.falls_to(0.5)

    def mtf50_interval(self, sigmas: float = 1.96) -> tuple[float, float]:
        """Frequencies at which the curve less and plus so many standard deviations falls to 0.5.

        The last frequency of the curve where that is not reached; equal where the standard deviations are unknown.
        """
        margin = 0.0 if self.sigma is None else sigmas * np.asarray(self.sigma, float)
        ends = [MtfCurve(self.frequency, self.modulation + sign * margin).mtf50 for sign in (-1.0, 1.0)]
        low, high = (float(np.nan_to_num(end, nan=self.frequency[-1])) for end in ends)
        return low, high

    @property
    def mtf10(self) -> float:
        """Frequency at modulation 0.1, cycles per pixel; NaN if it is not reached."""
        return self.falls_to(0.1)


#: Full width at half maximum of a Gaussian with standard deviation 1.
GAUSSIAN_WIDTH = 2.0 * sqrt(2.0 * log(2.0))


@dataclass(frozen=True, eq=False)
class SpreadFunction:
    """Share of the light of an object pixel that falls on the pixels around it, in one direction.

    The image is the object convolved with it (Kölbl 2006, eq. 1 and 2); Kölbl's Z, A, B are the values at 0, 1, 2.
    """

    values: Floats
    """Shares from -half to +half pixels, an odd number of values, sum 1."""
    sigma: Floats | None = None
    """Their standard deviations; None if unknown."""

    def __post_init__(self) -> None:
        values = np.array(self.values, np.float64)
        if values.ndim != 1 or values.size % 2 == 0:
            raise InputError(f"a spread function has an odd number of values in one row; given is shape {values.shape}")
        if not np.isfinite(values).all():
            raise InputError("a spread function has finite values only")
        total = float(values.sum())
        if abs(total - 1.0) > 1e-6:
            raise InputError(
                f"the values of a spread function add up to 1, no light is lost; given: {total:.6g} "
                "(SpreadFunction.normalised divides by the sum)"
            )
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    @classmethod
    def normalised(cls, values: Floats | list[float]) -> SpreadFunction:
        """Spread function of values that are divided by their sum."""
        numbers = np.array(values, np.float64)
        total = float(numbers.sum())
        if not total > 0.0:
            raise InputError(f"values of a spread function have a positive sum; given: {total:.6g}")
        return cls(numbers / total)

    @classmethod
    def symmetric(cls, half: Floats | list[float]) -> SpreadFunction:
        """Spread function from its centre Z and the values A, B, … on one side; divided by their sum."""
        side = np.asarray(half, np.float64)
        return cls.normalised(np.concatenate([side[:0:-1], side]))

    @property
    def half(self) -> int:
        """Return how many pixels it reaches to each side."""
        return int(self.values.size // 2)

    @property
    def asymmetry(self) -> float:
        """Half the sum of the differences between both sides: 0 if symmetric."""
        return float(np.abs(self.values - self.values[::-1]).sum() / 4.0)

    def side(self) -> Floats:
        """Centre Z and the means of both sides A, B, …, shape (half + 1,)."""
        both = (self.values + self.values[::-1]) / 2.0
        return both[self.half :]

    def transfer(self, frequency: Floats) -> NDArray[np.complex128]:
        """Optical transfer function at frequencies in cycles per pixel, same shape, 1 at 0."""
        offsets = np.arange(-self.half, self.half + 1)
        return np.exp(-2j * pi * np.multiply.outer(np.asarray(frequency, float), offsets)) @ self.values

    def gaussian_fwhm(self) -> float:
        """Full width at half maximum of the Gaussian with the same second moment, pixels; NaN if there is none."""
        offsets = np.arange(-self.half, self.half + 1.0)
        mean = float(self.values @ offsets)
        variance = float(self.values @ (offsets - mean) ** 2)
        return GAUSSIAN_WIDTH * sqrt(variance) if variance >= 0.0 else float("nan")


def gaussian_modulation(fwhm: float, frequency: Floats) -> Floats:
    """Modulation of a Gaussian spread function of a full width at half maximum in pixels, at cycles per pixel."""
    sigma = fwhm / GAUSSIAN_WIDTH
    return np.asarray(np.exp(-2.0 * (pi * sigma * np.asarray(frequency, float)) ** 2))


#: Side of the blocks in which the quietest places are sought, pixels.
BLOCK = 8
#: The share of blocks that show noise alone.
_QUIET = 0.1
#: Images are judged by no fewer patches.
_LEAST_CURVES = 3
_ROUNDS = 30


def detail_energies(grey: Floats) -> Floats:
    """Mean squares of fine and of coarser detail in blocks of a patch, shape (2, rows, cols)."""
    once = _smooth(grey)
    twice = _smooth(once)
    fine, coarse = (grey[2:-2, 2:-2] - once)[2:-2, 2:-2], once[2:-2, 2:-2] - twice
    rows, cols = (size // BLOCK for size in fine.shape)
    parts = np.square([fine, coarse])[:, : rows * BLOCK, : cols * BLOCK]
    return np.asarray(parts.reshape(2, rows, BLOCK, cols, BLOCK).mean(axis=(2, 4)))


def _smooth(grey: Floats) -> Floats:
    """Binomial means of five pixels along both axes; two pixels less on every side."""
    for _ in range(2):
        grey = (grey[:-4] + grey[4:] + 4 * (grey[1:-3] + grey[3:-1]) + 6 * grey[2:-2]).T / 16
    return grey


def detail_quotients(energies: Sequence[Floats]) -> Floats:
    """Logarithms (n,), base 2, of the quotients of amplitudes of fine and coarser detail in patches of one image.

    Energies are those of `detail_energies`; NaN where a patch shows no more than noise.
    """
    if not len(energies):
        return np.empty(0)
    noise = np.quantile(np.concatenate([each.reshape(2, -1) for each in energies], axis=1), _QUIET, axis=1)
    fine, coarse = np.transpose([each.mean(axis=(1, 2)) - noise for each in energies])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((fine > 0) & (coarse > 0), 0.5 * np.log2(fine / coarse), np.nan)


def blur_of(quotients: Floats) -> Floats:
    """Blur of images (n,) from logarithms of quotients of patches and images (m, n); NaN where a patch is not shown."""
    seen = np.isfinite(quotients)
    # A patch that one image shows tells nothing of others.
    use = np.where(seen & (seen.sum(axis=1) > 1)[:, None], quotients, np.nan)
    sharp = np.zeros(use.shape[1])
    use[:, np.isfinite(use).sum(axis=0) < _LEAST_CURVES] = np.nan
    known, rows = np.isfinite(use).any(axis=0), np.isfinite(use).any(axis=1)
    for _ in range(_ROUNDS if rows.any() else 0):
        ground = np.nanmedian(use[rows] - sharp, axis=1)
        sharp[known] = np.nanmedian(use[np.ix_(rows, known)] - ground[:, None], axis=0)
    sharp[~known] = sharp[known].max(initial=0.0)
    return np.asarray(sharp.max() - sharp)

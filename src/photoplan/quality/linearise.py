"""Linearisation of grey values, and clipping."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

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

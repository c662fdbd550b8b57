"""Height tints: colours by height, with or without the hillshade."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError

#: Colours from the lowest to the highest place, red, green, blue.
RAMPS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "hypsometric": (
        (86, 135, 92),
        (139, 169, 110),
        (200, 202, 142),
        (231, 219, 168),
        (214, 181, 128),
        (180, 139, 99),
        (146, 112, 96),
        (190, 182, 182),
        (250, 250, 250),
    ),
    "grey": ((40, 40, 40), (245, 245, 245)),
    "spectral": ((50, 60, 150), (60, 150, 190), (120, 200, 140), (240, 235, 140), (235, 150, 70), (170, 40, 50)),
}


@dataclass(frozen=True, eq=False)
class Ramp:
    """Colours at rising heights."""

    heights: NDArray[np.float64]
    """Metres, rising, shape (n,)."""
    colours: NDArray[np.float64]
    """Red, green, blue, 0 to 255, shape (n, 3)."""
    classed: bool = False
    """A height has the colour of the entry at or below it; else colours are interpolated. Beyond the ends the first
    and the last colour hold."""

    def __post_init__(self) -> None:
        if len(self.heights) < 1 or self.colours.shape != (len(self.heights), 3):
            raise InputError(f"colour ramp of {len(self.heights)} heights and colours of shape {self.colours.shape}")
        if not (np.diff(self.heights) > 0).all() or not np.isfinite(self.heights).all():
            raise InputError("colour ramp: heights must be finite and rise from entry to entry")
        if not ((self.colours >= 0) & (self.colours <= 255)).all():
            raise InputError("colour ramp: red, green and blue must be from 0 to 255")

    def __call__(self, heights: NDArray[np.float32]) -> NDArray[np.float32]:
        """Colours of heights (h, w), shape (3, h, w), 0 to 255; NaN where the height is NaN."""
        empty = np.isnan(heights)
        if self.classed:
            at = np.clip(np.searchsorted(self.heights, heights, side="right") - 1, 0, len(self.heights) - 1)
            bands = [self.colours[at, k] for k in range(3)]
        else:
            bands = [np.interp(heights, self.heights, self.colours[:, k]) for k in range(3)]
        return np.where(empty, np.nan, np.stack(bands)).astype(np.float32)


def built_in_ramp(name: str, low: float, high: float, steps: int | None = None) -> Ramp:
    """A ramp of `RAMPS` between two heights.

    Parameters
    ----------
    name
        One of `RAMPS`.
    low, high
        Metres.
    steps
        Number of classes of equal height; None: interpolated.

    Raises
    ------
    UsageError
        The name is unknown, or the range is empty.
    """
    if name not in RAMPS:
        raise UsageError(f"colour ramp {name!r}; built in are {', '.join(RAMPS)}, anything else is the name of a file")
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UsageError(f"heights of the ramp from {low} to {high}; two rising numbers are needed")
    colours = np.array(RAMPS[name], float)
    smooth = Ramp(np.linspace(low, high, len(colours)), colours)
    if steps is None:
        return smooth
    if not 1 <= steps <= 1000:
        raise UsageError(f"{steps} height classes; 1 to 1000 are allowed")
    lower = low + (high - low) * np.arange(steps) / steps
    middle = low + (high - low) * (np.arange(steps) / max(steps - 1, 1))
    picked = [np.interp(middle, smooth.heights, colours[:, k]) for k in range(3)]
    return Ramp(lower, np.column_stack(picked), classed=True)


def parse_ramp(text: str, name: str, classed: bool = False) -> Ramp:
    """A ramp of a text: lines `height red green blue`, separated by blanks, commas or tabs; `#` begins a remark.

    Parameters
    ----------
    text
        The lines, in any order.
    name
        Of the file, for messages.
    classed
        See `Ramp`.

    Raises
    ------
    InputError
        A line is no entry (its number is named), there are none, or a height comes twice.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(text.lstrip("\ufeff").splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not words or words[0].lower() == "nv":
            continue
        try:
            row = [float(word) for word in words[:4]]
        except ValueError:
            row = []
        if len(row) < 4 or not all(map(math.isfinite, row)) or not all(0 <= c <= 255 for c in row[1:]):
            raise InputError(
                f"{name}, line {number}: {line.strip()!r}; needed are a height in metres and red, green and blue from "
                "0 to 255"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{name}: no line with a height and a colour; write for example `500 200 180 120`")
    table = np.array(sorted(rows))
    twice = table[:-1, 0][np.diff(table[:, 0]) == 0]
    if len(twice):
        raise InputError(f"{name}: height {twice[0]:g} has two colours; keep one of them")
    return Ramp(table[:, 0], table[:, 1:], classed)


def shaded(
    colours: NDArray[np.float32], shade: NDArray[np.float32], level: float, strength: float = 0.6
) -> NDArray[np.float32]:
    """Colours darkened and lightened by a hillshade; flat ground keeps its colour.

    Parameters
    ----------
    colours
        Shape (3, h, w), 0 to 255.
    shade
        Light, 0 to 1, shape (h, w); NaN leaves the colour as it is.
    level
        Light on flat ground.
    strength
        How much of the hillshade is taken, 0 to 1.
    """
    shade = np.where(np.isnan(shade), np.float32(level), shade)
    dark = np.minimum(shade / level, 1)
    bright = np.maximum(shade - level, 0) / max(1 - level, 1e-6)
    # Light slopes go half way to white at most: their colour must still be read.
    return (colours * (1 - strength * (1 - dark)) + (255 - colours) * (0.5 * strength * bright)).astype(np.float32)

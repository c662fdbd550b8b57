"""What a fiducial mark or target looks like, in millimetres; `photoplan.orientation` finds it in scans."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError


@dataclass(frozen=True, eq=False)
class MarkPart:
    """A polygon of one tone."""

    outline: NDArray[np.float64]
    """Vertices x right, y up about the mark's reference point, shape (n, 2), millimetres."""
    tone: float
    """0 dark to 1 bright, as in a positive; NaN: not compared (image content, that differs from photo to photo)."""


@dataclass(frozen=True, eq=False)
class MarkPattern:
    """A mark drawn from parts: each covers those before it."""

    name: str
    """What kind it is, for messages: cross, dot, ring, block …"""
    parts: tuple[MarkPart, ...]
    background: float
    """Tone where no part is; NaN: not compared."""
    window: tuple[float, float, float, float]
    """What is compared: xmin, ymin, xmax, ymax about the reference point, millimetres."""

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.window
        if not (np.isfinite(self.window).all() and x0 < x1 and y0 < y1):
            raise InputError(f"mark {self.name!r}: window {self.window} mm; xmin < xmax and ymin < ymax are needed")

    def scaled(self, factor: float) -> MarkPattern:
        """The same mark in another size."""
        x0, y0, x1, y1 = (factor * side for side in self.window)
        parts = tuple(MarkPart(factor * part.outline, part.tone) for part in self.parts)
        return MarkPattern(self.name, parts, self.background, (x0, y0, x1, y1))

    def turned(self, degrees: float) -> MarkPattern:
        """The same mark turned anticlockwise about its reference point, in the same window."""
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        R = np.array([[c, s], [-s, c]])
        return replace(self, parts=tuple(MarkPart(part.outline @ R, part.tone) for part in self.parts))


@dataclass(frozen=True, eq=False)
class MarkExample:
    """A mark cut from an image."""

    name: str
    values: NDArray[Any]
    """Grey values, shape (rows, columns)."""
    reference: tuple[float, float]
    """Column and row of the mark's reference point in `values`."""
    pixel_mm: float
    """Side of a pixel of the example, millimetres."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or min(self.values.shape) < 5:
            raise InputError(f"example of mark {self.name!r}: shape {self.values.shape}; a grey image is needed")
        if not (np.isfinite(self.pixel_mm) and self.pixel_mm > 0):
            raise InputError(f"example of mark {self.name!r}: pixel of {self.pixel_mm} mm; a positive one is needed")

    def scaled(self, factor: float) -> MarkExample:
        """The same mark in another size."""
        return replace(self, pixel_mm=factor * self.pixel_mm)

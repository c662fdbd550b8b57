"""A flat image reduced to blocks, and weights that leave out what does not belong to its smooth surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Blocks along the longer side.
ACROSS = 96
"""Tukey's constant: 95 % efficient for normal noise."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means of square blocks of an image."""

    size: tuple[int, int]
    """Width and height of the image, pixels."""
    side: int
    """Of a block, pixels."""
    offset: tuple[int, int]
    """Column and row of the first block's first pixel."""
    values: Array
    """Shape (rows, columns); NaN: not known."""

    @property
    def known(self) -> Array:
        """Values of the blocks that have one, shape (n,)."""
        return self.values[np.isfinite(self.values)]

    @property
    def x(self) -> Array:
        """Columns of their middles, shape (n,)."""
        return self._middles(1)

    @property
    def y(self) -> Array:
        """Rows of their middles, shape (n,)."""
        return self._middles(0)

    def corner(self, column: int, row: int) -> tuple[float, float]:
        """Column and row of the upper left corner of a block."""
        return self.offset[0] + column * self.side - 0.5, self.offset[1] + row * self.side - 0.5

    def spread_out(self, known: Array) -> Array:
        """Values of the known blocks where they lie, NaN elsewhere, shape (rows, columns)."""
        out = np.full(self.values.shape, np.nan)
        out[np.isfinite(self.values)] = known
        return out

    def neighbour_correlation(self, known: Array) -> float:
        """Correlation of values of blocks beside and below each other; NaN among them is left out."""
        return float(np.mean(self._correlations(known)))

    def inflation(self, known: Array) -> float:
        """By how much variances grow as neighbours are not independent (first-order Markov process in both ways)."""
        count = int(np.isfinite(known).sum())
        factor = 1.0
        for r in self._correlations(known):
            r = min(r, 0.9)
            if r > 3.0 / math.sqrt(max(count, 1)):
                factor *= (1.0 + r) / (1.0 - r)
        return factor

    def _correlations(self, known: Array) -> tuple[float, float]:
        field = self.spread_out(known)
        field = field - np.nanmean(field)
        variance = float(np.nanmean(field**2))
        if not variance > 0.0:
            return 0.0, 0.0
        beside = float(np.nanmean(field[:, 1:] * field[:, :-1])) / variance
        below = float(np.nanmean(field[1:] * field[:-1])) / variance
        return beside, below

    def _middles(self, axis: int) -> Array:
        index = np.indices(self.values.shape)[axis][np.isfinite(self.values)]
        return self.offset[1 - axis] + index * self.side + (self.side - 1) / 2.0


def to_blocks(image: NDArray[np.floating]) -> Blocks:
    """Reduce an image to about `ACROSS` blocks along its longer side, each the mean of the middle half of its values.

    Single dust grains, hot and dead pixels leave such a mean alone, and it is finer than the steps of grey values.
    A block with an unknown pixel (NaN) is unknown. Pixels at the borders that fill no block are left out.
    """
    height, width = image.shape
    side = max(1, round(max(height, width) / ACROSS))
    rows, columns = height // side, width // side
    left, top = (width - columns * side) // 2, (height - rows * side) // 2
    values = np.empty((rows, columns))
    n = side * side
    low, high = n // 4, n - n // 4
    for row in range(rows):
        strip = np.asarray(image[top + row * side : top + (row + 1) * side, left : left + columns * side], float)
        parts = strip.reshape(side, columns, side).transpose(1, 0, 2).reshape(columns, n)
        known = np.isfinite(parts).all(axis=1)
        values[row] = np.where(known, np.sort(parts, axis=1)[:, low:high].mean(axis=1), np.nan)
    return Blocks((width, height), side, (left, top), values)

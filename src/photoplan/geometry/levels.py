"""Images reduced by powers of two, for products that are much coarser."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.kernels.reduce import reduce_means

Pixels = tuple[NDArray[Any], NDArray[np.bool_] | None]
"""Values (bands, height, width), and validity (height, width); None: all are valid."""

#: Pixels of full size that are held at once, bytes.
CHUNK = 16 << 20


class FullSize(Protocol):
    """An image that is read by windows."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    @property
    def bands(self) -> int:
        """Number of bands."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        ...

    def read(self, window: Window) -> Pixels:
        """Pixels of a window, and their validity."""
        ...


def level_size(size: tuple[int, int], level: int) -> tuple[int, int]:
    """Width and height of an image reduced by 2 to the power of `level`; its last pixels may be partly outside."""
    return -(-size[0] >> level), -(-size[1] >> level)


def means(pixels: NDArray[Any], valid: NDArray[np.bool_] | None, level: int) -> Pixels:
    """Blocks of 2^level × 2^level pixels as their means, see `engine.base.Reader`; the last ones may be smaller."""
    side = 1 << level
    height, width = (-(-n // side) for n in pixels.shape[1:])
    out, good = np.empty((len(pixels), height, width), pixels.dtype), np.empty((height, width), bool)
    mask = np.empty((0, 0), bool) if valid is None else np.require(valid, bool, ("C", "A", "W"))
    reduce_means(np.require(pixels, None, ("C", "A", "W")), mask, side, pixels.dtype.kind != "f", out, good)
    return out, None if valid is None or good.all() else good


def reduced(reader: FullSize, window: Window, level: int) -> Pixels:
    """A window of an image that is reduced by 2^level, from its pixels of full size, some rows at a time.

    For readers that know no better way: those whose pixels are made of others by steps, and files without overviews.
    """
    if level == 0:
        return reader.read(window)
    whole = Window(0, 0, *reader.size)
    across = Window(window.col << level, 0, window.width << level, whole.height) & whole
    rows = max(1, CHUNK // ((across.width << level) * reader.bands * reader.dtype.itemsize))
    parts = []
    for row in range(window.row, window.stop[1], rows):
        end = min(row + rows, window.stop[1])
        full = Window(across.col, row << level, across.width, (end - row) << level) & whole
        parts.append(means(*reader.read(full), level))
    values = np.concatenate([part[0] for part in parts], axis=1)
    if all(part[1] is None for part in parts):
        return values, None
    return values, np.concatenate([np.ones(v.shape[1:], bool) if m is None else m for v, m in parts])

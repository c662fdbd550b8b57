"""A scan as grey values, read by windows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.io.scan_pitch import read_pitch

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
"""Of red, green and blue (ITU-R BT.601): what JPEG and video keep at full resolution, unlike the colours."""
_AT_ONCE = 1 << 24
"""Pixels that are read at once."""


class ScanImage:
    """Grey values of a scan: one band, or the luminance of the first three.

    Parameters
    ----------
    path : Path
        Image file.
    band : int, optional
        Number of the band, from 1; None: the only one, or the luminance of three.

    Raises
    ------
    InputError
        The file cannot be used.
    UsageError
        It has no such band.
    """

    def __init__(self, path: Path, band: int | None = None) -> None:
        self._reader = RasterReader(path)
        bands = self._reader.bands
        if band is not None and not 1 <= band <= bands:
            raise UsageError(f"{path}: band {band}; the file has {bands}")
        self._band = band if band is not None else 1 if bands < 3 else None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self._reader.size

    @property
    def rule(self) -> str:
        """Which grey values are used, for messages."""
        if self._band is None:
            return "luminance of bands 1 to 3"
        return f"band {self._band}" if self._reader.bands > 1 else "the only band"

    def grey(self, window: Window, factor: int = 1) -> NDArray[np.float32]:
        """Means of blocks of `factor` × `factor` pixels; NaN where a block has no valid pixel."""
        out = np.empty((window.height // factor, window.width // factor), np.float32)
        rows = max(1, _AT_ONCE // max(window.width, 1) // factor) * factor
        for row in range(0, window.height, rows):
            height = min(rows, window.height - row)
            pixels, valid = self._reader.read(Window(window.col, window.row + row, window.width, height))
            if self._band is None:
                grey = np.tensordot(_LUMINANCE, pixels[:3].astype(np.float32), 1)
            else:
                grey = pixels[self._band - 1].astype(np.float32)
            if valid is not None:
                grey[~valid] = np.nan
            out[row // factor : (row + height) // factor] = _means(grey, factor)
        return out


def _means(grey: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    if factor == 1:
        return grey
    blocks = grey.reshape(grey.shape[0] // factor, factor, grey.shape[1] // factor, factor)
    known = np.isfinite(blocks)
    if known.all():
        return blocks.mean((1, 3), np.float32)
    count = known.sum((1, 3))
    total = np.where(known, blocks, 0).sum((1, 3), np.float32)
    return np.divide(total, count, out=np.full(count.shape, np.nan, np.float32), where=count > 0)


def stated_pixel_mm(path: Path) -> float | None:
    """Side of a pixel in millimetres as the file's resolution tags state it; None: they do not."""
    pitch = read_pitch(path)
    return None if pitch is None else (pitch[0] + pitch[1]) / 2

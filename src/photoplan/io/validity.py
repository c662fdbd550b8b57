"""The one rule that decides which source pixels are used.

A pixel is used only when **every** statement of its file says so:

* its alpha is above zero (in every alpha band; a band that is tagged as alpha and holds a picture is a colour band),
* its mask (mask band inside the file, or `.msk` beside it) is above zero,
* it is not nodata: not *all* bands equal the nodata value,
* it is finite in all bands (float data),
* its block was written (sparse TIFF without a nodata value).

One black band is therefore still a colour, and statements that disagree make a pixel invalid rather than dark.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window

USUAL_NODATA = (-9999.0, -32768.0, -32767.0, -99999.0)
"""Values that mean "nothing here" in files that do not declare it."""
_LOWEST_FLOAT = float(np.finfo(np.float32).min)


def not_nodata(pixels: NDArray[Any], nodata: float | None) -> NDArray[np.bool_] | None:
    """Where not all bands of `pixels` (bands, h, w) equal `nodata`; None if that is everywhere.

    A nodata value that the type cannot hold (-9999 for bytes) is never met.
    """
    if nodata is None or np.isnan(nodata):
        return None
    if pixels.dtype.kind in "iu":
        limits = np.iinfo(pixels.dtype)
        if not limits.min <= nodata <= limits.max or nodata != int(nodata):
            return None
    value = pixels.dtype.type(nodata)
    empty = pixels[0] == value
    for band in pixels[1:]:
        if not empty.any():
            return None
        empty &= band == value
    return ~empty if empty.any() else None


def refuse_undeclared(path: Path, window: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> None:
    """Refuse valid pixels (bands, h, w) of signed type that are one of the usual nodata values in all bands.

    Resampled as grey values they would spoil their surroundings without a word.
    """
    if (
        pixels.dtype.kind not in "if"
        or not pixels.size
        or not np.fmin.reduce(pixels[0], axis=None) <= max(USUAL_NODATA)
    ):
        return
    for value in (*USUAL_NODATA, _LOWEST_FLOAT) if pixels.dtype.kind == "f" else USUAL_NODATA:
        kept = not_nodata(pixels, value)
        count = 0 if kept is None else int((~kept if valid is None else ~kept & valid).sum())
        if count:
            raise InputError(
                f"{path}: {count} pixels in window col {window.col} row {window.row} {window.width} × "
                f"{window.height} are {value:g}, the usual nodata; declare it (`gdal_edit -a_nodata {value:g}`)"
            )


def finite(pixels: NDArray[Any]) -> NDArray[np.bool_] | None:
    """Where all bands of `pixels` (bands, h, w) are finite; None if that is everywhere."""
    if pixels.dtype.kind != "f":
        return None
    good = np.isfinite(pixels).all(axis=0)
    return None if good.all() else good


@dataclass(frozen=True, eq=False)
class MissingBlocks:
    """Blocks of a sparse file that were never written."""

    block: tuple[int, int]
    """Width and height of a block."""
    gone: NDArray[np.bool_]
    """True = never written; shape (rows, columns) of blocks."""

    def written(self, window: Window) -> NDArray[np.bool_] | None:
        """Where the pixels of a window lie in written blocks; None if that is everywhere."""
        rows = np.arange(window.row, window.row + window.height) // self.block[1]
        cols = np.arange(window.col, window.col + window.width) // self.block[0]
        if not self.gone[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1].any():
            return None
        return np.logical_not(self.gone[np.ix_(rows, cols)])

"""Source images that are restored while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import reduced
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import RasterInfo
from photoplan.io.storage import Nodata
from photoplan.project.aligned_reader import AlignedReader
from photoplan.project.derived_reader import DerivedReader
from photoplan.project.fall_off_reader import FallOffReader
from photoplan.quality.linearise import Linearisation
from photoplan.quality.restoration.filters import RestorationFilter
from photoplan.quality.restoration.restorer import RestoredPixels, Restorer

#: An image, with corrections that come before the filter.
Source = RasterReader | FallOffReader | AlignedReader
#: Side of the parts in which a large window is restored: what bounds memory. The result does not depend on it.
PART = 512


@dataclass(frozen=True, eq=False)
class RestoredReader(DerivedReader):
    """A source image behind the engine's `Reader`, restored: the pixels that `photoplan restore` writes.

    Raises
    ------
    InputError
        When read: damaged pixels, or grey values that the linearisation's table does not have.
    """

    source: Source
    restorer: Restorer

    @property
    def aligned(self) -> AlignedReader | None:
        """The correction of lateral chromatic aberration, if there is one."""
        return self.source if isinstance(self.source, AlignedReader) else None

    @property
    def lit(self) -> FallOffReader | None:
        """The correction of light fall-off, if there is one."""
        return _lit(self.source)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the restored pixels."""
        return self.restorer.out

    def describe(self) -> str:
        """How the pixels are restored, in words."""
        used = self.restorer.filter
        columns, rows = used.margin
        name = f' "{used.description}"' if used.description else ""
        lit = "light fall-off corrected; " if self.lit is not None else ""
        return (
            f"{lit}restored with the filter{name}, {2 * columns + 1} × {2 * rows + 1}; noise grows "
            f"{used.noise_gain:.3g} times; {self.restorer.linearisation.describe()}"
        )

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Restored pixels of a window inside the image, shape (bands, height, width), and their validity."""
        if level:
            return reduced(self, window, level)
        parts = list(window.tiles(PART))
        if len(parts) == 1:
            only = self.read_counted(window)
            return only.values, only.valid
        values = np.empty((self.bands, window.height, window.width), self.dtype)
        valid = np.ones((window.height, window.width), bool)
        for part in parts:
            pixels = self.read_counted(part)
            rows = slice(part.row - window.row, part.stop[1] - window.row)
            cols = slice(part.col - window.col, part.stop[0] - window.col)
            values[:, rows, cols] = pixels.values
            if pixels.valid is not None:
                valid[rows, cols] = pixels.valid
        return values, None if valid.all() else valid

    def read_counted(self, window: Window) -> RestoredPixels:
        """Restored pixels of a window, and how many were clipped."""
        margin, size = self.restorer.margin, self.size
        at = margin.around(window, size, gaps=False)
        pixels, valid = self.source.read(at)
        if valid is not None or not margin.fits(window, size):
            # What stands in for missing pixels may lie further away.
            wide = margin.around(window, size)
            if wide != at:
                at = wide
                pixels, valid = self.source.read(at)
        try:
            return self.restorer.restore(window, pixels, at, valid)
        except InputError as error:
            raise InputError(f"{self.source.path}: {error}") from None


def kept_nodata(info: RasterInfo, out: np.dtype[Any]) -> Nodata:
    """How a restored copy says which pixels are invalid: by the image's own value where it can, else by a mask.

    Floating point takes NaN, since a restored value may happen to be any number.
    """
    if out.kind == "f":
        return float("nan")
    if info.nodata is None or not np.isfinite(info.nodata) or info.palette:
        return "mask"
    limits = np.iinfo(out)
    whole = info.nodata == int(info.nodata) and limits.min <= info.nodata <= limits.max
    return info.nodata if whole else "mask"


def restored_reader(
    source: Source,
    filter_: RestorationFilter,
    linearisation: Linearisation | None = None,
    out: np.dtype[Any] | None = None,
) -> RestoredReader:
    """An image restored with a filter.

    Parameters
    ----------
    source : RasterReader, FallOffReader or AlignedReader
    filter_ : RestorationFilter
    linearisation : Linearisation, optional
        How grey values become light; they are light already if it is None. Of a `FallOffReader` it is the same.
    out : dtype, optional
        Type of the restored pixels; the image's own if it is None.

    Raises
    ------
    InputError
        The filter is not for an image of this size or number of bands.
    """
    stored = np.dtype(source.info.dtype)
    out = stored if out is None else out
    nodata = kept_nodata(source.info, out)
    avoided = nodata if isinstance(nodata, float) and out.kind != "f" else None
    light = linearisation or Linearisation()
    try:
        restorer = Restorer(filter_, source.size, source.bands, stored, out, light, avoided, _lit(source) is not None)
    except InputError as error:
        raise InputError(f"{source.path}: {error}") from None
    return RestoredReader(source, restorer)


def _lit(source: Source) -> FallOffReader | None:
    inner = source.source if isinstance(source, AlignedReader) else source
    return inner if isinstance(inner, FallOffReader) else None

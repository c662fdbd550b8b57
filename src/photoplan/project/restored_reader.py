"""Source images that are restored while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import reduced
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import RasterInfo
from photoplan.io.storage import Nodata
from photoplan.kernels.shift_bands import limits_of, no_mask, shift_band
from photoplan.kernels.weights import KERNELS
from photoplan.project.derived_reader import DerivedReader
from photoplan.project.fall_off_reader import FallOffReader
from photoplan.quality.colour.model import ChromaticModel
from photoplan.quality.linearise import Linearisation
from photoplan.quality.restoration.filters import RestorationFilter
from photoplan.quality.restoration.restorer import RestoredPixels, Restorer


@dataclass(frozen=True, eq=False)
class AlignedReader(DerivedReader):
    """A source image behind the engine's `Reader`, corrected for lateral chromatic aberration.

    The value of a band at a pixel is taken where the model says that the band shows what the reference shows at that
    pixel. The reference stays bit by bit. The result does not depend on the windows in which it is read.

    Raises
    ------
    InputError
        When made: the model is for images of another size, or has bands that the image has not. When read: damaged
        pixels.
    """

    source: RasterReader | FallOffReader
    """Grey values, or light whose fall-off is corrected."""
    model: ChromaticModel
    kernel: str = "lanczos3"
    """A name of `photoplan.kernels.weights.KERNELS`."""

    def __post_init__(self) -> None:
        if self.model.size != self.source.size:
            raise InputError(
                f"{self.source.path}: {self.source.size[0]} × {self.source.size[1]} pixels; the chromatic model is for "
                f"images of {self.model.size[0]} × {self.model.size[1]}"
            )
        highest = max([self.model.reference, *(band.band for band in self.model.bands)])
        if highest > self.source.bands:
            raise InputError(
                f"{self.source.path}: {self.source.bands} bands; the chromatic model describes band {highest}"
            )
        object.__setattr__(self, "_reach", {b.band: self.model.largest(b.band) for b in self.model.bands})
        worst = max(self._reach.values(), default=0.0)  # type: ignore[attr-defined]
        if worst > min(200.0, 0.25 * min(self.source.size)):
            raise InputError(
                f"{self.source.path}: the chromatic model displaces a band by {worst:.0f} pixels; up to 200 and a "
                "quarter of the image are allowed"
            )

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return self.source.dtype

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity."""
        if level:
            return reduced(self, window, level)
        reach: dict[int, float] = self._reach  # type: ignore[attr-defined]
        margin = ceil(max(reach.values(), default=0.0)) + KERNELS[self.kernel].margin + 1
        width, height = self.size
        around = Window(window.col - margin, window.row - margin, window.width + 2 * margin, window.height + 2 * margin)
        around &= Window(0, 0, width, height)
        pixels, valid = self.source.read(around)
        if valid is not None and self.dtype.kind == "f":
            # Weights of zero times NaN would be NaN.
            pixels = np.where(valid, pixels, self.dtype.type(0))
        offset = (window.col - around.col, window.row - around.row)
        inside = (slice(offset[1], offset[1] + window.height), slice(offset[0], offset[0] + window.width))
        out = pixels[:, inside[0], inside[1]].copy()
        good = np.ones((window.height, window.width), bool) if valid is None else valid[inside].copy()
        x = np.arange(window.col, window.stop[0], dtype=np.float64)[None, :]
        y = np.arange(window.row, window.stop[1], dtype=np.float64)[:, None]
        mask = no_mask() if valid is None else np.ascontiguousarray(valid)
        for each in self.model.bands:
            if not each.terms:
                continue
            moved = np.stack(self.model.displacement(each.band, x, y))
            # Places beyond the image by less than the displacement itself take the border's pixels.
            _keep_inside(moved, (x, y), self.size)
            coefficients = np.array(KERNELS[self.kernel].coefficients)
            band = np.require(pixels[each.band - 1], None, ("C", "A"))
            shift_band(band, mask, offset, moved, (coefficients, limits_of(self.dtype)), out[each.band - 1], good)
        return out, None if good.all() else good


def _keep_inside(moved: NDArray[np.float64], at: tuple[Any, Any], size: tuple[int, int]) -> None:
    """Bound places to the image, so that its border stays covered."""
    for axis in (0, 1):
        np.clip(moved[axis] + at[axis], 0.0, size[axis] - 1.0, out=moved[axis])
        moved[axis] -= at[axis]


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

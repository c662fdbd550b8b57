"""Source images that are restored while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import Pixels
from photoplan.io.raster_info import RasterInfo
from photoplan.io.storage import Nodata
from photoplan.project.fall_off import FallOffStep
from photoplan.project.stepped import SteppedReader
from photoplan.quality.linearise import Linearisation
from photoplan.quality.restoration.filters import RestorationFilter
from photoplan.quality.restoration.restorer import RestoredPixels, Restorer


@dataclass(frozen=True, eq=False)
class RestoreStep:
    """Restoration by a filter: the pixels that `photoplan restore` writes."""

    restorer: Restorer
    lit: bool = False
    """Whether light fall-off was corrected before, so that pixels are light already."""

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The restorer was made for the image."""

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """Type of the restored pixels."""
        return self.restorer.out

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """The filter's margin; more where pixels are missing, since what stands in for them may lie further away."""
        margin = self.restorer.margin
        return margin.around(window, size, gaps=gaps or not margin.fits(window, size))

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Restored pixels of a window and their validity."""
        restored = self.restorer.restore(window, pixels, at, valid)
        return restored.values, restored.valid

    def describe(self) -> str:
        """How the pixels are restored, in words."""
        used = self.restorer.filter
        columns, rows = used.margin
        name = f' "{used.description}"' if used.description else ""
        lit = "light fall-off corrected; " if self.lit else ""
        return (
            f"{lit}restored with the filter{name}, {2 * columns + 1} × {2 * rows + 1}; noise grows "
            f"{used.noise_gain:.3g} times; {self.restorer.linearisation.describe()}"
        )


def read_counted(reader: SteppedReader, window: Window) -> RestoredPixels:
    """Pixels of a window of an image that is restored last, and how many were clipped."""
    at, (pixels, valid) = reader.before_last(window)
    try:
        return restoration_of(reader).restorer.restore(window, pixels, at, valid)
    except InputError as error:
        raise InputError(f"{reader.path}: {error}") from None


def restoration_of(reader: SteppedReader) -> RestoreStep:
    """The last step of an image that is restored."""
    step = reader.steps[-1]
    assert isinstance(step, RestoreStep)
    return step


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


def restored(
    source: SteppedReader,
    filter_: RestorationFilter,
    linearisation: Linearisation | None = None,
    out: np.dtype[Any] | None = None,
) -> SteppedReader:
    """An image restored with a filter."""
    stored = np.dtype(source.info.dtype)
    out = stored if out is None else out
    nodata = kept_nodata(source.info, out)
    avoided = nodata if isinstance(nodata, float) and out.kind != "f" else None
    light, lit = linearisation or Linearisation(), source.step(FallOffStep) is not None
    try:
        restorer = Restorer(
            filter=filter_,
            size=source.size,
            bands=source.bands,
            dtype=stored,
            out=out,
            linearisation=light,
            nodata=avoided,
            light_given=lit,
        )
    except InputError as error:
        raise InputError(f"{source.path}: {error}") from None
    return source.then(RestoreStep(restorer, lit))

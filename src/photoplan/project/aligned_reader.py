"""Source images whose bands are brought to the place of a reference band while they are read."""

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
from photoplan.kernels.shift_bands import limits_of, no_mask, shift_band
from photoplan.kernels.weights import KERNELS
from photoplan.project.derived_reader import DerivedReader
from photoplan.project.fall_off_reader import FallOffReader
from photoplan.quality.colour.model import ChromaticModel


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

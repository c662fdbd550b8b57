"""Bands of source images, brought to the place of a reference band while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Pixels, Window
from photoplan.kernels.raster import empty_mask, pixel_range, shift_band
from photoplan.kernels.weights import KERNELS
from photoplan.quality.colour import ChromaticModel


@dataclass(frozen=True, eq=False)
class AlignStep:
    """Lateral chromatic aberration, corrected: bands are brought to the place of a reference band.

    The value of a band at a pixel is taken where the model says that the band shows what the reference shows at that
    pixel. The reference stays bit by bit.
    """

    model: ChromaticModel
    kernel: str = "lanczos3"
    """A name of `photoplan.kernels.weights.KERNELS`."""

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The model is for images of one size, of its bands, with small displacements."""
        known = self.model.size
        if known != size:
            raise InputError(
                f"{size[0]} × {size[1]} pixels; the chromatic model is for images of {known[0]} × {known[1]}"
            )
        highest = max([self.model.reference, *(band.band for band in self.model.bands)])
        if highest > bands:
            raise InputError(f"{bands} bands; the chromatic model describes band {highest}")
        worst = self._reach
        if worst > min(200.0, 0.25 * min(size)):
            raise InputError(
                f"the chromatic model displaces a band by {worst:.0f} pixels; up to 200 and a quarter of the image are "
                "allowed"
            )

    @cached_property
    def _reach(self) -> float:
        return max((self.model.largest(band.band) for band in self.model.bands), default=0.0)

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """The same type."""
        return stored

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """As far as bands are displaced, and the kernel's support."""
        margin = ceil(self._reach) + KERNELS[self.kernel].margin + 1
        wide = Window(window.col - margin, window.row - margin, window.width + 2 * margin, window.height + 2 * margin)
        return wide & Window(0, 0, *size)

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Pixels of a window and their validity."""
        if valid is not None and pixels.dtype.kind == "f":
            # Weights of zero times NaN would be NaN.
            pixels = np.where(valid, pixels, pixels.dtype.type(0))
        offset = (window.col - at.col, window.row - at.row)
        inside = (slice(offset[1], offset[1] + window.height), slice(offset[0], offset[0] + window.width))
        out = pixels[:, inside[0], inside[1]].copy()
        good = np.ones((window.height, window.width), bool) if valid is None else valid[inside].copy()
        x = np.arange(window.col, window.stop[0], dtype=np.float64)[None, :]
        y = np.arange(window.row, window.stop[1], dtype=np.float64)[:, None]
        mask = empty_mask() if valid is None else np.ascontiguousarray(valid)
        for each in self.model.bands:
            if not each.terms:
                continue
            moved = np.stack(self.model.displacement(each.band, x, y))
            # Places beyond the image by less than the displacement itself take the border's pixels.
            _keep_inside(moved, (x, y), self.model.size)
            coefficients = np.array(KERNELS[self.kernel].coefficients)
            band = np.require(pixels[each.band - 1], None, ("C", "A"))
            shift_band(band, mask, offset, moved, (coefficients, pixel_range(pixels.dtype)), out[each.band - 1], good)
        return out, None if good.all() else good


def _keep_inside(moved: NDArray[np.float64], at: tuple[Any, Any], size: tuple[int, int]) -> None:
    """Bound places to the image, so that its border stays covered."""
    for axis in (0, 1):
        np.clip(moved[axis] + at[axis], 0.0, size[axis] - 1.0, out=moved[axis])
        moved[axis] -= at[axis]

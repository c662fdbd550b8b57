"""Overviews of image files, where they hold means: products much coarser than the image need not read it all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from photoplan.geometry.grid import Window
from photoplan.geometry.levels import Pixels, level_size, means
from photoplan.io.gdal import gdal_settings, handle
from photoplan.io.raster_info import RasterInfo
from photoplan.io.raster_pixels import read_pixels
from photoplan.io.validity import refuse_undeclared

_SIDE = 64
"""Side of the places where an overview is compared with what it should be."""
_PLACES = (0.5, 0.25, 0.75)


@dataclass(frozen=True, eq=False)
class Overview:
    """A reduced copy inside the file, read like an image."""

    info: RasterInfo
    number: int
    """Its place among the file's overviews, from 0."""
    level: int
    """The image is reduced by 2 to the power of this."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return level_size(self.info.size, self.level)

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.info.bands

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return np.dtype(self.info.dtype)

    def read(self, window: Window) -> Pixels:
        """Pixels of a window and their validity."""
        pixels, valid = read_pixels(self.info, window, overview=(self.number, self.size))
        if self.info.nodata is None:
            refuse_undeclared(self.info.path, window, pixels, valid)
        return pixels, valid


@lru_cache(maxsize=256)
def best_overview(info: RasterInfo, level: int) -> Overview | None:
    """The overview that saves most on the way to a level; None if there is none that can be used.

    Parameters
    ----------
    info : RasterInfo
    level : int
        At least 1.
    """
    if info.palette or info.missing_blocks:
        return None
    for wanted in range(level, 0, -1):
        for number, factor in enumerate(info.overviews):
            overview = Overview(info, number, wanted)
            if factor == 2**wanted and _are_means(overview):
                return overview
    return None


def _are_means(overview: Overview) -> bool:
    """Whether an overview holds means, and not pixels that were picked out, which would alias.

    Picked pixels lie beside the mean as far as the pixels of a block do; whatever smooths lies much nearer.
    """
    info, f = overview.info, 1 << overview.level
    with gdal_settings():
        found = handle(info.path, info.driver, overview.number)
        if (found.width, found.height) != overview.size:
            return False
    width, height = overview.size
    beside = spread = 0.0
    for place in _PLACES:
        side = (min(_SIDE, width - 1), min(_SIDE, height - 1))
        part = Window(int(place * (width - side[0])), int(place * (height - side[1])), *side) & Window(
            0, 0, width - 1, height - 1
        )
        if not part.size:
            continue
        full, _ = read_pixels(info, Window(part.col * f, part.row * f, part.width * f, part.height * f))
        got, valid = overview.read(part)
        mean, square = means(full.astype(np.float32), None, overview.level)[0], full.astype(np.float32) ** 2
        variance = np.maximum(means(square, None, overview.level)[0] - mean**2, 0.0)
        there = slice(None) if valid is None else valid
        beside += float(((got - mean) ** 2)[:, there].sum())
        spread += float(variance[:, there].sum())
    # Half the spread of the pixels, and what rounding and a lossy compression may add.
    return beside <= 0.25 * spread + (0.0 if overview.dtype.kind == "f" else 4.0 * len(_PLACES) * _SIDE**2)

"""Coordinate matrices of views: what each pixel of a picture shows, kept for other content (Ecker 1991, §5.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.gdal import gdal_settings, open_raster
from photoplan.io.product import DESCRIPTION
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.raster_pixels import read_pixels

#: Bands of a matrix and their units.
BANDS = (
    ("E", "metre"),
    ("N", "metre"),
    ("H", "metre"),
    ("distance", "metre"),
    ("incidence angle", "degree"),
    ("ground size of the pixel", "metre"),
    ("surface: 0 terrain, else number of the object", ""),
    ("normal, east", ""),
    ("normal, north", ""),
)


@dataclass(frozen=True, eq=False)
class MatrixFile:
    """A coordinate matrix on the disk."""

    path: Path
    info: RasterInfo = field(init=False, repr=False)
    description: str = field(init=False, repr=False)
    """The view that it was made for, as `photoplan view matrix` has described it."""

    def __post_init__(self) -> None:
        info = read_info(self.path)
        with open_raster(info.path, info.driver) as file, gdal_settings():
            text = file.tags().get(DESCRIPTION)
        if text is None or len(info.colours) != len(BANDS) or info.dtype != "float64":
            raise InputError(f"{self.path}: is no coordinate matrix; make one with `photoplan view matrix`")
        object.__setattr__(self, "info", info)
        object.__setattr__(self, "description", text)

    def read(self, window: Window) -> NDArray[np.float64]:
        """All bands of a window, shape (9, height, width); NaN: sky."""
        pixels, valid = read_pixels(self.info, window)
        return np.where(True if valid is None else valid, pixels, np.nan)

"""A plain tiled TIFF becomes a cloud-optimised GeoTIFF, and finished files are checked."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.shutil

from photoplan.errors import PhotoplanError, UsageError
from photoplan.io.gdal import gdal_settings, warnings_of_gdal
from photoplan.io.storage import COMPRESSIONS

RESAMPLINGS = ("average", "mode", "nearest")


@dataclass(frozen=True)
class CogOptions:
    """How a cloud-optimised GeoTIFF is stored."""

    compress: str = "deflate"
    """`none`, `deflate`, `zstd`, `lzw` or `jpeg` (8 bit, one or three bands)."""
    overviews: bool = True
    """Reduced copies inside the file."""
    tile: int = 512
    """Side of the blocks in pixels; a multiple of 16, at least 128."""
    quality: int = 90
    """Quality of JPEG, 1 to 100."""
    level: int = 6
    """Effort of DEFLATE and ZSTD, 1 to 9."""
    threads: int = 1
    """Threads that compress."""
    resampling: str = "average"
    """How the reduced copies are made: `average`, `mode` or `nearest`."""

    def __post_init__(self) -> None:
        if self.compress not in COMPRESSIONS:
            raise UsageError(f"compression {self.compress!r}; allowed are {', '.join(COMPRESSIONS)}")
        if self.tile < 128 or self.tile % 16 or self.tile > 4096:
            raise UsageError(f"blocks of {self.tile} pixels; a multiple of 16 from 128 to 4096 is needed")
        if self.resampling not in RESAMPLINGS:
            raise UsageError(f"overviews by {self.resampling!r}; allowed are {', '.join(RESAMPLINGS)}")
        if not (1 <= self.quality <= 100 and 1 <= self.level <= 9 and self.threads >= 1):
            raise UsageError(f"quality {self.quality}, level {self.level}, threads {self.threads}; see CogOptions")

    def creation(self, dtype: np.dtype[Any]) -> dict[str, Any]:
        """Creation options of GDAL's COG driver for a type of pixels."""
        options: dict[str, Any] = {
            "compress": self.compress.upper(),
            "blocksize": self.tile,
            "overviews": "IGNORE_EXISTING" if self.overviews else "NONE",
            "overview_resampling": self.resampling.upper(),
            "bigtiff": "IF_SAFER",
            "sparse_ok": True,
            "num_threads": self.threads,
        }
        if self.compress in ("deflate", "zstd", "lzw"):
            options["predictor"] = "FLOATING_POINT" if dtype.kind == "f" else "STANDARD"
            if self.compress != "lzw":
                options["level"] = self.level
        if self.compress == "jpeg":
            options["quality"] = self.quality
        return options


def write_cog(source: Path, target: Path, options: CogOptions, dtype: np.dtype[Any]) -> None:
    """Copy a raster into a cloud-optimised GeoTIFF; memory stays low because the source is read by blocks.

    Raises
    ------
    PhotoplanError
        If GDAL complained in any way, at closing too.
    rasterio.errors.RasterioError
        If GDAL could not write.
    """
    temporary = {"CPL_TMPDIR": os.fspath(target.parent), "GDAL_TIFF_INTERNAL_MASK": True, "GDAL_PAM_ENABLED": False}
    with gdal_settings(**temporary), warnings_of_gdal() as found:
        rasterio.shutil.copy(source, target, driver="COG", **options.creation(dtype))
    if found:
        raise PhotoplanError(f"{target}: GDAL could not write it cleanly ({found[0]})")

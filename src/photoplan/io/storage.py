"""Storage of a product: nodata values, blocks of finished tiles, cloud-optimised GeoTIFFs and pictures."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio.shutil
from numpy.typing import NDArray

from photoplan.errors import PhotoplanError, UsageError
from photoplan.io.gdal import gdal_settings, warnings_of_gdal
from photoplan.kernels.raster import fill_block

COMPRESSIONS = ("none", "deflate", "zstd", "lzw", "jpeg")
PRODUCT_TYPES = ("uint8", "uint16", "int16", "float32", "float64")
Nodata = float | Literal["auto", "mask"]


def nodata_for(dtype: np.dtype[Any], wanted: Nodata, compress: str) -> float | None:
    """The nodata value of a product; None stands for a mask band.

    `auto` is 0 for unsigned integers, -32768 for int16 and NaN for floats. JPEG changes values, so it always takes a
    mask.
    """
    if wanted == "mask" or compress == "jpeg":
        return None
    if wanted == "auto":
        return {"u": 0.0, "i": -32768.0, "f": float("nan")}[dtype.kind]
    value = float(wanted)
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        if not limits.min <= value <= limits.max or value != int(value):
            raise UsageError(f"nodata {wanted}; {dtype} holds whole numbers from {limits.min} to {limits.max}")
    return value


@dataclass(frozen=True)
class BlockCoder:
    """Turns a tile (bands, h, w) into one block of a tiled TIFF: (side, side, bands), and its mask, as bytes."""

    side: int
    """Side of a block in pixels."""
    bands: int
    """Bands."""
    dtype: np.dtype[Any]
    """Type of the pixels."""
    nodata: float | None
    """Nodata value; None: a mask of one byte per pixel (0 or 255) follows the pixels."""
    lossy: bool = False
    """The compression changes values: what lies under the mask must not stand out."""

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a block's pixels."""
        return self.side * self.side * self.bands * self.dtype.itemsize

    @property
    def mask_bytes(self) -> int:
        """Bytes of a block's mask; 0 with a nodata value."""
        return self.side * self.side if self.nodata is None else 0

    def encode(self, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> tuple[bytes | memoryview, int]:
        """Bytes of a block, and how many valid values were moved because they equalled nodata.

        Such a value becomes its neighbour (nodata + 1, or nodata - 1 at the upper end of the type), so that no reader
        takes a valid dark pixel for nothing. Invalid pixels become nodata, or 0 under a mask; with a lossy compression
        they take the tile's mean, because a step to black would ring into the valid pixels beside it.
        """
        bands, height, width = pixels.shape
        valid = None if valid is None or valid.all() else valid
        block = np.empty((self.side, self.side, bands), self.dtype)
        if height < self.side or width < self.side:
            block[:] = 0 if self.nodata is None else self.nodata
        nodata, neighbour = self._kept_apart()
        fill = np.full(bands, 0 if self.nodata is None else self.nodata, self.dtype)
        if self.lossy and valid is not None and valid.any():
            fill[:] = [np.rint(band[valid].mean()) for band in pixels]
        usable = np.empty((0, 0), bool) if valid is None else np.require(valid, bool, "C")
        moved = int(fill_block(np.require(pixels, self.dtype, "C"), usable, nodata, neighbour, fill, block))
        if self.nodata is not None:
            return block.data.cast("B"), moved
        mask = np.zeros((self.side, self.side), np.uint8)
        mask[:height, :width] = 255 if valid is None else valid * np.uint8(255)
        return b"".join((block.data.cast("B"), mask.data.cast("B"))), 0

    def _kept_apart(self) -> tuple[Any, Any]:
        """The value that valid pixels must not have, and what they become; equal where nothing has to be changed."""
        number = self.dtype.type
        if self.nodata is None or self.dtype.kind == "f":
            return number(0), number(0)
        step = 1 if self.nodata < np.iinfo(self.dtype).max else -1
        return number(self.nodata), number(self.nodata + step)

    def decode(self, payload: bytes, shape: tuple[int, int]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Pixels (bands, h, w) and validity (h, w) of a block's bytes; `shape` cuts a border block."""
        block = np.frombuffer(payload[: self.pixel_bytes], self.dtype).reshape(self.side, self.side, self.bands)
        pixels = np.moveaxis(block, -1, 0)[:, : shape[0], : shape[1]]
        if self.nodata is None:
            mask = np.frombuffer(payload[self.pixel_bytes :], np.uint8).reshape(self.side, self.side)
            return pixels, mask[: shape[0], : shape[1]] > 0
        empty = np.isnan(pixels) if np.isnan(self.nodata) else pixels == self.nodata
        return pixels, ~empty.all(axis=0)


#: Formats of pictures, by the suffix of a file's name.
PICTURES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def write_picture(source: Path, target: Path, driver: str, quality: int, note: str) -> None:
    """Copy a raster of one or three bands of bytes into a PNG or JPEG, row by row."""
    options: dict[str, Any] = {"quality": quality, "comment": note} if driver == "JPEG" else {}
    if driver == "PNG":
        options = {"write_metadata_as_text": "YES", "description": note}
    with gdal_settings(GDAL_PAM_ENABLED=False), warnings_of_gdal() as found:
        rasterio.shutil.copy(source, target, driver=driver, **options)
    if found:
        raise PhotoplanError(f"{target}: GDAL could not write it cleanly ({found[0]})")


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
    """Copy a raster into a cloud-optimised GeoTIFF; memory stays low because the source is read by blocks."""
    temporary = {"CPL_TMPDIR": os.fspath(target.parent), "GDAL_TIFF_INTERNAL_MASK": True, "GDAL_PAM_ENABLED": False}
    with gdal_settings(**temporary), warnings_of_gdal() as found:
        rasterio.shutil.copy(source, target, driver="COG", **options.creation(dtype))
    if found:
        raise PhotoplanError(f"{target}: GDAL could not write it cleanly ({found[0]})")

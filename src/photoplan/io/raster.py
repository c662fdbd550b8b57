"""Source images, read by windows from several threads."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.windows
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.checks import DRIVER_NAMES, IMAGE_LIMITS, RasterLimits
from photoplan.io.decoded import SEQUENTIAL, DecodedPicture, decoded_picture
from photoplan.io.deflate_check import damaged_block
from photoplan.io.gdal import GDAL_ERRORS, all_causes, close_handles, damage_in, gdal_settings, handle, warnings_of_gdal
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.tiff_layout import read_tiff_layout
from photoplan.io.validity import MissingBlocks, finite, not_nodata

IMAGE_TYPES = ("uint8", "uint16", "int16", "float32")
"""Types of the pixels of source images."""

_SMALL = 16 << 20
"""Decoded bytes up to which a picture is left to GDAL's block cache."""
_NOT_RGB = (5, 8, 9, 10)
"""TIFF photometric interpretations: CMYK and the kinds of CIELab."""


@dataclass(frozen=True, eq=False)
class RasterReader:
    """A source image behind the engine's `Reader`; any side length, read by windows only.

    Safe to call from several threads (each has its own handle) and to pickle. Pixels keep their type and are used as
    they are stored; a palette is expanded to its three colours. See `photoplan.io.validity` for the rule of validity.

    Raises
    ------
    InputError
        When made: whatever `read_info` refuses, a type of pixels or a colour model that cannot be used. When read:
        damaged pixels, with file, band and window.
    """

    path: Path
    """The file."""
    limits: RasterLimits = IMAGE_LIMITS
    """How much its header may promise."""
    allow_remote: bool = False
    """Follow virtual rasters, `/vsi…` paths and URLs."""
    info: RasterInfo = field(init=False, repr=False)
    """Facts of the file."""
    _missing: MissingBlocks | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        info = read_info(self.path, limits=self.limits, allow_remote=self.allow_remote)
        _check_image(info)
        object.__setattr__(self, "path", info.path)
        object.__setattr__(self, "info", info)
        object.__setattr__(self, "_missing", missing_blocks(info))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.info.size

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.info.bands

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return np.dtype(self.info.dtype)

    def read(self, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity.

        The validity has shape (height, width), True = valid; None means that every pixel is valid.
        """
        pixels, valid = read_pixels(self.info, window, self._missing)
        if self.info.palette:
            pixels, opaque = _expand(self.info, pixels[0])
            valid = _both(valid, opaque)
        return pixels, valid


def missing_blocks(info: RasterInfo) -> MissingBlocks | None:
    """Blocks that were never written; None if there are none.

    Where a nodata value is declared GDAL fills them with it, and the rule of nodata applies.
    """
    if not info.missing_blocks or info.nodata is not None:
        return None
    layout = read_tiff_layout(info.path)
    return MissingBlocks(layout.block, np.logical_not(layout.present.all(axis=0)))


def read_pixels(
    info: RasterInfo, window: Window, missing: MissingBlocks | None = None
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Stored values of the bands without alpha, shape (bands, h, w), and the validity by the one rule (None: all).

    Parameters
    ----------
    info
        The file.
    window
        Pixels inside the file.
    missing
        What `missing_blocks` said of the file.

    Raises
    ------
    UsageError
        If the window is empty or leaves the raster.
    InputError
        If the pixels cannot be read or are damaged, with file, band and window.
    """
    if window.size == 0 or window.col < 0 or window.row < 0 or np.any(np.array(window.stop) > info.size):
        raise UsageError(f"{info.path}: {window} is not inside the raster of {info.size[0]} × {info.size[1]} pixels")
    count = len(info.colour_bands)
    if _decode_once(info):
        state = info.path.stat()
        picture = decoded_picture((info.path, state.st_mtime_ns, state.st_ino), partial(_decode, info))
        stored, valid = picture.read(window), None
    else:
        stored, valid = _from_file(info, window)
    pixels = stored[:count]
    if info.alpha_bands:
        valid = _both(valid, np.logical_and.reduce(stored[count:] > 0))
    valid = _both(valid, not_nodata(pixels, info.nodata))
    valid = _both(valid, finite(pixels))
    if missing is not None:
        valid = _both(valid, missing.written(window))
    return pixels, None if valid is None or valid.all() else valid


def _from_file(info: RasterInfo, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Colour bands, then alpha bands, shape (bands, h, w), and the mask of the file (None: there is none)."""
    area = rasterio.windows.Window(window.col, window.row, window.width, window.height)
    band, mask = "all", None
    torn = damaged_block(info.path, window) if info.driver == "GTiff" and info.path.is_file() else None
    if torn is not None:
        raise _damaged(info.path, window, band, [torn])
    try:
        with gdal_settings(), warnings_of_gdal() as found:
            dataset = handle(info.path, info.driver if info.driver in DRIVER_NAMES else None)
            pixels = dataset.read([*info.colour_bands, *info.alpha_bands], window=area)
            if info.has_mask:
                band = "mask"
                mask = (dataset.read_masks(window=area) > 0).all(axis=0)
    except (*GDAL_ERRORS, OSError) as error:
        raise _damaged(info.path, window, band, all_causes(error)) from error
    damage = damage_in(found)
    if damage:
        raise _damaged(info.path, window, band, [damage])
    return pixels, mask


def _decode_once(info: RasterInfo) -> bool:
    """Whether a picture is large and of a format that is decoded from the top."""
    width, height = info.size
    pixel = len(info.colours) * np.dtype(info.dtype).itemsize
    large = width * height * pixel > _SMALL and os.name == "posix"
    return large and info.driver in SEQUENTIAL and not info.has_mask and info.path.is_file()


def _decode(info: RasterInfo) -> DecodedPicture:
    """Decode a whole picture; this thread's handle, which holds its decoder, is closed again."""
    bands = len(info.colour_bands) + len(info.alpha_bands)
    picture = DecodedPicture(info.size, bands, np.dtype(info.dtype), lambda window: _from_file(info, window)[0])
    close_handles()
    return picture


def _both(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Both masks hold; None stands for "everywhere"."""
    if a is None or b is None:
        return b if a is None else a
    return np.logical_and(a, b)


def _damaged(path: Path, window: Window, band: str, causes: list[str]) -> InputError:
    """The error of pixels that cannot be read."""
    named = re.search(r"band (\d+)", " ".join(causes))
    return InputError(
        f"{path}: band {named.group(1) if named else band}, window col {window.col} row {window.row} "
        f"{window.width} × {window.height}: the pixels cannot be read ({causes[0]}); the file is damaged or cut off, "
        "get a fresh copy"
    )


def _check_image(info: RasterInfo) -> None:
    """Refuse what cannot be an image's pixels, each by its name."""
    path, advice = info.path, "convert it with"
    cmyk = info.colour_space in ("CMYK", "YCCK") or {"cyan", "magenta", "yellow", "black"} & set(info.colours)
    if cmyk or (info.driver == "GTiff" and path.is_file() and read_tiff_layout(path).photometric in _NOT_RGB):
        raise InputError(f"{path}: CMYK or CIELab colours; {advice} an image program to RGB")
    if {"Y", "Cb", "Cr", "hue", "saturation", "lightness"} & set(info.colours):
        raise InputError(f"{path}: colours {', '.join(info.colours)}; {advice} an image program to RGB")
    if info.bits == 1:
        raise InputError(f"{path}: 1-bit image; {advice} `gdal_translate -ot Byte -scale 0 1 0 255`")
    if info.dtype not in IMAGE_TYPES:
        raise InputError(
            f"{path}: pixels of type {info.dtype}; allowed are {', '.join(IMAGE_TYPES)}. "
            "Convert it with `gdal_translate -ot UInt16` or `-ot Float32`"
        )
    if not info.colour_bands:
        raise InputError(f"{path}: holds nothing but alpha; give the image itself")
    if any(colour == "palette" for colour in info.colours) and not info.palette:
        raise InputError(f"{path}: a colour table beside other bands; {advice} `gdal_translate -expand rgb`")


def _expand(info: RasterInfo, index: NDArray[Any]) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Colours (3, h, w) that the indices of a palette stand for, and where they are opaque."""
    with gdal_settings():
        table = handle(info.path, info.driver).colormap(info.colour_bands[0])
    lut = np.zeros((max(max(table) + 1, int(index.max()) + 1), 4), np.uint8)
    for entry, colour in table.items():
        lut[entry] = colour
    rgba = lut[index]
    opaque = rgba[..., 3] > 0
    return np.ascontiguousarray(np.moveaxis(rgba[..., :3], -1, 0)), None if opaque.all() else opaque

"""Stored pixels of raster files, read by windows from several threads."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.windows
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.checks import DRIVER_NAMES
from photoplan.io.decoded import SEQUENTIAL, DecodedPicture, decoded_picture
from photoplan.io.deflate_check import damaged_block
from photoplan.io.gdal import GDAL_ERRORS, all_causes, close_handles, damage_in, gdal_settings, handle, warnings_of_gdal
from photoplan.io.raster_info import RasterInfo
from photoplan.io.tiff_layout import read_tiff_layout
from photoplan.io.validity import MissingBlocks, finite, not_nodata

_SMALL = 16 << 20
"""Decoded bytes up to which a picture is left to GDAL's block cache."""


def missing_blocks(info: RasterInfo) -> MissingBlocks | None:
    """Blocks that were never written; None if there are none.

    Where a nodata value is declared GDAL fills them with it, and the rule of nodata applies.
    """
    if not info.missing_blocks or info.nodata is not None:
        return None
    layout = read_tiff_layout(info.path)
    return MissingBlocks(layout.block, np.logical_not(layout.present.all(axis=0)))


def read_pixels(
    info: RasterInfo,
    window: Window,
    missing: MissingBlocks | None = None,
    overview: tuple[int, tuple[int, int]] | None = None,
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
    overview
        Number and size of the overview that is read instead; None: the raster itself.

    Raises
    ------
    UsageError
        If the window is empty or leaves the raster.
    InputError
        If the pixels cannot be read or are damaged, with file, band and window.
    """
    size = info.size if overview is None else overview[1]
    if window.size == 0 or window.col < 0 or window.row < 0 or np.any(np.array(window.stop) > size):
        raise UsageError(f"{info.path}: {window} is not inside the raster of {size[0]} × {size[1]} pixels")
    count = len(info.colour_bands)
    if overview is not None:
        stored, valid = _from_file(info, window, overview[0])
    elif _decode_once(info):
        state = info.path.stat()
        picture = decoded_picture((info.path, state.st_mtime_ns, state.st_ino), partial(_decode, info))
        stored, valid = picture.read(window), None
    else:
        stored, valid = _from_file(info, window)
    pixels = stored[:count]
    if info.alpha_bands:
        valid = both(valid, np.logical_and.reduce(stored[count:] > 0))
    valid = both(valid, not_nodata(pixels, info.nodata))
    valid = both(valid, finite(pixels))
    if missing is not None:
        valid = both(valid, missing.written(window))
    return pixels, None if valid is None or valid.all() else valid


def _from_file(
    info: RasterInfo, window: Window, overview: int | None = None
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Colour bands, then alpha bands, shape (bands, h, w), and the mask of the file (None: there is none)."""
    area = rasterio.windows.Window(window.col, window.row, window.width, window.height)
    band, mask = "all", None
    torn = None
    if overview is None and info.driver == "GTiff" and info.path.is_file():
        torn = damaged_block(info.path, window)
    if torn is not None:
        raise _damaged(info.path, window, band, [torn])
    try:
        with gdal_settings(), warnings_of_gdal() as found:
            dataset = handle(info.path, info.driver if info.driver in DRIVER_NAMES else None, overview)
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


def both(a: NDArray[np.bool_] | None, b: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
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

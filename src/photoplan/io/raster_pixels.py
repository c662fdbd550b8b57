"""Stored pixels of raster files, read by windows from several threads."""

from __future__ import annotations

import os
import re
import tempfile
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import IO, Any

import numpy as np
import rasterio.windows
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.checks import DRIVER_NAMES
from photoplan.io.disk import disk_error, write_all
from photoplan.io.gdal import GDAL_ERRORS, all_causes, close_handles, damage_in, gdal_settings, handle, warnings_of_gdal
from photoplan.io.raster_info import RasterInfo
from photoplan.io.tiff_layout import TiffLayout, read_tiff_layout
from photoplan.io.validity import MissingBlocks, finite, not_nodata

#: Codes of the two DEFLATE compressions of TIFF.
_DEFLATE = (8, 32946)
#: Bytes that are decoded at once while a block is checked.
_PIECE = 1 << 20


@dataclass(frozen=True, eq=False)
class _Blocks:
    """The blocks of one file."""

    layout: TiffLayout
    todo: NDArray[np.bool_]
    """Which blocks have not been checked, (planes, rows, columns). Two threads may check one block: no harm."""


@lru_cache(maxsize=256)
def _blocks(path: Path, mtime_ns: int, inode: int) -> _Blocks | None:
    """State of a file as it is now; None if its blocks carry no checksum."""
    layout = read_tiff_layout(path)
    return _Blocks(layout, layout.present.copy()) if layout.compression in _DEFLATE else None


def damaged_block(path: Path, window: Window, pixels: NDArray[Any]) -> str | None:
    """What is wrong with the first damaged block under a window of a TIFF; None if all are whole.

    `pixels` (bands, h, w) are what was read of the window. If they are one block, they are compared with its checksum;
    any other block, and one that does not agree, is decoded once per process for this, and not kept. Files with another
    compression have no checksum and pass.
    """
    state = path.stat()
    blocks = _blocks(path, state.st_mtime_ns, state.st_ino)
    if blocks is None:
        return None
    layout = blocks.layout
    width, height = layout.block
    right, bottom = window.stop
    rows, cols = slice(window.row // height, -(-bottom // height)), slice(window.col // width, -(-right // width))
    todo = np.argwhere(blocks.todo[:, rows, cols]) + np.array([0, rows.start, cols.start])
    if not len(todo):
        return None
    across, down = layout.grid
    with path.open("rb") as file:
        for plane, row, col in todo.tolist():
            index = (plane * down + row) * across + col
            start, count = int(layout.offsets[index]), int(layout.counts[index])
            file.seek(start + count - 4)
            if window == Window(col * width, row * height, *layout.block) and _agree(pixels, layout, file.read(4)):
                blocks.todo[plane, row, col] = False
                continue
            file.seek(start)
            if not _whole(file.read(count)):
                band = f" of band {plane + 1}" if layout.planar else ""
                return f"the block at column {col * width}, row {row * height}{band} does not agree with its checksum"
            blocks.todo[plane, row, col] = False
    return None


def _agree(pixels: NDArray[Any], layout: TiffLayout, checksum: bytes) -> bool:
    """Whether the pixels of a block of one band are surely those that a checksum (Adler-32) was made of.

    They are brought into the order and the differences that were compressed, which is faster than decoding.
    """
    bands, height, width = pixels.shape
    if bands != 1 or layout.samples != 1:
        return False
    stored = pixels[0].view(f"u{pixels.itemsize}")
    if layout.predictor == 3:
        # The bytes of a line, those of all signs and exponents first.
        planes = stored.view(np.uint8).reshape(height, width, -1)[..., ::-1]
        stored = np.ascontiguousarray(planes.transpose(0, 2, 1)).reshape(height, -1)
    if layout.predictor > 1:
        differences = stored.copy()
        differences[:, 1:] -= stored[:, :-1]
        stored = differences
    return zlib.adler32(np.ascontiguousarray(stored).data) == int.from_bytes(checksum, "big")


def _whole(stored: bytes) -> bool:
    """Whether a zlib stream decodes to its end and agrees with its checksum."""
    stream = zlib.decompressobj()
    try:
        piece = stream.decompress(stored, _PIECE)
        while piece and not stream.eof:
            piece = stream.decompress(stream.unconsumed_tail, _PIECE)
    except zlib.error:
        return False
    return stream.eof


SEQUENTIAL = ("JPEG", "PNG")
"""Formats that are decoded from the top."""
_KEPT = 2
_CHUNK = 8 << 20


class DecodedPicture:
    """Pixels of a picture in a temporary file that has no name and ends with its last user."""

    def __init__(
        self, size: tuple[int, int], bands: int, dtype: np.dtype[Any], read: Callable[[Window], NDArray[Any]]
    ) -> None:
        self._size, self._bands, self._dtype = size, bands, dtype
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="photoplan-", buffering=0)  # noqa: SIM115
        width, height = size
        rows = max(1, _CHUNK // (width * bands * dtype.itemsize))
        try:
            for row in range(0, height, rows):
                pixels = read(Window(0, row, width, min(rows, height - row)))
                block = np.empty((pixels.shape[1], width, bands), dtype)
                for band in range(bands):
                    block[..., band] = pixels[band]
                write_all(self._file.fileno(), block.data)
        except OSError as error:
            raise disk_error(Path(tempfile.gettempdir()) / "photoplan", error) from error

    def read(self, window: Window) -> NDArray[Any]:
        """Pixels of a window inside the picture, shape (bands, height, width)."""
        pixel = self._bands * self._dtype.itemsize
        block = np.empty((window.height, window.width, self._bands), self._dtype)
        for i in range(window.height):
            start = ((window.row + i) * self._size[0] + window.col) * pixel
            os.preadv(self._file.fileno(), [block[i].data], start)
        pixels = np.empty((self._bands, window.height, window.width), self._dtype)
        for band in range(self._bands):
            pixels[band] = block[..., band]
        return pixels


_lock = threading.Lock()
_pictures: OrderedDict[tuple[Any, ...], DecodedPicture] = OrderedDict()
_busy: dict[tuple[Any, ...], threading.Lock] = {}


def decoded_picture(key: tuple[Any, ...], make: Callable[[], DecodedPicture]) -> DecodedPicture:
    """The decoded picture of a key; made once, while other threads that want it wait.

    The two used last are kept; one that falls out lives on until its readers are done.
    """
    with _lock:
        busy = _busy.setdefault(key, threading.Lock())
    with busy:
        with _lock:
            found = _pictures.get(key)
            if found is not None:
                _pictures.move_to_end(key)
                return found
        found = make()
        with _lock:
            _pictures[key] = found
            while len(_pictures) > _KEPT:
                _busy.pop(_pictures.popitem(last=False)[0], None)
        return found


_SMALL = 16 << 20
"""Decoded bytes up to which a picture is left to GDAL's block cache."""
_TOP = 64
"""Upper rows of a picture that are decoded for themselves: it costs next to nothing."""


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
    """Stored values of the bands without alpha, shape (bands, h, w), and the validity by the one rule (None: all)."""
    size = info.size if overview is None else overview[1]
    if window.size == 0 or window.col < 0 or window.row < 0 or np.any(np.array(window.stop) > size):
        raise UsageError(f"{info.path}: {window} is not inside the raster of {size[0]} × {size[1]} pixels")
    count = len(info.colour_bands)
    if overview is not None:
        stored, valid = _from_file(info, window, overview[0])
    elif window.stop[1] > _TOP and _decode_once(info):
        state, order = info.path.stat(), info.colour_bands + info.alpha_bands
        picture = decoded_picture((info.path, state.st_mtime_ns, state.st_ino, order), partial(_decode, info))
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
    if not damage and overview is None and info.driver == "GTiff" and info.path.is_file():
        damage = damaged_block(info.path, window, pixels)
    if damage:
        raise _damaged(info.path, window, "all", [damage])
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

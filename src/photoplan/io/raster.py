"""Reading raster files: checks, blocks, masks, overviews; heights of grid models larger than memory."""

from __future__ import annotations

import os
import re
import tempfile
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import numpy as np
import rasterio
import rasterio.io
import rasterio.shutil
import rasterio.windows
from numpy.typing import NDArray

from photoplan.arrays import Floats, Floats32, Mask
from photoplan.errors import InputError, PhotoplanError, UsageError
from photoplan.geometry.grid import FullSize, Pixels, Window, level_size, means, reduced
from photoplan.geometry.units import MetricSystem, agreed_metres, metres_in, metric_system, unit_label
from photoplan.io.disk import (
    GDAL_ERRORS,
    all_causes,
    close_handles,
    damage_in,
    disk_error,
    gdal_settings,
    handle,
    library_error,
    not_georeferenced,
    warnings_of_gdal,
    write_all,
)
from photoplan.io.files import DRIVER_NAMES, IMAGE_LIMITS, TERRAIN_LIMITS, RasterLimits
from photoplan.io.raster_info import RasterInfo, TiffLayout, read_info, read_tiff_layout
from photoplan.io.store import give_name, scratch


class BlockCache:
    """Arrays by key, at most `limit` bytes of them; safe to use from several threads.

    A block that two threads want at once may be loaded twice; it is kept once.
    """

    def __init__(self, limit: int) -> None:
        if limit < 0:
            raise UsageError(f"a block cache of {limit} bytes; the limit must not be negative")
        self._limit = limit
        self._blocks: OrderedDict[Hashable, NDArray[Any]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Bytes held now; never above the limit."""
        return self._bytes

    def get(self, key: Hashable, load: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """The block of a key; `load` makes it when it is not held. The block must not be changed."""
        with self._lock:
            block = self._blocks.get(key)
            if block is not None:
                self._blocks.move_to_end(key)
                return block
        block = load()
        block.setflags(write=False)
        with self._lock:
            if key not in self._blocks and block.nbytes <= self._limit:
                self._blocks[key] = block
                self._bytes += block.nbytes
                while self._bytes > self._limit:
                    self._bytes -= self._blocks.popitem(last=False)[1].nbytes
        return block

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._blocks.clear()
            self._bytes = 0


USUAL_NODATA = (-9999.0, -32768.0, -32767.0, -99999.0)
"""Values that mean "nothing here" in files that do not declare it."""
_LOWEST_FLOAT = float(np.finfo(np.float32).min)


def not_nodata(pixels: NDArray[Any], nodata: float | None) -> Mask | None:
    """Where not all bands of `pixels` (bands, h, w) equal `nodata`; None if that is everywhere.

    A nodata value that the type cannot hold (-9999 for bytes) is never met.
    """
    if nodata is None or np.isnan(nodata):
        return None
    if pixels.dtype.kind in "iu":
        limits = np.iinfo(pixels.dtype)
        if not limits.min <= nodata <= limits.max or nodata != int(nodata):
            return None
    value = pixels.dtype.type(nodata)
    empty = pixels[0] == value
    for band in pixels[1:]:
        if not empty.any():
            return None
        empty &= band == value
    return ~empty if empty.any() else None


def refuse_undeclared(path: Path, window: Window, pixels: NDArray[Any], valid: Mask | None) -> None:
    """Refuse valid pixels (bands, h, w) of signed type that are one of the usual nodata values in all bands.

    Resampled as grey values they would spoil their surroundings without a word.
    """
    if (
        pixels.dtype.kind not in "if"
        or not pixels.size
        or not np.fmin.reduce(pixels[0], axis=None) <= max(USUAL_NODATA)
    ):
        return
    for value in (*USUAL_NODATA, _LOWEST_FLOAT) if pixels.dtype.kind == "f" else USUAL_NODATA:
        kept = not_nodata(pixels, value)
        count = 0 if kept is None else int((~kept if valid is None else ~kept & valid).sum())
        if count:
            raise InputError(
                f"{path}: {count} pixels in window col {window.col} row {window.row} {window.width} × "
                f"{window.height} are {value:g}, the usual nodata; declare it (`gdal_edit -a_nodata {value:g}`)"
            )


def finite(pixels: NDArray[Any]) -> Mask | None:
    """Where all bands of `pixels` (bands, h, w) are finite; None if that is everywhere."""
    if pixels.dtype.kind != "f":
        return None
    good = np.isfinite(pixels).all(axis=0)
    return None if good.all() else good


@dataclass(frozen=True, eq=False)
class MissingBlocks:
    """Blocks of a sparse file that were never written."""

    block: tuple[int, int]
    """Width and height of a block."""
    gone: Mask
    """True = never written; shape (rows, columns) of blocks."""

    def written(self, window: Window) -> Mask | None:
        """Where the pixels of a window lie in written blocks; None if that is everywhere."""
        rows = np.arange(window.row, window.row + window.height) // self.block[1]
        cols = np.arange(window.col, window.col + window.width) // self.block[0]
        if not self.gone[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1].any():
            return None
        return np.logical_not(self.gone[np.ix_(rows, cols)])


#: Codes of the two DEFLATE compressions of TIFF.
_DEFLATE = (8, 32946)
#: Bytes that are decoded at once while a block is checked.
_PIECE = 1 << 20


@dataclass(frozen=True, eq=False)
class _Blocks:
    """The blocks of one file."""

    layout: TiffLayout
    todo: Mask
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
) -> tuple[NDArray[Any], Mask | None]:
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


def _from_file(info: RasterInfo, window: Window, overview: int | None = None) -> tuple[NDArray[Any], Mask | None]:
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


def both(a: Mask | None, b: Mask | None) -> Mask | None:
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


IMAGE_TYPES = ("uint8", "uint16", "int16", "float32")
"""Types of the pixels of source images."""

_NOT_RGB = (5, 8, 9, 10)
"""TIFF photometric interpretations: CMYK and the kinds of CIELab."""
_SIDE = 256
"""Of a block of a reduced image. Each is made once: tiles of a coarse product overlap in the source."""
_blocks_raster = BlockCache(48 << 20)


def reduced_by_blocks(key: Hashable, reader: FullSize, window: Window, level: int) -> Pixels:
    """A window of an image that is reduced by 2^level, see `geometry.levels.reduced`."""
    if level == 0:
        return reader.read(window)
    whole = Window(0, 0, *level_size(reader.size, level))
    values = np.empty((reader.bands, window.height, window.width), reader.dtype)
    valid = np.ones((window.height, window.width), bool)
    for row in range(window.row // _SIDE, -(-window.stop[1] // _SIDE)):
        for col in range(window.col // _SIDE, -(-window.stop[0] // _SIDE)):
            block = Window(col * _SIDE, row * _SIDE, _SIDE, _SIDE) & whole

            def load(block: Window = block) -> np.ndarray:
                pixels, good = reduced(reader, block, level)
                # The validity travels as one band more.
                return pixels if good is None else np.concatenate([pixels, good[None].astype(pixels.dtype)])

            kept = _blocks_raster.get((key, level, block), load)
            part = block & window
            to, of = part.slices(window), part.slices(block)
            values[:, to[0], to[1]] = kept[: reader.bands, of[0], of[1]]
            if len(kept) > reader.bands:
                valid[to] = kept[-1][of] > 0
    return values, None if valid.all() else valid


@dataclass(frozen=True, eq=False)
class RasterReader:
    """A source image behind the engine's `Reader`; any side length, read by windows only.

    Safe to call from several threads (each has its own handle) and to pickle. Pixels keep their type and are used as
    they are stored; a palette is expanded to its three colours. See `photoplan.io.raster` for the rule of validity. A
    band that is tagged as alpha is a colour band if its values are those of a picture, see `with_alpha_judged`.
    """

    path: Path
    """The file."""
    limits: RasterLimits = IMAGE_LIMITS
    """How much its header may promise."""
    allow_remote: bool = False
    """Follow virtual rasters, `/vsi…` paths and URLs."""
    alpha: bool | None = None
    """Whether bands that are tagged as alpha are masks; None: their values decide."""
    info: RasterInfo = field(init=False, repr=False)
    """Facts of the file."""
    _missing: MissingBlocks | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        info = read_info(self.path, limits=self.limits, allow_remote=self.allow_remote)
        _check_image(info)
        info = with_alpha_judged(info, self.alpha)
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

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], Mask | None]:
        """Pixels of a window and their validity, see `engine.base.Reader`; from the file's overviews where it can."""
        if level:
            overview = best_overview(self.info, level)
            state = self.path.stat() if self.path.is_file() else None
            key = (self.path, overview is None, None if state is None else (state.st_mtime_ns, state.st_ino))
            if overview is None:
                return reduced_by_blocks(key, self, window, level)
            return reduced_by_blocks(key, overview, window, level - overview.level)
        pixels, valid = read_pixels(self.info, window, self._missing)
        if self.info.palette:
            pixels, opaque = _expand(self.info, pixels[0])
            valid = both(valid, opaque)
        if self.info.nodata is None:
            refuse_undeclared(self.path, window, pixels, valid)
        return pixels, valid


#: Places of an image whose alpha is judged (along each side), their side, and the width of soft borders, pixels.
_LOOKS, _LOOK, _SOFT = 3, 256, 8
#: Part of the pixels away from borders that a mask makes opaque; values besides 0 and opaque that a mask may have.
_OPAQUE, _LEVELS = 0.75, 8


def with_alpha_judged(info: RasterInfo, alpha: bool | None = None) -> RasterInfo:
    """The facts of an image, with alpha bands that hold a picture among the colour bands.

    Some programs tag the fourth band of every image as alpha, also near infrared. A mask is 0 or opaque (the highest
    value there is), except at soft borders next to 0; it has few other values. A picture has many, in most pixels.
    """
    if not info.alpha_bands or alpha is True or not info.colour_bands:
        return info
    width, height = info.size
    looks = []
    for row in range(_LOOKS):
        for col in range(_LOOKS):
            at = [max(0, int((k + 0.5) / _LOOKS * side - _LOOK / 2)) for k, side in ((col, width), (row, height))]
            looks.append(Window(at[0], at[1], min(_LOOK, width - at[0]), min(_LOOK, height - at[1])))
    count = len(info.alpha_bands)
    # In the order in which the file is read otherwise: a picture may be decoded once for all.
    plain = replace(
        info, colour_bands=info.colour_bands + info.alpha_bands, alpha_bands=(), nodata=None, has_mask=False
    )
    wrong = set(info.alpha_bands)
    if alpha is None:
        seen = [read_pixels(plain, window)[0][-count:] for window in dict.fromkeys(looks)]
        wrong = {band for k, band in enumerate(info.alpha_bands) if _is_picture([pixels[k] for pixels in seen])}
    return replace(
        info,
        colour_bands=tuple(sorted({*info.colour_bands, *wrong})),
        alpha_bands=tuple(band for band in info.alpha_bands if band not in wrong),
        colours=tuple("undefined" if n in wrong else colour for n, colour in enumerate(info.colours, 1)),
        colour_despite_tag=() if alpha is False else tuple(sorted(wrong)),
    )


def _is_picture(looks: list[NDArray[Any]]) -> bool:
    """Whether parts of an alpha band (h, w) have many values away from soft borders."""
    from scipy.ndimage import maximum_filter  # noqa: PLC0415 - few images have alpha

    opaque = max(float(np.nanmax(part)) for part in looks)
    inner, every = [], []
    for part in looks:
        near_zero = maximum_filter((part == 0).astype(np.uint8), 2 * _SOFT + 1) > 0
        every.append(part[part != 0])
        inner.append(part[(part != 0) & ~near_zero])
    values = np.concatenate(inner)
    # Zeros that are strewn all over leave nothing away from them.
    values = values if 4 * len(values) > sum(map(len, every)) else np.concatenate(every)
    between = values[values != opaque]
    return len(between) > (1 - _OPAQUE) * len(values) and len(np.unique(between)) > _LEVELS


def pixels_of_dataset(source: Any) -> RasterReader | np.ma.MaskedArray[Any, Any] | None:
    """A dataset that is open in rasterio, read by windows from its file, or whole where it lives in memory.

    None: it is no dataset.
    """
    if not isinstance(source, rasterio.io.DatasetReader):
        return None
    path = Path(source.name)
    return RasterReader(path) if path.is_file() else source.read(masked=True)


def stated_classes(info: RasterInfo) -> tuple[Path, ...] | None:
    """Return the files beside a raster by which its values are numbers of classes; None if they are not.

    A colour table, category names or a thematic attribute table state so, for one band of whole numbers.
    """
    if info.palette:
        return ()
    if len(info.colour_bands) != 1 or np.dtype(info.dtype).kind not in "iu":
        return None
    table, aux = (info.path.with_name(info.path.name + suffix) for suffix in (".vat.dbf", ".aux.xml"))
    if table.is_file():
        return (table,)
    # GDAL hands out names of categories in no other way than as text.
    place = f"/vsimem/{uuid4().hex}.vrt"
    with gdal_settings(), not_georeferenced():
        rasterio.shutil.copy(handle(info.path, info.driver), place, driver="VRT")
        try:
            with rasterio.open(place) as described:
                text = described.tags(ns="xml:VRT")["xml:VRT"]
        finally:
            rasterio.shutil.delete(place, driver="VRT")
    if "<CategoryNames>" in text or ("<GDALRasterAttributeTable" in text and 'tableType="thematic"' in text):
        return (aux,) if aux.is_file() else ()
    return None


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


def _expand(info: RasterInfo, index: NDArray[Any]) -> tuple[NDArray[np.uint8], Mask | None]:
    """Colours (3, h, w) that the indices of a palette stand for, and where they are opaque."""
    with gdal_settings():
        table = handle(info.path, info.driver).colormap(info.colour_bands[0])
    lut = np.zeros((max(max(table) + 1, int(index.max()) + 1), 4), np.uint8)
    for entry, colour in table.items():
        lut[entry] = colour
    rgba = lut[index]
    opaque = rgba[..., 3] > 0
    return np.ascontiguousarray(np.moveaxis(rgba[..., :3], -1, 0)), None if opaque.all() else opaque


_COMPARED = 64
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
    """The overview that saves most on the way to a level; None if there is none that can be used."""
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
        side = (min(_COMPARED, width - 1), min(_COMPARED, height - 1))
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
    return beside <= 0.25 * spread + (0.0 if overview.dtype.kind == "f" else 4.0 * len(_PLACES) * _COMPARED**2)


_TYPES = ("uint8", "uint16", "int16", "float32")


def write_whole_image(path: Path, values: NDArray[Any], tags: Mapping[str, str] | None = None) -> None:
    """Write an image without place on the map and without nodata: every value is a value."""
    bands = values[None] if values.ndim == 2 else values
    if bands.ndim != 3 or bands.dtype.name not in _TYPES:
        raise UsageError(f"{path}: pixels of type {bands.dtype}, shape {values.shape}; allowed are {', '.join(_TYPES)}")
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": bands.shape[2],
        "height": bands.shape[1],
        "count": bands.shape[0],
        "dtype": bands.dtype.name,
        "compress": "deflate",
        "predictor": 3 if bands.dtype.kind == "f" else 2,
        "bigtiff": "IF_SAFER",
    }
    if min(bands.shape[1:]) >= 256:
        profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256}
    try:
        with scratch(path.parent) as folder:
            part = folder / "part.tif"
            with gdal_settings(GDAL_PAM_ENABLED=False), rasterio.open(part, "w", **profile) as dataset:
                dataset.write(bands)
                dataset.update_tags(**dict(tags or {}))
            _check(part, bands, path)
            give_name(part, path)
    except OSError as error:
        raise disk_error(path, error) from error
    except GDAL_ERRORS as error:
        raise library_error(path, error) from error


def _check(part: Path, bands: NDArray[Any], path: Path) -> None:
    """Read the file again: a late error of the disk would show in its last block."""
    with gdal_settings(), rasterio.open(part) as dataset:
        last = dataset.read(window=rasterio.windows.Window(0, bands.shape[1] - 1, bands.shape[2], 1))
    if not np.array_equal(last[:, 0], bands[:, -1], equal_nan=bands.dtype.kind == "f"):
        raise PhotoplanError(f"{path}: the last line was not kept on the disk; run the command again")


LOWEST, HIGHEST = -12_000.0, 9_000.0
"""Heights of the Earth, metres: below the deepest sea, above the highest mountain."""
TERRAIN_TYPES = ("uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
"""Types of stored heights."""

_BLOCK = 256
_VOID = 1e30
"""Numbers of this size (±3.4e38 of many programs) are never heights."""
_PLAIN = -9_000.0
"""Above this, metres, no value can be a usual nodata value."""


@dataclass(frozen=True, eq=False)
class TerrainReader:
    """One band of heights, delivered as float32 with NaN where there is none.

    Scale and offset of the file are applied, and heights are brought into metres upwards from the unit of the band, of
    the reference system, or of the declared height system. Overviews are not used. Blocks that were read are kept up
    to `cache_bytes`, least recently used ones are forgotten first. Safe to call from several threads and to pickle (the
    cache stays behind).

    Nodata, alpha, mask and blocks that were never written follow the rule of `photoplan.io.raster`; NaN and values
    of ±1e30 and more are void as well. Other values that are no height on Earth (below -12 000 m or above 9 000 m), and
    the usual nodata values where none is declared, are refused with their count.
    """

    path: Path
    """The file."""
    crs: str | None = None
    """CRS of a file that states none."""
    height_system: str | None = None
    """Declared height system: it is used instead of the file's."""
    cache_bytes: int = 64 << 20
    """Bytes of blocks that are kept."""
    limits: RasterLimits = TERRAIN_LIMITS
    """How much the header may promise."""
    allow_remote: bool = False
    """Follow virtual rasters, `/vsi…` paths and URLs."""
    info: RasterInfo = field(init=False, repr=False)
    """Facts of the file."""
    system: MetricSystem | None = field(init=False, repr=False)
    """Reference system in metres, and what leads the file's coordinates there; None: no CRS is stated or declared."""
    metres: float = field(init=False, repr=False)
    """Metres upwards in the unit of the file's heights; negative for depths."""
    _missing: MissingBlocks | None = field(init=False, repr=False)
    _cache: BlockCache = field(init=False, repr=False)

    def __post_init__(self) -> None:
        info = read_info(self.path, limits=self.limits, allow_remote=self.allow_remote)
        if len(info.colour_bands) != 1 or info.palette:
            raise InputError(f"{info.path}: {len(info.colours)} bands or a palette; a terrain grid has one band")
        if info.dtype not in TERRAIN_TYPES:
            raise InputError(
                f"{info.path}: heights of type {info.dtype}; allowed are {', '.join(TERRAIN_TYPES)}. "
                "Convert it with `gdal_translate -ot Float32`"
            )
        if info.to_map is None:
            raise InputError(f"{info.path}: the grid is not georeferenced; give it a world file or a geotransform")
        if info.contradiction is not None:
            raise InputError(f"{info.path}: {info.contradiction}")
        if not (info.scales[0] != 0 and np.isfinite([info.scales[0], info.offsets[0]]).all()):
            raise InputError(f"{info.path}: scale {info.scales[0]} and offset {info.offsets[0]} make no heights")
        object.__setattr__(self, "path", info.path)
        object.__setattr__(self, "info", info)
        object.__setattr__(self, "system", self._reference(info))
        object.__setattr__(self, "metres", self._unit(info))
        object.__setattr__(self, "_missing", missing_blocks(info))
        object.__setattr__(self, "_cache", BlockCache(self.cache_bytes))

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_cache"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        object.__setattr__(self, "_cache", BlockCache(self.cache_bytes))

    def _reference(self, info: RasterInfo) -> MetricSystem | None:
        stated = info.crs or self.crs
        if stated is None:
            return None
        system = metric_system(stated, f"{info.path}: CRS")
        return system.declaring(self.height_system, f"{info.path}: declared height system")

    def _unit(self, info: RasterInfo) -> float:
        """Metres upwards in a unit of the file's heights."""
        where = f"{info.path}: heights"
        own = metric_system(info.crs, where) if info.crs is not None else None
        stated = None if info.band_unit is None else metres_in(info.band_unit, f"{where}: unit of the band")
        if stated is not None and own is not None and own.heights is not None:
            agreed_metres(stated, own.height_scale, where, in_one_file=True)
        elif stated is None and own is not None and own.heights is not None:
            stated = abs(own.height_scale or 1.0)
        system = 1.0 if self.system is None else self.system.height_scale
        return agreed_metres(stated, system, where, in_one_file=False)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the grid."""
        return self.info.size

    def read(self, window: Window) -> Floats32:
        """Heights of a window inside the grid, shape (height, width), metres; NaN where there is none."""
        width, height = self.info.size
        right, bottom = window.stop
        if window.size == 0 or window.col < 0 or window.row < 0 or right > width or bottom > height:
            raise UsageError(f"{self.path}: {window} is not inside the grid of {width} × {height} points")
        out = np.empty((window.height, window.width), np.float32)
        block_width, block_height = self.block
        for row in range(window.row // block_height, -(-bottom // block_height)):
            for col in range(window.col // block_width, -(-right // block_width)):
                area = Window(col * block_width, row * block_height, block_width, block_height)
                part = area & window
                block = self._cache.get((col, row), partial(self._load, area & Window(0, 0, width, height)))
                source = block[part.row - area.row :, part.col - area.col :][: part.height, : part.width]
                out[part.row - window.row :, part.col - window.col :][: part.height, : part.width] = source
        return out

    def pixel(self, col: int, row: int) -> float:
        """Height of one grid point, metres; NaN if there is none."""
        return float(self.read(Window(col, row, 1, 1))[0, 0])

    @property
    def block(self) -> tuple[int, int]:
        """Width and height of the blocks that are kept: the file's tiles, or whole lines of about 2^16 points."""
        width, height = self.info.block
        if width * height > 16 * _BLOCK * _BLOCK and height > 1:
            return _BLOCK, _BLOCK
        if width < self.info.size[0] and width * height >= _BLOCK * _BLOCK // 4:
            return width, height
        return self.info.size[0], max(height, min(_BLOCK, max(1, _BLOCK * _BLOCK // self.info.size[0])))

    def _load(self, window: Window) -> Floats32:
        """Read and check a block."""
        pixels, valid = read_pixels(self.info, window, self._missing)
        stored = pixels[0]
        plain = valid is None and (self.info.scales[0], self.info.offsets[0], self.metres) == (1.0, 0.0, 1.0)
        if plain and float(stored.min()) > _PLAIN and float(stored.max()) < HIGHEST:
            return stored.astype(np.float32, copy=False)
        heights = stored.astype(np.float64) * self.info.scales[0] + self.info.offsets[0]
        void = ~(np.abs(heights) < _VOID)
        heights *= self.metres
        if valid is not None:
            void |= ~valid
        self._check_range(stored, heights, void, window)
        heights[void] = np.nan
        return heights.astype(np.float32)

    def _check_range(self, stored: NDArray[Any], heights: Floats, void: Mask, window: Window) -> None:
        """Refuse values that are no heights."""
        wrong = ~void & ((heights < LOWEST) | (heights > HIGHEST))
        if self.info.nodata is None:
            wrong |= ~void & np.isin(stored, USUAL_NODATA)
        if not wrong.any():
            return
        value, raw = float(heights[wrong][0]), stored[wrong][0]
        unit = self.info.band_unit or ("metres" if self.metres == 1.0 else unit_label(self.metres))
        what = f"declare the nodata value (`gdal_edit.py -a_nodata {raw:g}`)"
        if raw not in USUAL_NODATA:
            what = (
                f"if {raw:g} marks missing heights, {what}; else state their unit (`gdal_edit.py -units`, now {unit})"
            )
        raise InputError(
            f"{self.path}: {int(wrong.sum())} values in window col {window.col} row {window.row} {window.width} × "
            f"{window.height} are no heights (allowed {LOWEST:g} to {HIGHEST:g} m), for one {value:g} m; {what}"
        )

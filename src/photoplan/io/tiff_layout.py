"""Where a TIFF keeps its pixels: the first directory, read without decoding anything (TIFF 6.0; BigTIFF).

Used to recognise truncated and hostile files from their header, and blocks that were never written.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_CODES = {1: "u1", 3: "u2", 4: "u4", 13: "u4", 16: "u8", 18: "u8"}
_MAX_TAGS = 4096

_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION = 256, 257, 258, 259, 262, 274
_STRIP_OFFSETS, _SAMPLES, _ROWS, _STRIP_COUNTS, _PLANAR, _PREDICTOR = 273, 277, 278, 279, 284, 317
_TILE_WIDTH, _TILE_HEIGHT, _TILE_OFFSETS, _TILE_COUNTS = 322, 323, 324, 325


@dataclass(frozen=True)
class TiffArray:
    """Where an array of the directory stands in the file."""

    position: int
    """Byte of its first element."""
    dtype: str
    """NumPy type of its elements, with byte order."""
    count: int
    """Number of elements."""


@dataclass(frozen=True, eq=False)
class TiffLayout:
    """The first directory of a TIFF."""

    size: tuple[int, int]
    """Width and height in pixels."""
    samples: int
    """Samples per pixel."""
    bits: int
    """Bits per sample."""
    compression: int
    """Code of the compression; 1 = none."""
    predictor: int
    """1 = none, 2 = differences of neighbours, 3 = differences of the bytes of floats."""
    photometric: int
    """Code of the photometric interpretation: 0 white is zero, 5 CMYK, 8 CIELab …"""
    orientation: int
    """1 to 8 as in EXIF; 1 = as stored."""
    planar: bool
    """True: one plane of blocks per sample."""
    block: tuple[int, int]
    """Width and height of a block."""
    offsets: NDArray[np.uint64]
    """First byte of every block; 0 = never written."""
    counts: NDArray[np.uint64]
    """Stored bytes of every block; 0 = never written."""
    offsets_array: TiffArray
    """Where `offsets` stands in the file."""
    counts_array: TiffArray
    """Where `counts` stands in the file."""
    directory: int
    """Byte at which the first directory begins."""

    @property
    def grid(self) -> tuple[int, int]:
        """Blocks across and down."""
        return -(-self.size[0] // self.block[0]), -(-self.size[1] // self.block[1])

    @property
    def present(self) -> NDArray[np.bool_]:
        """Which blocks are stored, shape (planes, rows, columns) of blocks."""
        across, down = self.grid
        return ((self.counts > 0) & (self.offsets > 0)).reshape(-1, down, across)

    @property
    def ratio(self) -> float:
        """Decoded bytes per stored byte over the stored blocks; 0 if none is stored."""
        present = self.present.ravel()
        stored = float(self.counts[present].sum(dtype=np.float64))
        per_block = self.block[0] * self.block[1] * self.bits / 8 * (1 if self.planar else self.samples)
        return float(present.sum()) * per_block / stored if stored else 0.0


def read_tiff_layout(path: Path) -> TiffLayout:
    """Read the first directory of a TIFF or BigTIFF."""
    return read_tiff_layouts(path, most=1)[0]


def read_tiff_layouts(path: Path, most: int = 64) -> list[TiffLayout]:
    """Read the directories of a TIFF or BigTIFF in the order of their chain: image, overviews, masks."""
    file_size = path.stat().st_size
    try:
        with path.open("rb") as file:
            layouts: list[TiffLayout] = []
            start = None
            while start != 0 and len(layouts) < most:
                directory = _Directory(file, file_size, start)
                layouts.append(_layout(directory, file_size))
                start = directory.next
            return layouts
    except (struct.error, ValueError, KeyError, OverflowError, IndexError) as error:
        raise InputError(
            f"{path}: the TIFF directory is damaged or cut off ({error}); the file has {file_size} bytes. "
            "Get a fresh copy"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


class _Directory:
    """Tags of a directory: code -> (type, count, position of the values); the first one without `start`."""

    def __init__(self, file: BinaryIO, file_size: int, start: int | None = None) -> None:
        self._file, self._file_size = file, file_size
        head = self._at(0, 16)
        self.order = {b"II": "<", b"MM": ">"}[head[:2]]
        version = struct.unpack(self.order + "H", head[2:4])[0]
        self.big = version == 43
        if version not in (42, 43):
            raise ValueError(f"version {version}")
        self.start = struct.unpack(self.order + ("Q" if self.big else "I"), head[8:16] if self.big else head[4:8])[0]
        if start is not None:
            self.start = start
        number_size, entry = (8, 20) if self.big else (2, 12)
        number = struct.unpack(self.order + ("Q" if self.big else "H"), self._at(self.start, number_size))[0]
        if not 0 < number <= _MAX_TAGS:
            raise ValueError(f"{number} tags")
        block = self._at(self.start + number_size, number * entry)
        link = self._at(self.start + number_size + number * entry, 8 if self.big else 4)
        self.next = struct.unpack(self.order + ("Q" if self.big else "I"), link)[0]
        self.tags: dict[int, tuple[int, int, int]] = {}
        for i in range(number):
            code, kind, count = struct.unpack_from(self.order + ("HHQ" if self.big else "HHI"), block, i * entry)
            inline = 8 if self.big else 4
            position = self.start + number_size + (i + 1) * entry - inline
            if _SIZES.get(kind, 1) * count > inline:
                raw = block[(i + 1) * entry - inline : (i + 1) * entry]
                position = struct.unpack(self.order + ("Q" if self.big else "I"), raw)[0]
            self.tags.setdefault(code, (kind, count, position))

    def _at(self, position: int, count: int) -> bytes:
        if position + count > self._file_size:
            raise ValueError(f"bytes {position} to {position + count} are wanted")
        self._file.seek(position)
        return self._file.read(count)

    def where(self, code: int) -> TiffArray:
        """Place of an array of unsigned numbers."""
        kind, count, position = self.tags[code]
        return TiffArray(position, self.order + _CODES[kind], count)

    def array(self, code: int) -> NDArray[np.uint64]:
        """All values of a tag of unsigned numbers."""
        place = self.where(code)
        raw = self._at(place.position, place.count * np.dtype(place.dtype).itemsize)
        return np.frombuffer(raw, place.dtype).astype(np.uint64)

    def one(self, code: int, default: int | None = None) -> int:
        """First value of a tag."""
        if code not in self.tags and default is not None:
            return default
        kind, _, position = self.tags[code]
        dtype = np.dtype(self.order + _CODES[kind])
        return int(np.frombuffer(self._at(position, dtype.itemsize), dtype)[0])


def _layout(tags: _Directory, file_size: int) -> TiffLayout:
    """Put the tags together and check them against each other and the file's length."""
    width, height = tags.one(_WIDTH), tags.one(_HEIGHT)
    samples, planar = tags.one(_SAMPLES, 1), tags.one(_PLANAR, 1) == 2
    tiled = _TILE_OFFSETS in tags.tags
    if tiled:
        block = tags.one(_TILE_WIDTH), tags.one(_TILE_HEIGHT)
    else:
        block = width, min(tags.one(_ROWS, 2**32 - 1), height)
    if min(width, height, samples, *block) < 1:
        raise ValueError(f"{width} × {height} pixels in blocks of {block[0]} × {block[1]}")
    codes = (_TILE_OFFSETS, _TILE_COUNTS) if tiled else (_STRIP_OFFSETS, _STRIP_COUNTS)
    needed = -(-width // block[0]) * -(-height // block[1]) * (samples if planar else 1)
    places = tags.where(codes[0]), tags.where(codes[1])
    if any(place.count != needed for place in places):
        raise ValueError(f"{places[0].count} blocks are listed where {needed} are needed")
    offsets, counts = tags.array(codes[0]), tags.array(codes[1])
    beyond = np.flatnonzero((counts > 0) & (offsets > 0) & (offsets.astype(float) + counts.astype(float) > file_size))
    if beyond.size:
        first = int(beyond[0])
        across, down = -(-width // block[0]), -(-height // block[1])
        row, col = divmod(first % (across * down), across)
        raise ValueError(
            f"{beyond.size} of {needed} blocks lie beyond its end, the first is band "
            f"{first // (across * down) + 1 if planar else 'all'}, window col {col * block[0]} row {row * block[1]} "
            f"{block[0]} × {block[1]}"
        )
    return TiffLayout(
        size=(width, height),
        samples=samples,
        bits=tags.one(_BITS, 1),
        compression=tags.one(_COMPRESSION, 1),
        predictor=tags.one(_PREDICTOR, 1),
        photometric=tags.one(_PHOTOMETRIC, 1),
        orientation=tags.one(_ORIENTATION, 1),
        planar=planar,
        block=block,
        offsets=offsets,
        counts=counts,
        offsets_array=places[0],
        counts_array=places[1],
        directory=tags.start,
    )

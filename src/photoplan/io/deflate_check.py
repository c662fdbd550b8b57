"""DEFLATE blocks of a TIFF against their own checksum, which the decoder of TIFFs leaves aside."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.tiff_layout import TiffLayout, read_tiff_layout

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


def damaged_block(path: Path, window: Window) -> str | None:
    """What is wrong with the first damaged block under a window of a TIFF; None if all are whole.

    Each block is decoded once per process for this, and not kept. Files with another compression have no checksum and
    pass.

    Raises
    ------
    InputError
        The directory of the file contradicts itself.
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
            file.seek(int(layout.offsets[index]))
            if not _whole(file.read(int(layout.counts[index]))):
                band = f" of band {plane + 1}" if layout.planar else ""
                return f"the block at column {col * width}, row {row * height}{band} does not agree with its checksum"
            blocks.todo[plane, row, col] = False
    return None


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

"""Pictures that can only be decoded from their top are decoded once.

JPEG and PNG have no tiles: every window far from the last one costs a decoding of everything above it, in every thread
anew. A large one is therefore decoded once per process into a nameless temporary file, pixel by pixel, from which
windows are read. Memory stays as it was.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.disk import disk_error, write_all

SEQUENTIAL = ("JPEG", "PNG")
"""Formats that are decoded from the top."""
_KEPT = 2
_CHUNK = 8 << 20


class DecodedPicture:
    """Pixels of a picture in a temporary file that has no name and ends with its last user.

    Parameters
    ----------
    size
        Width and height in pixels.
    bands
        Number of bands.
    dtype
        Type of the pixels.
    read
        Reads a window of whole rows, shape (bands, height, width).

    Raises
    ------
    ResourceError
        If the folder for temporary files is full.
    """

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

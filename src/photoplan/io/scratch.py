"""Arrays that would not fit into memory together, in a temporary file without a name that ends with its user."""

from __future__ import annotations

import os
import tempfile
import threading
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from photoplan.io.disk import disk_error

_BYTES = 4


class Scratch:
    """A store of float32 arrays of shape (rows, columns, n) on the disk; a context manager, used by several threads.

    Parameters
    ----------
    folder : Path
        Whose file system has the room. Nothing is seen there, and nothing stays if the process is killed.

    Raises
    ------
    UsageError, ResourceError
        The folder cannot be written, or is full.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock, self._end = folder, threading.Lock(), 0
        try:
            self._file = tempfile.TemporaryFile(prefix=".photoplan-", dir=folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise disk_error(folder, error) from error

    def __enter__(self) -> Scratch:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def append(self, values: NDArray[np.float32], /) -> int:
        """Keep an array; where it is.

        Raises
        ------
        ResourceError
            The disk is full.
        """
        data = np.ascontiguousarray(values, np.float32)
        with self._lock:
            at, self._end = self._end, self._end + data.nbytes
        view, done = data.data.cast("B"), 0
        try:
            while done < data.nbytes:
                done += os.pwrite(self._file.fileno(), view[done:], at + done)
        except OSError as error:
            raise disk_error(self._folder, error) from error
        return at

    def rows(self, at: int, shape: tuple[int, int, int], first: int, last: int, /) -> NDArray[np.float32]:
        """Rows from `first` to before `last` of an array of a shape."""
        out = np.empty((last - first, *shape[1:]), np.float32)
        start, view, done = at + first * shape[1] * shape[2] * _BYTES, out.data.cast("B"), 0
        try:
            while done < out.nbytes:
                got = os.preadv(self._file.fileno(), [view[done:]], start + done)
                if not got:
                    raise OSError(0, "it has become shorter")
                done += got
        except OSError as error:
            raise disk_error(self._folder, error, "read") from error
        return out

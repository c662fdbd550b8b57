"""Results of tasks that are no tiles of a raster, and large arrays, kept on the disk till their product is complete."""

from __future__ import annotations

import hashlib
from contextlib import AbstractContextManager, ExitStack, nullcontext
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import NotData, decode, encode
from photoplan.errors import InputError, PhotoplanError
from photoplan.io.disk import disk_error
from photoplan.io.lock import lock_of
from photoplan.io.naming import locked
from photoplan.io.tile_log import TileLog

#: Part of every key: logs of versions that kept results in another way are started afresh.
_FORM = "codec 1"
#: Indices from here on are those of arrays.
_FIRST_ARRAY = 1 << 63
_BYTES = 4


class ResultLog:
    """A crash-safe log of results by their names, as `photoplan.engine.run.Steps` asks for; a context manager.

    Results are data, see `photoplan.codec`: reading a log that came with a project runs no code.
    """

    def __init__(self, path: Path, key: str, lock: Path | None) -> None:
        self._path, self._key = path, key
        self._lock: AbstractContextManager[Any] = nullcontext() if lock is None else locked(lock)
        self._log: TileLog | None = None
        self._arrays = count(_FIRST_ARRAY)

    @classmethod
    def beside(cls, product: Path, key: str, *, locked: bool) -> ResultLog:
        """The hidden log beside a product, till it is complete; `locked`: its caller holds the product's lock."""
        return cls(cls.place(product), key, None if locked else lock_of(product))

    @staticmethod
    def place(product: Path) -> Path:
        """Where that log is."""
        return product.with_name(f".{product.name}.steps")

    def __enter__(self) -> ResultLog:
        with ExitStack() as stack:
            stack.enter_context(self._lock)
            self._log = TileLog(self._path, f"{_FORM} {self._key}")
            self._arrays = count(max(self._log.finished | {_FIRST_ARRAY - 1}) + 1)
            stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.leave()
        self._lock.__exit__(kind, error, trace)

    @property
    def _open(self) -> TileLog:
        assert self._log is not None, "a log is used inside its context"
        return self._log

    @property
    def finished(self) -> frozenset[int]:
        """Indices of the results that are there."""
        return frozenset(index for index in self._open.finished if index < _FIRST_ARRAY)

    def index(self, name: object) -> int:
        """Where the result of a name is kept: the name's digest, 63 bits."""
        return int.from_bytes(hashlib.blake2b(repr(name).encode(), digest_size=8).digest(), "big") >> 1

    def append(self, index: int, result: Any) -> None:
        """Keep a result."""
        self._open.append(index, encode(result))

    def __getitem__(self, index: int) -> Any:
        """A result, read from the disk: a value of its own each time."""
        try:
            return decode(self._open.read(index))
        except NotData as error:
            raise InputError(
                f"{self._path}: a kept result is not what this version writes ({error}); delete the file, run again"
            ) from error

    def keep(self, values: NDArray[np.float32]) -> int:
        """Keep an array of float32; where it is, also in a later run. Called by workers."""
        index = next(self._arrays)
        self._open.append(index, np.ascontiguousarray(values, np.float32).data)
        return index

    def rows(self, at: int, shape: tuple[int, int, int], first: int, last: int) -> NDArray[np.float32]:
        """Rows from `first` to before `last` of an array of a shape (rows, columns, n) that is kept."""
        row = shape[1] * shape[2] * _BYTES
        try:
            found = self._open.part(at, first * row, (last - first) * row)
        except OSError as error:
            raise disk_error(self._path, error, "read") from error
        if len(found) < (last - first) * row:
            raise PhotoplanError(f"{self._path}: has become shorter since it was written; delete the file, rerun")
        return np.frombuffer(found, np.float32).reshape(last - first, *shape[1:])

    def remove(self) -> None:
        """Forget all results: their product is complete."""
        self._open.remove()

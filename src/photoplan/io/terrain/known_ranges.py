"""Ranges of heights of the parts of a large grid, kept from one run to the next.

A ray that passes over terrain has to know that it does. Overviews of a file are no bounds (`surfaces.raster`), so the
posts below it are read once; what was found then is kept in the user's cache folder, one file for each terrain: a
header with what the terrain was (size, time, content of its files), then one record for each part with a checksum.
A file that is damaged or of another state of the terrain is started afresh. Where nothing can be written, nothing is
kept, and all is as it was.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.io.disk import cache_folder
from photoplan.io.fingerprint import fingerprint
from photoplan.io.terrain.reader import TerrainReader

#: Posts of a grid from which on reading it once more takes longer than anybody notices.
WORTH_KEEPING = 1 << 25
#: Terrains whose ranges are kept (16 MB each at most); those used longest ago go.
MOST_FILES = 32
_MAGIC = b"PPRANGE1"


@dataclass(frozen=True)
class KnownRanges:
    """What was found of a terrain before; several threads and processes may add to it at once."""

    path: Path
    """Its file."""
    state: str
    """What the terrain is: its files, and how they are read."""
    _key: list[bytes] = field(default_factory=list, init=False, repr=False, compare=False)
    """Of the records that belong here; empty: nothing is kept."""

    @classmethod
    def of(cls, reader: TerrainReader) -> KnownRanges | None:
        """For a terrain file; None: it is so small that all of it is read in no time, or there is no place."""
        info = reader.info
        if info.size[0] * info.size[1] < WORTH_KEEPING:
            return None
        try:
            where = info.path.resolve()
            beside = (where.with_name(where.name + suffix) for suffix in (".msk", ".MSK", ".aux.xml"))
            state: list[Any] = [info.size, info.dtype, info.nodata, info.scales, info.offsets, reader.metres]
            state += [
                (file.name, file.stat().st_mtime_ns, fingerprint(file)) for file in (where, *beside) if file.is_file()
            ]
            name = hashlib.sha256(os.fsencode(where)).hexdigest()[:32]
            return cls(cache_folder() / "terrain" / f"{name}.ranges", repr(state))
        except (OSError, RuntimeError):  # no home
            return None

    def load(self, layout: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Numbers of parts (n,), and the lowest and highest heights of their cells (n, 2, rows, columns)."""
        key = hashlib.sha256(f"{self.state} {layout}".encode()).digest()
        record, head = _record(layout), _MAGIC + key
        content = b""
        with suppress(OSError):
            if self.path.is_file():  # a pipe would be waited for
                content = self.path.read_bytes()
        begun = content[: len(head)] == head
        body = content[len(head) :] if begun else b""
        size = record.itemsize
        found, start = np.frombuffer(body[: len(body) // size * size], record), zlib.crc32(key)
        sums = [zlib.crc32(body[k * size + 4 : (k + 1) * size], start) for k in range(len(found))]
        kept = found[found["check"] == np.array(sums, np.uint32)]
        try:
            if not begun or len(kept) * size != len(body):
                _replace(self.path, head + kept.tobytes())
            os.utime(self.path)
            self._key[:] = [key]
        except OSError:
            self._key.clear()
        return kept["part"].astype(np.int64), kept["cells"].astype(np.float32)

    def keep(self, layout: tuple[int, ...], part: int, cells: NDArray[np.float32]) -> None:
        """Keep what was found of a part, shape (2, rows, columns); where it cannot be written it is not kept."""
        if not self._key:
            return
        one = np.zeros((), _record(layout))
        one["part"], one["cells"] = part, cells
        one["check"] = zlib.crc32(one.tobytes()[4:], zlib.crc32(self._key[0]))
        try:
            # Whole records are appended, and each knows the state of the terrain that it belongs to.
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
            try:
                os.write(descriptor, one.tobytes())
            finally:
                os.close(descriptor)
        except OSError:
            self._key.clear()


def _record(layout: tuple[int, ...]) -> np.dtype[Any]:
    return np.dtype([("check", "<u4"), ("part", "<u4"), ("cells", "<f4", (2, *layout[-2:]))])


def _replace(path: Path, content: bytes) -> None:
    """Write a file at once; the oldest of its kind go."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".new-", delete=False) as file:
        try:
            file.write(content)
            file.close()
            Path(file.name).replace(path)
        except OSError:
            Path(file.name).unlink(missing_ok=True)
            raise
    files = sorted(path.parent.glob("*.ranges"), key=lambda file: file.stat().st_mtime)
    for old in files[:-MOST_FILES]:
        old.unlink(missing_ok=True)

"""The crash-safe store of finished tiles: one file to which records are only appended.

The file begins with the key of its run. Each record is a header (magic, tile, two notes, lengths of figures and
payload, checksum of both, checksum of the header), the tile's figures as JSON, and the payload; an empty tile has none.
A process that dies at any byte leaves whole records and at most one torn tail, which is cut off when the log is opened
again.
"""

from __future__ import annotations

import hmac
import json
import os
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from photoplan.errors import PhotoplanError, UsageError
from photoplan.io.disk import cache_folder, disk_error, open_own, own_secret, write_all

_OURS = b"PPTILES"
_MAGIC = _OURS + b"3"
_START = struct.Struct("<8s32sI")
_RECORD = struct.Struct("<4sQQQIQI")
_CHECK = struct.Struct("<I")
_TILE = b"TILE"
_CHUNK = 1 << 20


@dataclass(frozen=True)
class _Place:
    """Where a payload stands in the file, and what its record says of it."""

    position: int
    """First byte of the payload; its figures stand before it."""
    length: int
    figures: int
    """Length of the figures."""
    checksum: int
    notes: tuple[int, int]


def log_of(path: Path) -> Path:
    """Where the finished tiles of a file that is being made are kept."""
    return path.with_name(f".{path.name}.tiles")


def checksum_of(payload: bytes | memoryview, figures: Mapping[str, Any] | None) -> int:
    """What a log keeps of a tile to know it again."""
    return zlib.crc32(payload, zlib.crc32(_text(figures)))


def _text(figures: Mapping[str, Any] | None) -> bytes:
    return json.dumps(figures).encode() if figures else b""


class TileLog:
    """Finished tiles by their index; a context manager that closes the file and leaves it in place.

    Notes
    -----
    `append` may be called from several threads. Two processes must not share a log: see `FileLock`.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._places: dict[int, _Place] = {}
        start = _MAGIC, hmac.digest(own_secret(cache_folder()), key.encode(), "sha256")
        self._start = _START.pack(*start, zlib.crc32(start[0] + start[1]))
        try:
            self._descriptor = open_own(path)
        except OSError as error:
            raise disk_error(path, error, "made") from error
        try:
            self._end = self._scan()
        except BaseException as error:
            os.close(self._descriptor)
            if isinstance(error, OSError):
                raise disk_error(path, error) from error
            raise

    def __enter__(self) -> TileLog:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def finished(self) -> frozenset[int]:
        """Indices of all tiles in the log."""
        with self._lock:
            return frozenset(self._places)

    @property
    def descriptor(self) -> int:
        """Descriptor of the open file, for copying payloads inside the kernel."""
        return self._descriptor

    def place(self, index: int) -> tuple[int, int]:
        """First byte of a tile's payload in the file, and its length (0: an empty tile)."""
        place = self._places[index]
        return place.position, place.length

    def checksum(self, index: int) -> int:
        """Of a tile's payload and figures, see `checksum_of`."""
        return self._places[index].checksum

    def notes(self, index: int) -> tuple[int, int]:
        """The two whole numbers that were kept with a tile."""
        return self._places[index].notes

    def figures(self, index: int) -> dict[str, Any]:
        """The figures that were kept with a tile; empty if there were none."""
        place = self._places[index]
        if place.figures == 0:
            return {}
        found: dict[str, Any] = json.loads(self._read(place.position - place.figures, place.figures))
        return found

    def append(
        self,
        index: int,
        payload: bytes | memoryview = b"",
        notes: tuple[int, int] = (0, 0),
        figures: Mapping[str, Any] | None = None,
    ) -> None:
        """Add a tile, two notes about it, and its figures; without a payload it is an empty one.

        A tile that is there already is replaced.
        """
        payload, text = memoryview(payload).cast("B"), _text(figures)
        length, checksum = len(payload), checksum_of(payload, figures)
        head = _RECORD.pack(_TILE, index, *notes, len(text), length, checksum)
        head += _CHECK.pack(zlib.crc32(head)) + text
        with self._lock:
            os.lseek(self._descriptor, self._end, os.SEEK_SET)
            try:
                write_all(self._descriptor, head, payload)
            except BaseException as error:
                # Ctrl-C may come here as well: whatever was written of this record goes.
                os.ftruncate(self._descriptor, self._end)
                if isinstance(error, OSError):
                    raise disk_error(self.path, error) from error
                raise
            self._places[index] = _Place(
                position=self._end + len(head), length=length, figures=len(text), checksum=checksum, notes=notes
            )
            self._end += len(head) + length

    def read(self, index: int) -> bytes:
        """Payload of a tile, compared with its checksum."""
        place = self._places[index]
        content = self._read(place.position - place.figures, place.figures + place.length)
        if zlib.crc32(content) != place.checksum:
            raise PhotoplanError(f"{self.path}: tile {index} has changed since it was written; delete the file, rerun")
        return content[place.figures :]

    def part(self, index: int, first: int, length: int) -> bytes:
        """So many bytes of a payload from `first` on, as they are now; fewer if the file has become shorter."""
        return self._read(self._places[index].position + first, length)

    def _read(self, position: int, length: int) -> bytes:
        with self._lock:
            os.lseek(self._descriptor, position, os.SEEK_SET)
            parts = []
            while length > 0:
                parts.append(os.read(self._descriptor, length))
                if not parts[-1]:
                    break
                length -= len(parts[-1])
        return b"".join(parts)

    def close(self) -> None:
        """Close the file; it stays for the next run."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def leave(self) -> None:
        """Close the file; it stays if there is something in it."""
        if self._places:
            self.close()
        else:
            self.remove()

    def remove(self) -> None:
        """Close and delete the file: its product is complete."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _scan(self) -> int:
        """Find all whole records, cut off a torn tail, start afresh for another key; returns the end of the file."""
        size = os.fstat(self._descriptor).st_size
        with os.fdopen(os.dup(self._descriptor), "rb") as file:
            file.seek(0)
            head = file.read(_START.size)
            if head != self._start:
                # Of an earlier version, of another key, or cut off: it is ours. Everything else is somebody's file.
                if head[: len(_OURS)] != _OURS[: len(head)]:
                    raise UsageError(f"{self.path}: is not a log of finished tiles; move it away")
                os.ftruncate(self._descriptor, 0)
                os.lseek(self._descriptor, 0, os.SEEK_SET)
                write_all(self._descriptor, self._start)
                return len(self._start)
            end = _START.size
            for index, place in self._records(file, size):
                self._places[index] = place
                end = place.position + place.length
        os.ftruncate(self._descriptor, end)
        return end

    @staticmethod
    def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, _Place]]:
        """Whole records from the file's position on."""
        position = file.tell()
        while True:
            head = file.read(_RECORD.size + _CHECK.size)
            if len(head) < _RECORD.size + _CHECK.size:
                return
            magic, index, note0, note1, figures, length, checksum = _RECORD.unpack_from(head)
            (head_checksum,) = _CHECK.unpack_from(head, _RECORD.size)
            position += len(head)
            end = position + figures + length
            if magic != _TILE or zlib.crc32(head[: _RECORD.size]) != head_checksum or end > size:
                return
            found, left = 0, figures + length
            while left:
                part = file.read(min(left, _CHUNK))
                if not part:
                    return
                found, left = zlib.crc32(part, found), left - len(part)
            if found != checksum:
                return
            yield (
                index,
                _Place(
                    position=position + figures, length=length, figures=figures, checksum=checksum, notes=(note0, note1)
                ),
            )
            position = end

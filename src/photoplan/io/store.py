"""Files that survive a crash: staged outputs, logs of finished tiles, kept results, run records."""

from __future__ import annotations

import base64
import errno
import hashlib
import hmac
import json
import os
import platform
import re
import shutil
import struct
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from importlib import metadata
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, TypeVar

import numpy as np
import rasterio
import rasterio.windows

from photoplan import __version__
from photoplan.arrays import Floats32
from photoplan.codec import NotData, decode, encode
from photoplan.errors import InputError, PhotoplanError, ResourceError, RunLocked, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.disk import (
    GDAL_ERRORS,
    BlockCoder,
    FileLock,
    cache_folder,
    disk_error,
    first_cause,
    free_megabytes,
    gdal_settings,
    lock_of,
    not_georeferenced,
    open_own,
    open_raster,
    own_secret,
    read_own,
    refuse_outward,
    sync_file,
    sync_folder,
    write_all,
)
from photoplan.io.files import fingerprint, stated_path, stated_text
from photoplan.plain import HasJsonFields, json_text, pick
from photoplan.request import Request

_OURS = b"PPTILES"
_MAGIC = _OURS + b"3"
_START = struct.Struct("<8s32sI")
_RECORD = struct.Struct("<4sQQQIQI")
_CHECK = struct.Struct("<I")
_TILE = b"TILE"
_CHUNK = 1 << 20


@dataclass(frozen=True)
class _Place:
    """Place of a payload in the file, and the values of its record."""

    position: int
    """First byte of the payload; its figures stand before it."""
    length: int
    figures: int
    """Length of the figures."""
    checksum: int
    notes: tuple[int, int]


def log_of(path: Path) -> Path:
    """Return the log of the finished tiles of a file that is being made."""
    return path.with_name(f".{path.name}.tiles")


def checksum_of(payload: bytes | memoryview, figures: Mapping[str, Any] | None) -> int:
    """Return the checksum by which a log knows a tile again."""
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
        """Return the checksum of a tile's payload and figures, see `checksum_of`."""
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


_Identity = tuple[int, int, int]
#: Working folders, see `scratch`, and files of versions before them: the number is the process.
_FOLDER = re.compile(r"\.photoplan-[0-9]+-\w+\.part")
_OLD_FILE = re.compile(r"\..+\.([0-9]+)\.(?:part|trial|partial\.gpkg|[0-9a-f]{8}\.tif)")
_TIDIED: set[Path] = set()
_NOTE_BYTES = 64 << 20
_ATTEMPTS = 5


@contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """A new folder inside another one, for files that are not complete; it is removed when the context ends.

    Its name cannot be known in advance and nobody else can write there, so that no library follows a link that was laid
    out for it. A lock inside shows that its process lives: what dead ones have left behind is removed here.
    """
    refuse_outward(folder)
    if folder not in _TIDIED:
        _TIDIED.add(folder)
        _remove_dead(folder)
    for attempt in count():
        made = Path(tempfile.mkdtemp(prefix=f".photoplan-{os.getpid()}-", suffix=".part", dir=folder))
        lock = FileLock(made / "lock")
        try:
            try:
                lock.acquire()
            except (RunLocked, UsageError):
                # Another run took it for one of the dead before it was locked. Some file systems know no locks at all.
                if attempt < _ATTEMPTS:
                    continue
            except ResourceError as error:
                # The caller names its own file.
                raise OSError(errno.ENOSPC, str(error.__cause__ or error)) from error
            yield made
            return
        finally:
            lock.release()
            shutil.rmtree(made, ignore_errors=True)


def _remove_dead(folder: Path) -> None:
    """Remove working files of processes that are gone: plain files and folders with names of ours, never links."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            old, path = _OLD_FILE.fullmatch(entry.name), Path(entry.path)
            if old and entry.is_file(follow_symlinks=False) and not _lives(int(old[1])):
                path.unlink(missing_ok=True)
            elif _FOLDER.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                with suppress(PhotoplanError), FileLock(path / "lock"):
                    shutil.rmtree(path, ignore_errors=True)


def _lives(process: int) -> bool:
    if os.name != "posix":
        import psutil  # noqa: PLC0415 - for Windows alone, where signal 0 would end the process

        return bool(psutil.pid_exists(process))
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


class RunMarker:
    """A hidden file that says that a run of many products is under way; those that are complete have their names.

    A run that dies leaves it, so that the next one with the same key is known to go on, whatever has been named.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self._path = folder / f".photoplan-{sha256(key.encode()).hexdigest()[:16]}.run"
        self.interrupted = os.path.lexists(self._path)
        """True if an earlier run has died."""

    def begin(self) -> None:
        """Say that the run is under way."""
        try:
            os.close(open_own(self._path))
        except OSError as error:
            raise disk_error(self._path, error, "made") from error

    def end(self) -> None:
        """Say that it is complete."""
        self._path.unlink(missing_ok=True)


@dataclass(eq=False)
class _Group:
    """Complete files that wait for their names."""

    waiting: dict[Path, _Identity | None] = field(default_factory=dict)
    """By the name to come: what has this name now."""
    pending: dict[Path, Path] = field(default_factory=dict)
    """Places of files that have no name yet."""
    unfinished: set[Path] = field(default_factory=set)
    """Files that got their names from an earlier run before it died."""
    then: list[Callable[[], object]] = field(default_factory=list)
    held: ExitStack = field(default_factory=ExitStack)
    """Locks of products, and working folders."""
    locks: set[Path] = field(default_factory=set)
    """Locks that it holds: a second attempt of the same run holds them already."""
    folders: dict[Path, Path] = field(default_factory=dict)

    def take(self, part: Path, path: Path) -> None:
        if path not in self.waiting and is_unfinished(path):
            self.unfinished.add(path)
        self.waiting.setdefault(path, _identity(path))
        if path.parent not in self.folders:
            self.folders[path.parent] = self.held.enter_context(scratch(path.parent))
        self.pending[path] = self.folders[path.parent] / f".{path.name}"
        part.replace(self.pending[path])

    def give(self) -> None:
        """Give all names; whoever dies in between leaves notes that say which files are of an unfinished product."""
        for path, before in self.waiting.items():
            if _identity(path) != before:
                raise UsageError(f"{path}: another program made it meanwhile; choose another output or say `overwrite`")
        # Notes of a run that died are done with, also where this run has no such file.
        waiting = set(map(_place, self.waiting))
        earlier = {_place(other): other for path in self.waiting for other in _noted(path)[0]}
        for place, path in earlier.items():
            # Elsewhere those alone that say themselves that they belong to a file of this run.
            theirs = set(map(_place, _noted(path)[0]))
            if place not in waiting and (path.parent in self.folders or waiting & theirs):
                _note(path).unlink(missing_ok=True)
                _remove_dead(path.parent)
        for path in self.waiting:
            self._write_note(path, _identity(self.pending[path]))
        for path in self.waiting:
            self.pending[path].replace(path)
        for folder in self.folders:
            sync_folder(folder)
        for action in self.then:
            action()
        self.leave()

    def leave(self) -> None:
        """Remove what hidden files are left; notes stay where a name was given and another one was not."""
        unnamed = [path for path in self.waiting if self.pending[path].exists()]
        for path in self.waiting:
            self.pending[path].unlink(missing_ok=True)
            if path in unnamed and path in self.unfinished:
                with suppress(OSError):
                    self._write_note(path, self.waiting[path])
            elif path in unnamed or not unnamed:
                # The first one goes first: without it the others say nothing any more.
                _note(path).unlink(missing_ok=True)

    def _write_note(self, path: Path, identity: _Identity | None) -> None:
        """Note all files of the group, the first of them first, as they are called from the folder of this one."""
        files = [os.path.relpath(each, path.parent) for each in self.waiting]
        note = _note(path)
        note.unlink(missing_ok=True)
        descriptor = open_own(note, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        try:
            write_all(descriptor, json.dumps({"files": files, "identity": identity}).encode())
        finally:
            os.close(descriptor)


_GROUP: ContextVar[_Group | None] = ContextVar("files that get their names together", default=None)


@contextmanager
def together() -> Iterator[None]:
    """Files that are finished inside get their names when the context ends well: at once, as far as a file system can.

    Their order is that in which they were finished: a run record comes last. A run that dies between two names leaves
    files of which `is_unfinished` knows, so that the same command goes on. Inside another such context this one does
    nothing: the outer one names all.
    """
    if _GROUP.get() is not None:
        yield
        return
    group = _Group()
    token = _GROUP.set(group)
    try:
        yield
        try:
            group.give()
        except OSError as error:
            raise disk_error(next(iter(group.waiting)), error) from error
    finally:
        _GROUP.reset(token)
        with group.held:
            group.leave()


@contextmanager
def locked(lock: Path) -> Iterator[None]:
    """Hold a lock, see `FileLock`; inside `together` until the files have their names."""
    group = _GROUP.get()
    with ExitStack() as stack:
        if group is None:
            stack.enter_context(FileLock(lock))
        elif lock not in group.locks:
            group.held.enter_context(FileLock(lock))
            group.locks.add(lock)
        yield


def give_name(part: Path, path: Path) -> None:
    """Give a complete file its name, when it is safe on the disk: now, or with the others of `together`."""
    sync_file(part)
    group = _GROUP.get()
    if group is None:
        part.replace(path)
        sync_folder(path.parent)
    else:
        group.take(part, path)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a small file so that its name holds either the old or the whole new content; see `give_name`."""
    try:
        with scratch(path.parent) as folder:
            partial = folder / path.name
            partial.write_bytes(content)
            give_name(partial, path)
    except OSError as error:
        raise disk_error(path, error) from error


def when_named(action: Callable[[], object]) -> None:
    """Do something when the files that were finished so far have their names."""
    group = _GROUP.get()
    if group is None:
        action()
    else:
        group.then.append(action)


def standing(path: Path) -> Path:
    """Return the present place of a finished file, which may wait for its name."""
    group = _GROUP.get()
    return path if group is None else group.pending.get(path, path)


def is_unfinished(path: Path) -> bool:
    """Return whether a file is of a product whose run died before all its files had their names."""
    files, identity = _noted(path)
    return bool(files) and identity is not None and identity == _identity(path) and _note(files[0]).exists()


def forget(path: Path) -> None:
    """Remove the note that a file is of an unfinished product."""
    _note(path).unlink(missing_ok=True)


def _noted(path: Path) -> tuple[list[Path], _Identity | None]:
    """All files that a run which died was to name together, and the one it named `path`; nothing without a note."""
    try:
        noted = json.loads(read_own(_note(path), _NOTE_BYTES))
        inode, size, time = noted["identity"]
        return [path.parent / os.path.normpath(str(file)) for file in noted["files"]], (inode, size, time)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return [], None


def _place(path: Path) -> Path:
    """Return the place of a file, whatever steps lead to its folder."""
    return path.parent.resolve() / path.name


def _note(path: Path) -> Path:
    return path.with_name(f".{path.name}.unfinished")


def _identity(path: Path) -> _Identity | None:
    """Return the properties that a file keeps when it gets another name; None if there is no file."""
    try:
        state = path.lstat()
    except OSError:
        return None
    return state.st_ino, state.st_size, state.st_mtime_ns


def tidy(paths: Iterable[Path]) -> None:
    """Remove what a run that was killed after it had given the last name left beside the files of its product.

    Files that another run is writing are left alone, and so is what cannot be removed: the product is finished.
    """
    for path in paths:
        if _noted(path)[1] != _identity(path) or not path.exists():
            continue
        with suppress(PhotoplanError, OSError), FileLock(lock_of(path)):
            log_of(path).unlink(missing_ok=True)
            forget(path)


@dataclass(eq=False)
class StagedOutput:
    """A file that is made of a log, under a lock."""

    path: Path
    log_path: Path
    what: str
    """Content of the log, for messages: tiles."""
    check: Callable[[], None]
    """Refuses a file that must not be replaced."""
    faults: tuple[type[BaseException], ...]
    """Errors that a library raises if it cannot write."""
    _log: TileLog | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self._lock = FileLock(lock_of(self.path))
        self._faults: tuple[type[BaseException], ...] = (*self.faults, MemoryError, PhotoplanError)

    def enter(self, key: str, begin: Callable[[TileLog], None] = lambda log: None) -> None:
        """Take the lock and open the log, and begin with it."""
        self.check()
        self._lock.acquire()
        try:
            # The run before may have finished between the check and the lock.
            self.check()
            self._log = TileLog(self.log_path, key)
            begin(self._log)
        except BaseException:
            self.leave()
            raise

    def leave(self) -> None:
        """Keep the log for the next run."""
        if self._log is not None:
            self._log.leave()
            self._log = None
        self._lock.release()

    @property
    def log(self) -> TileLog:
        """The open log."""
        if self._log is None:
            raise UsageError(f"{self.path}: is not open; use it in a `with` block")
        return self._log

    def give(self, make: Callable[[Path], Path]) -> None:
        """Give the name to what `make` writes into a working folder and compares."""
        try:
            with scratch(self.path.parent) as folder:
                part = make(folder)
                # The last look before the name is taken: another program may have made the file meanwhile.
                self.check()
                give_name(part, self.path)
        except OSError as error:
            raise disk_error(self.path, error) from error
        except UsageError:
            raise
        except self._faults as error:
            cause = str(error) if isinstance(error, PhotoplanError) else first_cause(error)
            raise ResourceError(
                f"{self.path}: could not be written ({cause}; {free_megabytes(self.path)} MB are free there); free "
                f"some space and run the same command again: finished {self.what} are kept"
            ) from error


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
        """Return the place of that log."""
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
        """Return the key of a kept result: the digest of its name, 63 bits."""
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

    def keep(self, values: Floats32) -> int:
        """Keep an array of float32; where it is, also in a later run. Called by workers."""
        index = next(self._arrays)
        self._open.append(index, np.ascontiguousarray(values, np.float32).data)
        return index

    def rows(self, at: int, shape: tuple[int, int, int], first: int, last: int) -> Floats32:
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


#: Bytes that a record's tiles may unpack to, those of a million tiles; a damaged record may promise any number.
_MOST = 256 << 20


@dataclass(frozen=True, eq=False)
class KeptTiles:
    """Tiles of one file of a product, from one run to the next."""

    record: Path
    """The run record of the product; its entry `tiles` is what `told` gave, by the file's name."""
    key: Callable[[int], str | None]
    """Digest of all that decides a tile, by its index: two of the same one are the same, whatever else became of the
    product. None: it is none of the product's tiles."""

    def told(self, log: TileLog) -> str:
        """Return what a record keeps of the tiles in a log, as text."""
        found = []
        for index in sorted(log.finished):
            key = self.key(index)
            if key is not None:
                found.append((index, key, log.checksum(index), *log.notes(index), log.figures(index)))
        return base64.b64encode(zlib.compress(json.dumps(found).encode())).decode()

    def take_over(self, path: Path, windows: tuple[Window, ...], coder: BlockCoder, log: TileLog) -> None:
        """Bring tiles of a file that is there into a log: those whose key is the same, and whose pixels are still what
        was recorded. What cannot be read is computed again."""
        wanted = set(range(len(windows))) - log.finished
        same = [each for each in self._recorded(path.name) if each[0] in wanted and self.key(each[0]) == each[1]]
        if not same:
            return
        try:
            with open_raster(path, "GTiff") as dataset, gdal_settings():
                if dataset.count != coder.bands or dataset.dtypes[0] != coder.dtype.name:
                    return
                for index, _, checksum, moved, count, figures in same:
                    payload = _payload(dataset, windows[index], coder) if count else b""
                    if payload is not None and checksum_of(payload, figures) == checksum:
                        log.append(index, payload, (moved, count), figures)
        except (InputError, *GDAL_ERRORS):
            return

    def _recorded(self, name: str) -> Iterator[tuple[int, str, int, int, int, dict[str, Any]]]:
        """Yield what `told` stated of a file; nothing if there is no such record."""
        try:
            text = json.loads(read_own(self.record))["tiles"][name]
            found = json.loads(zlib.decompressobj().decompress(base64.b64decode(text), _MOST))
            for index, key, checksum, moved, count, figures in found:
                yield int(index), str(key), int(checksum), int(moved), int(count), dict(figures)
        except (OSError, ValueError, KeyError, TypeError, RecursionError, zlib.error):
            return


def _payload(dataset: Any, window: Window, coder: BlockCoder) -> bytes | memoryview | None:
    """A tile of a finished file as the block that it was made of; None: the file is smaller."""
    if window.stop[0] > dataset.width or window.stop[1] > dataset.height:
        return None
    area = rasterio.windows.Window(window.col, window.row, window.width, window.height)
    pixels = dataset.read(window=area)
    if coder.nodata is None:
        return coder.encode(pixels, np.asarray(dataset.dataset_mask(window=area)) > 0)[0]
    empty = np.isnan(pixels) if np.isnan(coder.nodata) else pixels == coder.nodata
    return coder.encode(pixels, ~empty.all(axis=0))[0]


try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

#: A picture of 16 × 16 pixels, 4:2:0, whose decoded bytes tell decoders apart: the standard leaves rounding and the
#: interpolation of colour to them, and files of other decoders differ by up to 7 grey values in 8 % of the samples.
_PICTURE = base64.b64decode(
    b"/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDABQODxIPDRQSEBIXFRQYHjIhHhwcHj0sLiQySUBMS0dARkVQWnNiUFVtVkVGZIhlbXd7gYKBTmCNl4x9"
    b"lnN+gXz/2wBDARUXFx4aHjshITt8U0ZTfHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHz/wAARCAAQABAD"
    b"ASIAAhEBAxEB/8QAFQABAQAAAAAAAAAAAAAAAAAAAwH/xAAgEAACAgICAgMAAAAAAAAAAAABAgMRAAQhIhITMUFC/8QAFQEBAQAAAAAAAAAAAAAA"
    b"AAAAAQL/xAAbEQEAAgIDAAAAAAAAAAAAAAABAhEAMWHh8P/aAAwDAQACEQMRAD8AjeltWOWWg8V2wPJwVZdlHEXQfjtiaQi2VCJGEDWDR+eMfxgg"
    b"UyR0iIaBX7NYM1bC2/aybjBSuDvP/9k="
)
#: Decoders by the beginning of the digest of what they make of it.
_DECODERS = {"dda6fb8a7330": "libjpeg 9 of the IJG", "0626c3e14946": "libjpeg-turbo"}
T = TypeVar("T")
#: Fields of requests that decide no value.
_IDLE = {"memory", "workers", "executor", "overwrite", "dry_run", "report_format"}
#: Texts from here on are no messages, but the tiles that a record keeps.
_LONG = 100_000
_PACKAGES = ("photoplan", "numpy", "numba", "scipy", "rasterio", "pyproj", "pyogrio", "shapely")


def recorded_result(product: Path, key: str, result: Callable[[dict[str, Any], Any], T | None]) -> T | None:
    """Return what `result` makes of the entries product and settings of a product's record; None if it has no such
    key."""
    try:
        record = json.loads(read_own(record_path(product)))
        return result(record["product"], record["settings"]) if record["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, UsageError):
        return None


def record_path(product: Path) -> Path:
    """Return the place of the record of a product: `NAME.run.json` next to it."""
    return product.with_name(f"{product.stem}.run.json")


def refuse_foreign_record(path: Path) -> None:
    """Refuse to replace a file that has the name of a run record and is none."""
    if os.path.exists(path) and _read_record(path) is None:  # noqa: PTH110 - a name may be too long for `Path.exists`
        raise UsageError(f"{path}: exists already and is no run record; move it away, or say `overwrite`")


def _read_record(path: Path) -> dict[str, Any] | None:
    try:
        record = json.loads(read_own(path))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and {"file", "key", "inputs", "versions"} <= record.keys() else None


def input_entry(path: Path | str, digest: str | None = None) -> dict[str, Any]:
    """Return the entry of an input in a record; its digest is sampled if it is not known."""
    return {"path": Path(path), "sampled_sha256": digest or fingerprint(path).digest, "size": Path(path).stat().st_size}


def run_key(kind: str, settings: object, inputs: Iterable[Path | Mapping[str, Any]]) -> str:
    """The digest of all that decides a product, of files or their entries: a run with another one starts afresh."""
    digests = [_entry(each)["sampled_sha256"] for each in inputs]
    known = {"by": __version__, "kind": kind, "settings": settings, "inputs": digests}
    return sha256(json_text(known, "settings").encode()).hexdigest()


def settings_of(request: Any) -> dict[str, Any]:
    """Fields of a request that may decide values: not its files, which are inputs or outputs."""
    options = (
        dict(request) if isinstance(request, Request) else {f.name: getattr(request, f.name) for f in fields(request)}
    )
    return {name: value for name, value in options.items() if name not in _IDLE and not _of_files(value)}


def _of_files(value: Any) -> bool:
    return isinstance(value, Path) or (
        isinstance(value, tuple) and bool(value) and all(isinstance(v, Path) for v in value)
    )


@contextmanager
def recording(kind: str, request: Any, inputs: Iterable[Any]) -> Iterator[Callable[[Iterable[Path | None], Any], None]]:
    """The record of a command that measures or converts: what it reads is looked at now, before it changes any of it.

    What is written inside gets its names together with the record, see `photoplan.io.store.together`.
    """
    times, settings = run_times(), settings_of(request)
    read = {Path(each): None for each in inputs if each is not None and Path(each).is_file()}
    entries = [input_entry(each) for each in read]
    key = run_key(kind, settings, entries)

    def record(written: Iterable[Path | None], product: Any) -> None:
        files = [path for path in written if path is not None]
        if files:
            path = files[0].with_name(f"{files[0].stem}.{kind}.run.json") if files[0] in read else None
            told = {"kind": kind, "product": product, "settings": settings, "files": files}
            write_run_record(files[0], path=path, key=key, inputs=entries, run=times(), **told)

    with together():
        yield record


def write_run_record(
    product: Path,
    /,
    *,
    key: str,
    inputs: Iterable[Path | Mapping[str, Any]],
    run: Mapping[str, Any],
    path: Path | None = None,
    **told: Any,
) -> Path:
    """Write the record of a product as JSON; the name holds the old or the whole new record."""
    entries = [_entry(each) for each in inputs]
    record = {"file": product.name, **told, "key": key, "inputs": entries, "run": run, "versions": versions()}
    if path is None:
        path = record_path(product)
        if _of_another(path, product):
            path = product.with_name(f"{product.name}.run.json")
    record["peak_memory_bytes"] = peak_memory_bytes()
    write_atomically(path, stated_json(record, path.parent))
    return path


def stated_json(values: Any, folder: Path) -> bytes:
    """JSON for a file in a folder: paths in it are written from there, with slashes on every system."""
    text = json_text(_stated(values, folder), "record")
    return (text + "\n").encode()


def _stated(value: Any, folder: Path) -> Any:
    if isinstance(value, Path):
        return stated_path(value, folder)
    if isinstance(value, str):
        return stated_text(value, folder) if len(value) < _LONG else value
    if isinstance(value, HasJsonFields):
        value = value.json_fields()
    if is_dataclass(value) and not isinstance(value, type):
        value = pick(value, *(each.name for each in fields(value)))
    if isinstance(value, Mapping):
        return {key: _stated(item, folder) for key, item in value.items()}
    return [_stated(item, folder) for item in value] if isinstance(value, list | tuple) else value


def _entry(each: Path | Mapping[str, Any]) -> Mapping[str, Any]:
    return each if isinstance(each, Mapping) else input_entry(each)


def _of_another(path: Path, product: Path) -> bool:
    """Return whether a record belongs to another file of the same name but for its extension, such as a model and a
    raster."""
    record = _read_record(path)
    other = product.name if record is None else record["file"]
    return other != product.name and product.with_name(str(other)).exists()


def versions() -> dict[str, str]:
    """Versions of all that takes part in a result; no word of the machine's name, user or folders."""
    found = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for name in _PACKAGES:
        found[name] = _installed(name)
    kernels = sys.modules.get("photoplan.kernels.numba_internals")  # not imported for its version alone
    if kernels is not None and kernels.UNTRIED:
        found["numba"] += " (not tried: plain loops)"
    found["GDAL"] = rasterio.__gdal_version__
    found["PROJ"] = rasterio.__proj_version__
    found["JPEG decoder"] = jpeg_decoder()
    return found


@cache
def _installed(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


@cache
def jpeg_decoder() -> str:
    """Return GDAL's decoder of JPEG, by the digest of a decoded picture, with its name if it is known."""
    with not_georeferenced(), gdal_settings(), rasterio.MemoryFile(_PICTURE) as file, file.open() as picture:
        digest = hashlib.sha256(picture.read().tobytes()).hexdigest()[:12]
    return f"{_DECODERS.get(digest, 'another')} ({digest})"


def run_times() -> Callable[[], dict[str, Any]]:
    """A clock that starts now; called at the end it gives `started` and `finished` (UTC) and `seconds`."""
    began, started = datetime.now(UTC), time.perf_counter()

    def ended() -> dict[str, Any]:
        seconds = time.perf_counter() - started
        return {"started": began, "finished": datetime.now(UTC), "seconds": round(seconds, 3)}

    return ended


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far, bytes."""
    if resource is None:
        import psutil  # noqa: PLC0415 - for Windows alone; 6 ms of each start elsewhere

        return int(psutil.Process().memory_info().peak_wset)
    # Linux counts in KiB, macOS in bytes.
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)

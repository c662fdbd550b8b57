"""Finished files get their names: one at once, or all of a product together."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import count
from pathlib import Path

from photoplan.errors import PhotoplanError, ResourceError, RunLocked, UsageError
from photoplan.io.disk import disk_error, open_own, read_own, refuse_outward, sync_file, sync_folder, write_all
from photoplan.io.lock import FileLock, lock_of
from photoplan.io.tile_log import log_of

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
        """Whether an earlier run has died."""

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
    """Where they are till then."""
    unfinished: set[Path] = field(default_factory=set)
    """Those whose names an earlier run gave before it died."""
    then: list[Callable[[], object]] = field(default_factory=list)
    held: ExitStack = field(default_factory=ExitStack)
    """Locks of products, and working folders."""
    locks: set[Path] = field(default_factory=set)
    """Those that it holds: a second attempt of the same run holds them already."""
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
    """Where a finished file is now: it may wait for its name."""
    group = _GROUP.get()
    return path if group is None else group.pending.get(path, path)


def is_unfinished(path: Path) -> bool:
    """Whether a file is of a product whose run died before all its files had their names."""
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
    """What a file keeps when it gets another name; None: there is none."""
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

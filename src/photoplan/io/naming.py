"""Finished files get their names: one at once, or all of a product together."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from photoplan.errors import PhotoplanError, UsageError
from photoplan.io.disk import disk_error, sync_file, sync_folder
from photoplan.io.lock import FileLock, lock_of
from photoplan.io.tile_log import log_of

_Identity = tuple[int, int, int]


@dataclass(eq=False)
class _Group:
    """Complete files that wait for their names."""

    waiting: dict[Path, _Identity | None] = field(default_factory=dict)
    """By the name to come: what has this name now."""
    unfinished: set[Path] = field(default_factory=set)
    """Those whose names an earlier run gave before it died."""
    then: list[Callable[[], object]] = field(default_factory=list)
    held: ExitStack = field(default_factory=ExitStack)
    """Locks of products."""

    def take(self, part: Path, path: Path) -> None:
        if path not in self.waiting and is_unfinished(path):
            self.unfinished.add(path)
        self.waiting.setdefault(path, _identity(path))
        part.replace(_pending(path))

    def give(self) -> None:
        """Give all names; whoever dies in between leaves notes that say which files are of an unfinished product."""
        for path, before in self.waiting.items():
            if _identity(path) != before:
                raise UsageError(f"{path}: another program made it meanwhile; choose another output or say `overwrite`")
        # Notes of a run that died are done with, also where this run has no such file.
        earlier = {Path(other) for path in self.waiting for other in _noted(path)["files"]}
        for path in earlier - self.waiting.keys():
            _note(path).unlink(missing_ok=True)
        for path in self.waiting:
            self._write_note(path, _identity(_pending(path)))
        for path in self.waiting:
            _pending(path).replace(path)
        for folder in {path.parent for path in self.waiting}:
            sync_folder(folder)
        for action in self.then:
            action()
        self.leave()

    def leave(self) -> None:
        """Remove what hidden files are left; notes stay where a name was given and another one was not."""
        unnamed = [path for path in self.waiting if _pending(path).exists()]
        for path in self.waiting:
            _pending(path).unlink(missing_ok=True)
            if path in unnamed and path in self.unfinished:
                with suppress(OSError):
                    self._write_note(path, self.waiting[path])
            elif path in unnamed or not unnamed:
                _note(path).unlink(missing_ok=True)

    def _write_note(self, path: Path, identity: _Identity | None) -> None:
        files = [str(each.absolute()) for each in self.waiting]
        _note(path).write_text(json.dumps({"files": files, "identity": identity}))


_GROUP: ContextVar[_Group | None] = ContextVar("files that get their names together", default=None)


@contextmanager
def together() -> Iterator[None]:
    """Files that are finished inside get their names when the context ends well: at once, as far as a file system can.

    Their order is that in which they were finished: a run record comes last. A run that dies between two names leaves
    files of which `is_unfinished` knows, so that the same command goes on. Inside another such context this one does
    nothing: the outer one names all.

    Raises
    ------
    UsageError
        A file appeared under one of the names meanwhile, or a folder cannot be written.
    ResourceError
        The disk is full.
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
    """Hold a lock, see `FileLock`; inside `together` until the files have their names.

    Raises
    ------
    RunLocked, UsageError, ResourceError
        See `FileLock`.
    """
    group = _GROUP.get()
    with ExitStack() as stack:
        (stack if group is None else group.held).enter_context(FileLock(lock))
        yield


def give_name(part: Path, path: Path) -> None:
    """Give a complete file its name, when it is safe on the disk: now, or with the others of `together`.

    Raises
    ------
    OSError
        The system cannot.
    """
    sync_file(part)
    group = _GROUP.get()
    if group is None:
        part.replace(path)
        sync_folder(path.parent)
    else:
        group.take(part, path)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a small file so that its name holds either the old or the whole new content; see `give_name`.

    Raises
    ------
    ResourceError, UsageError
        See `disk_error`.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            partial.write_bytes(content)
            give_name(partial, path)
        finally:
            partial.unlink(missing_ok=True)
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
    return _pending(path) if group is not None and path in group.waiting else path


def is_unfinished(path: Path) -> bool:
    """Whether a file is of a product whose run died before all its files had their names."""
    now = _identity(path)
    return now is not None and _noted(path)["identity"] == [*now]


def forget(path: Path) -> None:
    """Remove the note that a file is of an unfinished product."""
    _note(path).unlink(missing_ok=True)


def _noted(path: Path) -> dict[str, Any]:
    """What a run that died has noted: all files that were to get their names, and which one this is."""
    try:
        noted = json.loads(_note(path).read_text())
    except (OSError, ValueError, RecursionError):
        noted = None
    return noted if isinstance(noted, dict) and noted.keys() == {"files", "identity"} else {"files": [], "identity": []}


def _pending(path: Path) -> Path:
    return path.with_name(f".{path.name}.pending")


def _note(path: Path) -> Path:
    return path.with_name(f".{path.name}.unfinished")


def _identity(path: Path) -> _Identity | None:
    """What a file keeps when it gets another name; None: there is none."""
    try:
        state = path.stat()
    except OSError:
        return None
    return state.st_ino, state.st_size, state.st_mtime_ns


def tidy(paths: Iterable[Path]) -> None:
    """Remove what a run that was killed after it had given the last name left beside the files of its product.

    Files that another run is writing are left alone, and so is what cannot be removed: the product is finished.
    """
    for path in filter(is_unfinished, paths):
        with suppress(PhotoplanError, OSError), FileLock(lock_of(path)):
            log_of(path).unlink(missing_ok=True)
            forget(path)

"""Files to be: what is finished of them is kept in a log beside, and they get their names when they are complete."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from photoplan.errors import PhotoplanError, ResourceError, UsageError
from photoplan.io.disk import disk_error, free_megabytes
from photoplan.io.gdal import first_cause
from photoplan.io.lock import FileLock, lock_of
from photoplan.io.naming import give_name, scratch
from photoplan.io.tile_log import TileLog


@dataclass(eq=False)
class Unfinished:
    """A file that is made of a log, under a lock."""

    path: Path
    log_path: Path
    what: str
    """What the log holds, for messages: tiles."""
    check: Callable[[], None]
    """Refuses a file that must not be replaced."""
    faults: tuple[type[BaseException], ...]
    """What a library raises that cannot write."""
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

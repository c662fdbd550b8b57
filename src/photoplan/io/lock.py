"""One run at a time for each product."""

from __future__ import annotations

import os
import re
from pathlib import Path

from photoplan.errors import RunLocked, UsageError
from photoplan.io.disk import disk_error, open_own

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
    import msvcrt


def lock_of(product: Path) -> Path:
    """The file whose lock says that a product is being written."""
    return product.with_name(f".{product.name}.lock")


class FileLock:
    """An exclusive lock on a file beside the product; a context manager.

    The system releases it when the process ends, however it ends, so a lock file that was left behind means nothing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def __enter__(self) -> FileLock:
        self.acquire()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def acquire(self) -> None:
        """Take the lock, or say who holds it."""
        while self._descriptor is None:
            try:
                descriptor = open_own(self._path)
            except OSError as error:
                raise disk_error(self._path, error, "made") from error
            if not _try_lock(descriptor):
                holder = os.pread(descriptor, 32, 1).decode("ascii", "replace").strip() if fcntl else ""
                os.close(descriptor)
                raise RunLocked(
                    f"{self._path}: another run{f' (process {holder})' if holder else ''} is writing this product; "
                    "wait for it, or choose another output"
                )
            # The holder before may have removed the file between our opening and locking it: then this lock guards
            # a file without a name, and the next run would make a new one.
            if _same_file(descriptor, self._path):
                if not re.fullmatch(rb"\s*[0-9]*\s*", os.read(descriptor, 64)):
                    os.close(descriptor)
                    raise UsageError(f"{self._path}: is not a lock file of photoplan; move it away")
                self._descriptor = descriptor
                try:
                    os.lseek(descriptor, 0, os.SEEK_SET)
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, f" {os.getpid()}\n".encode())
                except OSError as error:
                    self.release()
                    raise disk_error(self._path, error) from error
            else:
                os.close(descriptor)

    def release(self) -> None:
        """Give the lock back and remove its file."""
        if self._descriptor is None:
            return
        descriptor, self._descriptor = self._descriptor, None
        if fcntl and _same_file(descriptor, self._path):
            self._path.unlink(missing_ok=True)
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    try:
        if fcntl:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except OSError:
        return False
    return True


def _same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except OSError:
        return False

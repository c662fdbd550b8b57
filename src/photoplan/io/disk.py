"""Writing files so that nothing half-written stays: errors of the disk, and replacing a file at once."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from photoplan.errors import PhotoplanError, ResourceError, UsageError

#: Bytes that must be free where a library says no more than that it cannot write.
_TRIAL = 1 << 20
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOMEM}


def disk_error(path: Path, error: OSError, doing: str = "written") -> PhotoplanError:
    """The error of the tree for an error of the system: a full disk (exit 5), or a place that cannot be used (2)."""
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        return ResourceError(
            f"{path}: cannot be {doing} ({reason}; {free_megabytes(path)} MB are free there); free some space and "
            "run the same command again; if it makes tiles, finished tiles are kept"
        )
    return UsageError(f"{path}: cannot be {doing} ({reason}); choose a folder that can be written")


def library_error(path: Path, error: BaseException) -> PhotoplanError:
    """The same for what libraries of rasters and vector files raise, which do not tell a full disk from other reasons.

    A trial does: as much as the file is likely to need is written beside it, and removed.
    """
    trial = path.with_name(f".{path.name}.{os.getpid()}.trial")
    try:
        with trial.open("wb") as file:
            write_all(file.fileno(), bytes(_TRIAL))
            os.fsync(file.fileno())
    except OSError as reason:
        return disk_error(path, reason)
    finally:
        trial.unlink(missing_ok=True)
    return UsageError(f"{path}: cannot be written ({error}); choose a folder that can be written")


def free_megabytes(path: Path) -> int:
    """Free space of the file system that holds a path, megabytes; -1 if it is unknown."""
    try:
        return shutil.disk_usage(path if path.is_dir() else path.parent).free // 1_000_000
    except OSError:
        return -1


def make_folder(folder: Path) -> None:
    """Make a folder for products, if it is not there.

    Raises
    ------
    UsageError
        It cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: no such folder, and it cannot be made ({error.strerror})") from None


def write_all(descriptor: int, *parts: bytes | memoryview) -> None:
    """Write all parts, however many calls the system needs."""
    waiting = [memoryview(part).cast("B") for part in parts if len(memoryview(part).cast("B"))]
    while waiting:
        written = os.writev(descriptor, waiting) if os.name == "posix" else os.write(descriptor, waiting[0])
        while waiting and written >= len(waiting[0]):
            written -= len(waiting.pop(0))
        if waiting and written:
            waiting[0] = waiting[0][written:]


def sync_file(path: Path) -> None:
    """Wait until a file is on the disk; a late "disk full" of the file system appears here."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk, where the system can do that."""
    if os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        # Some network file systems cannot; the names are then as safe as the system makes them.
        pass
    finally:
        os.close(descriptor)

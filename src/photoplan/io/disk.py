"""Free space and locks."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

from photoplan.errors import PhotoplanError, ResourceError, RunLocked, UsageError

#: Bytes that must be free where a library says no more than that it cannot write.
_TRIAL = 1 << 20
#: Bytes of a user's secret.
_SECRET = 32
_RECEIVED: set[Path] = set()
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOMEM}


def cache_folder() -> Path:
    """Return where only time is saved: PHOTOPLAN_CACHE_DIR, or photoplan in the user's cache folder."""
    if stated := os.environ.get("PHOTOPLAN_CACHE_DIR"):
        return Path(stated)
    if sys.platform == "win32":
        above = Path(os.environ.get("LOCALAPPDATA") or "~/AppData/Local")
    elif sys.platform == "darwin":
        above = Path("~/Library/Caches")
    else:
        above = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    return above.expanduser() / "photoplan"


@cache
def own_secret(folder: Path) -> bytes:
    """Return random bytes of this user, kept in the cache folder; none if it cannot be written.

    Logs of finished work begin with a digest that needs them: a log that somebody else has prepared is not continued.
    """
    path = folder / "own"
    try:
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            descriptor, made = tempfile.mkstemp(dir=folder)
            with os.fdopen(descriptor, "wb") as file:
                file.write(os.urandom(_SECRET))
            Path(made).replace(path)
        found = path.read_bytes()
    except OSError:
        return b""
    return found if len(found) == _SECRET else b""


def disk_error(path: Path, error: OSError, doing: str = "written") -> PhotoplanError:
    """The error of the tree for an error of the system: a full disk (exit 5), or a place that cannot be used (2)."""
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        return ResourceError(
            f"{path}: cannot be {doing} ({reason}; {free_megabytes(path)} MB are free there); free some space and "
            "run the same command again; if it makes tiles, finished tiles are kept"
        )
    if error.errno == errno.ENOENT and not path.parent.is_dir():
        return UsageError(f"{path.parent}: no such folder; make it first")
    return UsageError(f"{path}: cannot be {doing} ({reason}); choose a folder that can be written")


def library_error(path: Path, error: BaseException) -> PhotoplanError:
    """The same for what libraries of rasters and vector files raise, which do not tell a full disk from other reasons.

    A trial does: as much as the file is likely to need is written beside it, and removed.
    """
    try:
        with tempfile.TemporaryFile(dir=path.parent, buffering=0) as file:
            write_all(file.fileno(), bytes(_TRIAL))
            os.fsync(file.fileno())
    except OSError as reason:
        return disk_error(path, reason)
    return UsageError(f"{path}: cannot be written ({error}); choose a folder that can be written")


def received(folder: Path) -> None:
    """Take a folder, such as that of a project, as one that may come from elsewhere, see `refuse_outward`."""
    _RECEIVED.add(folder.absolute())


def refuse_outward(folder: Path) -> None:
    """Refuse to write through a link inside a received folder that leads out of it."""
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 - `resolve` would follow the links
    for place in (folder, *folder.parents):
        for home in _RECEIVED.intersection(place.parents):
            if place.is_symlink() and not place.resolve().is_relative_to(home.resolve()):
                raise UsageError(
                    f"{place}: is a link that leads out of the folder of the project; to write there, give "
                    f"{place.resolve()} itself as output"
                )


def open_own(path: Path, flags: int = os.O_RDWR | os.O_CREAT) -> int:
    """Open a working file of ours, such as a lock, and return its descriptor; links are not followed.

    A folder that came from elsewhere may hold a link under the name: to a file that is not to be changed, or a device
    or pipe that would never end.
    """
    writes = flags & (os.O_RDWR | os.O_WRONLY)
    foreign = UsageError(f"{path}: must be a plain file of photoplan, and is a link or something else; remove it")

    def refuse_other() -> None:
        try:
            state = os.lstat(path)
        except FileNotFoundError:
            return
        if not stat.S_ISREG(state.st_mode) or (writes and state.st_nlink > 1):
            raise foreign

    if flags & os.O_CREAT:
        refuse_outward(path.parent)
    # Windows has no flag that keeps links from being followed: names are looked at before and after.
    refuse_other()
    plain = ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY", "O_NOINHERIT")
    for name in plain:
        flags |= getattr(os, name, 0)
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        raise foreign if error.errno == errno.ELOOP else error from None
    try:
        refuse_other()
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise foreign
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def read_own(path: Path, most: int = 256 << 20) -> bytes:
    """Return the content of a file that photoplan wrote, such as a run record; links and devices are not read."""
    try:
        descriptor = open_own(path, os.O_RDONLY)
    except UsageError as error:
        raise OSError(errno.ELOOP, str(error)) from error
    with os.fdopen(descriptor, "rb") as file:
        if os.fstat(descriptor).st_size > most:
            raise OSError(errno.EFBIG, f"larger than {most} bytes")
        return file.read(most)


def free_megabytes(path: Path) -> int:
    """Free space of the file system that holds a path, megabytes; -1 if it is unknown."""
    try:
        return shutil.disk_usage(path if path.is_dir() else path.parent).free // 1_000_000
    except OSError:
        return -1


def make_parents(folder: Path) -> None:
    """Make a folder and those around it; raises OSError, and as `refuse_outward`."""
    refuse_outward(folder)
    folder.mkdir(parents=True, exist_ok=True)


def make_folder(folder: Path) -> None:
    """Make a folder for products, if it is not there."""
    try:
        make_parents(folder)
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

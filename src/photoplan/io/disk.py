"""Disks and GDAL: free space, locks, settings and warnings, open handles, storage of products."""

from __future__ import annotations

import atexit
import errno
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from photoplan.arrays import Mask
from photoplan.errors import InputError, PhotoplanError, ResourceError, RunLocked, UsageError
from photoplan.kernels.raster import fill_block

CACHE_BYTES = 32 << 20
"""GDAL's block cache of the whole process; its default of a twentieth of the memory is not bounded enough."""
GDAL_ERRORS = (RasterioError, CPLE_BaseError)
"""Errors that a call of rasterio may raise: its own, and GDAL's if it does not translate them."""
FIXED_DATE = "2000-01-01T00:00:00.000Z"
"""The date of change in GeoPackages: with the time of writing two runs would not make equal files."""
_HANDLES_PER_THREAD = 4
_DAMAGE = re.compile(r"corrupt|premature|truncat|too short|not enough data|invalid|bad huffman|crc|checksum", re.I)
_open_lock = threading.RLock()


def gdal_settings(**more: Any) -> rasterio.Env:
    """The settings under which every raster is opened, read and written; a context manager.

    A warning of the JPEG library is an error, vertical reference systems are reported, nothing is fetched from a
    network.
    """
    settings = {
        # In bytes: rasterio hands a number on as it is, where GDAL's own option would mean MiB.
        "GDAL_CACHEMAX": CACHE_BYTES,
        "GDAL_ERROR_ON_LIBJPEG_WARNING": True,
        "GTIFF_REPORT_COMPD_CS": True,
        "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".nothing",
        "GDAL_HTTP_TIMEOUT": 1,
        "OGR_CURRENT_DATE": FIXED_DATE,
    }
    return rasterio.Env(**(settings | more))


class _Collector(logging.Filter):
    """Takes GDAL's warnings of a thread that asked for them; all others pass on."""

    def __init__(self) -> None:
        super().__init__()
        self.thread = threading.local()

    def filter(self, record: logging.LogRecord) -> bool:
        found: list[str] | None = getattr(self.thread, "found", None)
        if found is None or record.levelno < logging.WARNING:
            return True
        found.append(record.getMessage())
        return False


_collector = _Collector()
_loggers = tuple(logging.getLogger(f"rasterio.{name}") for name in ("_env", "_err"))


@contextmanager
def warnings_of_gdal() -> Iterator[list[str]]:
    """A list that GDAL's warnings of this thread are added to while the context lasts.

    Some decoders only warn where the picture is damaged (JPEG inside TIFF, for one).
    """
    for logger in _loggers:
        logger.addFilter(_collector)  # adding it twice adds it once
    found: list[str] = []
    before = getattr(_collector.thread, "found", None)
    _collector.thread.found = found
    try:
        yield found
    finally:
        _collector.thread.found = before


def damage_in(found: list[str]) -> str | None:
    """First of the warnings that speaks of damaged pixels."""
    return next((text for text in found if _DAMAGE.search(text)), None)


def all_causes(error: BaseException) -> list[str]:
    """Return GDAL's messages about an error, the first cause first; one line each."""
    chain: list[BaseException] = [error]
    while chain[-1].__cause__ is not None:
        chain.append(chain[-1].__cause__)
    return [" ".join(str(getattr(link, "errmsg", link)).split())[:300] for link in reversed(chain)]


def first_cause(error: BaseException) -> str:
    """Return GDAL's first message about an error, in one line."""
    return all_causes(error)[0]


def open_raster(path: Path, driver: str | None, overview: int | None = None, **options: Any) -> Any:
    """Open a raster, or one of its overviews (from 0), for reading with one driver (None: any) and its options."""
    try:
        with not_georeferenced(), gdal_settings():
            options |= {} if overview is None else {"OVERVIEW_LEVEL": overview}
            return rasterio.open(path, driver=driver, sharing=False, **options)
    except (*GDAL_ERRORS, OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be opened ({first_cause(error)}); the file is damaged or cut off, get a fresh copy"
        ) from error


@contextmanager
def not_georeferenced() -> Iterator[None]:
    """Open and write rasters that need no georeference without a word about it.

    `catch_warnings` changes a list of the whole process, so only one thread may be inside, as often as it likes.
    """
    with _open_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


class _Handles(threading.local):
    """Open rasters of one thread; they close when the thread ends. GDAL's handles must not be shared."""

    def __init__(self) -> None:
        self.open: OrderedDict[tuple[str, int, int, int | None], Any] = OrderedDict()


_handles = _Handles()


def handle(path: Path, driver: str | None, overview: int | None = None) -> Any:
    """This thread's open handle of a raster or of one of its overviews; opened again when the file was replaced."""
    try:
        state = path.stat()
        key = str(path), state.st_mtime_ns, state.st_ino, overview
    except OSError as error:
        if driver is not None:
            raise InputError(f"{path}: is no longer there ({error.strerror})") from error
        key = str(path), 0, 0, overview
    found = _handles.open.get(key)
    if found is None:
        found = open_raster(path, driver, overview)
        _handles.open[key] = found
        while len(_handles.open) > _HANDLES_PER_THREAD:
            _handles.open.popitem(last=False)[1].close()
    else:
        _handles.open.move_to_end(key)
    return found


def close_handles() -> None:
    """Close all rasters that this thread holds open."""
    while _handles.open:
        _handles.open.popitem()[1].close()


# Left to the interpreter's end, rasterio closes them when its own modules are gone: "Error in sys.excepthook" (3.12).
atexit.register(close_handles)


TARGET = "PHOTOPLAN_TARGET"
"""The tag in which the file of a surface names what its heights lie over."""


def target_of(path: Path, driver: str) -> str | None:
    """Return what the heights of a raster lie over; None if that is a map, or the file does not say."""
    with open_raster(path, driver) as dataset:
        target: str = dataset.tags().get(TARGET, "map")
    return None if target == "map" else target


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


COMPRESSIONS = ("none", "deflate", "zstd", "lzw", "jpeg")
PRODUCT_TYPES = ("uint8", "uint16", "int16", "float32", "float64")
Nodata = float | Literal["auto", "mask"]


def nodata_for(dtype: np.dtype[Any], wanted: Nodata, compress: str) -> float | None:
    """The nodata value of a product; None stands for a mask band.

    `auto` is 0 for unsigned integers, -32768 for int16 and NaN for floats. JPEG changes values, so it always takes a
    mask.
    """
    if wanted == "mask" or compress == "jpeg":
        return None
    if wanted == "auto":
        return {"u": 0.0, "i": -32768.0, "f": float("nan")}[dtype.kind]
    value = float(wanted)
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        if not limits.min <= value <= limits.max or value != int(value):
            raise UsageError(f"nodata {wanted}; {dtype} holds whole numbers from {limits.min} to {limits.max}")
    return value


@dataclass(frozen=True)
class BlockCoder:
    """Turns a tile (bands, h, w) into one block of a tiled TIFF: (side, side, bands), and its mask, as bytes."""

    side: int
    """Side of a block in pixels."""
    bands: int
    """Bands."""
    dtype: np.dtype[Any]
    """Type of the pixels."""
    nodata: float | None
    """Nodata value; None: a mask of one byte per pixel (0 or 255) follows the pixels."""
    lossy: bool = False
    """The compression changes values: what lies under the mask must not stand out."""

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a block's pixels."""
        return self.side * self.side * self.bands * self.dtype.itemsize

    @property
    def mask_bytes(self) -> int:
        """Bytes of a block's mask; 0 with a nodata value."""
        return self.side * self.side if self.nodata is None else 0

    def encode(self, pixels: NDArray[Any], valid: Mask | None) -> tuple[bytes | memoryview, int]:
        """Bytes of a block, and how many valid values were moved because they equalled nodata.

        Such a value becomes its neighbour (nodata + 1, or nodata - 1 at the upper end of the type), so that no reader
        takes a valid dark pixel for nothing. Invalid pixels become nodata, or 0 under a mask; with a lossy compression
        they take the tile's mean, because a step to black would ring into the valid pixels beside it.
        """
        bands, height, width = pixels.shape
        valid = None if valid is None or valid.all() else valid
        block = np.empty((self.side, self.side, bands), self.dtype)
        if height < self.side or width < self.side:
            block[:] = 0 if self.nodata is None else self.nodata
        nodata, neighbour = self._kept_apart()
        fill = np.full(bands, 0 if self.nodata is None else self.nodata, self.dtype)
        if self.lossy and valid is not None and valid.any():
            fill[:] = [np.rint(band[valid].mean()) for band in pixels]
        usable = np.empty((0, 0), bool) if valid is None else np.require(valid, bool, "C")
        moved = int(fill_block(np.require(pixels, self.dtype, "C"), usable, nodata, neighbour, fill, block))
        if self.nodata is not None:
            return block.data.cast("B"), moved
        mask = np.zeros((self.side, self.side), np.uint8)
        mask[:height, :width] = 255 if valid is None else valid * np.uint8(255)
        return b"".join((block.data.cast("B"), mask.data.cast("B"))), 0

    def _kept_apart(self) -> tuple[Any, Any]:
        """The value that valid pixels must not have, and what they become; equal where nothing has to be changed."""
        number = self.dtype.type
        if self.nodata is None or self.dtype.kind == "f":
            return number(0), number(0)
        step = 1 if self.nodata < np.iinfo(self.dtype).max else -1
        return number(self.nodata), number(self.nodata + step)

    def decode(self, payload: bytes, shape: tuple[int, int]) -> tuple[NDArray[Any], Mask]:
        """Pixels (bands, h, w) and validity (h, w) of a block's bytes; `shape` cuts a border block."""
        block = np.frombuffer(payload[: self.pixel_bytes], self.dtype).reshape(self.side, self.side, self.bands)
        pixels = np.moveaxis(block, -1, 0)[:, : shape[0], : shape[1]]
        if self.nodata is None:
            mask = np.frombuffer(payload[self.pixel_bytes :], np.uint8).reshape(self.side, self.side)
            return pixels, mask[: shape[0], : shape[1]] > 0
        empty = np.isnan(pixels) if np.isnan(self.nodata) else pixels == self.nodata
        return pixels, ~empty.all(axis=0)


#: Formats of pictures, by the suffix of a file's name.
PICTURES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def write_picture(source: Path, target: Path, driver: str, quality: int, note: str) -> None:
    """Copy a raster of one or three bands of bytes into a PNG or JPEG, row by row."""
    options: dict[str, Any] = {"quality": quality, "comment": note} if driver == "JPEG" else {}
    if driver == "PNG":
        options = {"write_metadata_as_text": "YES", "description": note}
    with gdal_settings(GDAL_PAM_ENABLED=False), warnings_of_gdal() as found:
        rasterio.shutil.copy(source, target, driver=driver, **options)
    if found:
        raise PhotoplanError(f"{target}: GDAL could not write it cleanly ({found[0]})")


RESAMPLINGS = ("average", "mode", "nearest")


@dataclass(frozen=True)
class CogOptions:
    """How a cloud-optimised GeoTIFF is stored."""

    compress: str = "deflate"
    """`none`, `deflate`, `zstd`, `lzw` or `jpeg` (8 bit, one or three bands)."""
    overviews: bool = True
    """Reduced copies inside the file."""
    tile: int = 512
    """Side of the blocks in pixels; a multiple of 16, at least 128."""
    quality: int = 90
    """Quality of JPEG, 1 to 100."""
    level: int = 6
    """Effort of DEFLATE and ZSTD, 1 to 9."""
    threads: int = 1
    """Threads that compress."""
    resampling: str = "average"
    """How the reduced copies are made: `average`, `mode` or `nearest`."""

    def __post_init__(self) -> None:
        if self.compress not in COMPRESSIONS:
            raise UsageError(f"compression {self.compress!r}; allowed are {', '.join(COMPRESSIONS)}")
        if self.tile < 128 or self.tile % 16 or self.tile > 4096:
            raise UsageError(f"blocks of {self.tile} pixels; a multiple of 16 from 128 to 4096 is needed")
        if self.resampling not in RESAMPLINGS:
            raise UsageError(f"overviews by {self.resampling!r}; allowed are {', '.join(RESAMPLINGS)}")
        if not (1 <= self.quality <= 100 and 1 <= self.level <= 9 and self.threads >= 1):
            raise UsageError(f"quality {self.quality}, level {self.level}, threads {self.threads}; see CogOptions")

    def creation(self, dtype: np.dtype[Any]) -> dict[str, Any]:
        """Creation options of GDAL's COG driver for a type of pixels."""
        options: dict[str, Any] = {
            "compress": self.compress.upper(),
            "blocksize": self.tile,
            "overviews": "IGNORE_EXISTING" if self.overviews else "NONE",
            "overview_resampling": self.resampling.upper(),
            "bigtiff": "IF_SAFER",
            "sparse_ok": True,
            "num_threads": self.threads,
        }
        if self.compress in ("deflate", "zstd", "lzw"):
            options["predictor"] = "FLOATING_POINT" if dtype.kind == "f" else "STANDARD"
            if self.compress != "lzw":
                options["level"] = self.level
        if self.compress == "jpeg":
            options["quality"] = self.quality
        return options


def write_cog(source: Path, target: Path, options: CogOptions, dtype: np.dtype[Any]) -> None:
    """Copy a raster into a cloud-optimised GeoTIFF; memory stays low because the source is read by blocks."""
    temporary = {"CPL_TMPDIR": os.fspath(target.parent), "GDAL_TIFF_INTERNAL_MASK": True, "GDAL_PAM_ENABLED": False}
    with gdal_settings(**temporary), warnings_of_gdal() as found:
        rasterio.shutil.copy(source, target, driver="COG", **options.creation(dtype))
    if found:
        raise PhotoplanError(f"{target}: GDAL could not write it cleanly ({found[0]})")

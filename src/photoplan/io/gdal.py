"""GDAL's settings and warnings, and one open handle per thread."""

from __future__ import annotations

import atexit
import logging
import re
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from photoplan.errors import InputError

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

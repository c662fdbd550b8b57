"""Input files are looked at before any library opens them: what they are, and how much they promise.

Only plain files of a short list of raster formats pass. A file is opened with the one driver that its first bytes
name, so a virtual raster or a network source under an innocent name is never followed.
"""

from __future__ import annotations

import os
import re
import sqlite3
import stat
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.appearance import looks_like

_GIB = 1 << 30

DRIVER_NAMES = {
    "GTiff": "TIFF",
    "JPEG": "JPEG",
    "PNG": "PNG",
    "JP2OpenJPEG": "JPEG 2000",
    "BMP": "BMP",
    "NITF": "NITF",
    "AAIGrid": "ASCII grid",
}
"""Formats that are read, by the name of GDAL's driver."""

_MAGIC: tuple[tuple[bytes, str], ...] = (
    (b"II*\x00", "GTiff"),
    (b"MM\x00*", "GTiff"),
    (b"II+\x00", "GTiff"),
    (b"MM\x00+", "GTiff"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"\x89PNG\r\n\x1a\n", "PNG"),
    (b"\x00\x00\x00\x0cjP  \r\n\x87\n", "JP2OpenJPEG"),
    (b"\xff\x4f\xff\x51", "JP2OpenJPEG"),
    (b"BM", "BMP"),
    (b"NITF", "NITF"),
    (b"NSIF", "NITF"),
)
_GRID_WORDS = (b"ncols", b"nrows", b"xllcorner", b"xllcenter", b"yllcorner", b"yllcenter", b"cellsize", b"dx ")


@dataclass(frozen=True)
class RasterLimits:
    """How much a raster may promise. Raise a limit where a file is trusted."""

    max_pixels: float = 1e11
    """Pixels of the whole raster (width × height)."""
    max_block_bytes: int = _GIB
    """Bytes of one decoded block (strip, tile or scan line) of all bands: it is held in memory at once."""
    max_ratio: float = 250.0
    """Decoded bytes per stored byte; only asked of files that decode to more than `ratio_from` bytes. Blocks that are
    not stored at all (sparse files) do not count."""
    ratio_from: int = _GIB
    """Decoded size in bytes from which `max_ratio` is asked."""

    def __post_init__(self) -> None:
        if min(self.max_pixels, self.max_block_bytes, self.max_ratio) <= 0 or self.ratio_from < 0:
            raise InputError(f"limits {self}; all of them must be positive")


IMAGE_LIMITS = RasterLimits()
"""For images: up to 316,000 pixels a side."""
TERRAIN_LIMITS = RasterLimits(max_pixels=1e12, max_ratio=1000.0)
"""For terrain grids: a country at 1 m, most of it empty."""


def open_database(path: Path, most: int = 256 << 20) -> sqlite3.Connection:
    """Open a GeoPackage of others for reading: no functions in its schema, no value larger than `most` bytes."""
    # A file that a GIS has just open may have a log beside it, which must be looked at; else nothing may change, and
    # SQLite need not lock anything: this works in read-only folders too.
    waiting = path.with_name(path.name + "-wal")
    quiet = "" if waiting.exists() and waiting.stat().st_size else "&immutable=1"
    db = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{quiet}", uri=True, check_same_thread=False)
    db.execute("PRAGMA trusted_schema = OFF")
    db.execute("PRAGMA cell_size_check = ON")
    db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most)
    return db


def plain_tables(db: sqlite3.Connection) -> set[str]:
    """Return the names of the plain tables: a view under one of our names could compute without end."""
    query = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
    return {str(name) for (name,) in db.execute(query)}


def check_plain_file(path: str | os.PathLike[str], what: str = "raster") -> Path:
    """The path of an existing, readable, non-empty plain file."""
    text = os.fspath(path)
    if not text:
        raise InputError(f"no {what} was given: the path is empty")
    if text.lstrip().startswith(("<", "{")):
        raise InputError(f"{what} {_short(text)}: a document was given where the path of a file is needed")
    if text.replace("\\", "/").lstrip("/").lower().startswith("vsi") and text[:1] in "/\\":
        raise InputError(f"{what} {_short(text)}: virtual file systems (/vsi…) are not followed; give a plain file")
    if re.match(r"[A-Za-z][A-Za-z0-9_+.-]+:", text):
        raise InputError(
            f"{what} {_short(text)}: network addresses and parts of files (NAME:file:part) are not followed; "
            "download or extract it and give the plain file"
        )
    if "\x00" in text:
        raise InputError(f"{what} {_short(text)}: the path holds a zero byte")
    plain = Path(path)
    try:
        mode = plain.stat()
    except FileNotFoundError:
        raise InputError(f"{what} {plain}: there is no such file") from None
    except OSError as error:
        raise InputError(f"{what} {plain}: cannot be looked at ({error.strerror})") from error
    if not stat.S_ISREG(mode.st_mode):
        raise InputError(f"{what} {plain}: not a plain file; give the path of a file")
    if mode.st_size == 0:
        raise InputError(f"{what} {plain}: the file is empty; get a fresh copy")
    return plain


def raster_driver(path: Path) -> str:
    """The one driver that may open a plain file, named by the file's first bytes (its suffix does not matter)."""
    head = _head(path, 512)
    for magic, driver in _MAGIC:
        if head.startswith(magic):
            return driver
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if text.startswith(_GRID_WORDS):
        return "AAIGrid"
    known = ", ".join(sorted(set(DRIVER_NAMES.values())))
    if text.startswith((b"<vrt", b"<?xml", b"<gdal", b"<")):
        raise InputError(
            f"{path}: the content is an XML document (a virtual raster or a network source), whatever the name says; "
            f"it is not followed. Make a plain copy of it with `gdal_translate` and give that ({known})"
        )
    raise InputError(
        f"{path}: not a raster that is read here; allowed are {known}, others after `gdal_translate`{looks_like(path)}"
    )


def check_sidecars(path: Path) -> None:
    """Refuse files beside a raster that would lead the reader elsewhere.

    Masks (`.msk`) and overviews (`.ovr`) must be TIFF; `.aux.xml` must not name other files.
    """
    for suffix in (".msk", ".ovr", ".MSK", ".OVR"):
        side = path.with_name(path.name + suffix)
        if side.is_file() and not _head(side, 4).startswith((b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")):
            raise InputError(f"{side}: a mask or overview file beside {path.name} must be a TIFF; remove it")
    aux = path.with_name(path.name + ".aux.xml")
    if aux.is_file():
        if aux.stat().st_size > 64 << 20:
            raise InputError(f"{aux}: larger than 64 MiB; remove it or give a plain copy of {path.name}")
        content = aux.read_bytes()
        if b"OVERVIEW_FILE" in content or b"<!ENTITY" in content or b"<!DOCTYPE" in content:
            raise InputError(f"{aux}: leads to other files, which are not followed; remove it")


def check_declared_size(
    path: Path, limits: RasterLimits, *, size: tuple[int, int], pixel_bytes: int, block: tuple[int, int], stored: float
) -> None:
    """Compare what a header promises with what the file can hold."""
    width, height = size
    pixels = width * height
    if width < 1 or height < 1:
        raise InputError(f"{path}: the header says {width} × {height} pixels; the file is damaged, get a fresh copy")
    if pixels > limits.max_pixels:
        raise InputError(
            f"{path}: the header promises {width} × {height} pixels, more than the limit of {limits.max_pixels:.3g}; "
            "cut the part that is needed (`gdal_translate -srcwin`)"
        )
    block_bytes = block[0] * block[1] * pixel_bytes
    if block_bytes > limits.max_block_bytes:
        raise InputError(
            f"{path}: one block of {block[0]} × {block[1]} pixels takes {block_bytes / _GIB:.1f} GiB, more than the "
            f"limit of {limits.max_block_bytes / _GIB:.1f} GiB; store it in tiles (`gdal_translate -co TILED=YES`)"
        )
    if stored > limits.max_ratio and pixels * pixel_bytes > limits.ratio_from:
        raise InputError(
            f"{path}: promises {pixels * pixel_bytes / _GIB:.1f} GiB, {stored:.0f} times what is stored (limit "
            f"{limits.max_ratio:.0f}); a file that is trusted can be stored again in tiles without compression"
        )


def _head(path: Path, count: int) -> bytes:
    """First bytes of a file; an error of the system becomes an input error."""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _short(text: str) -> str:
    """A text that is safe and short enough for a message."""
    return repr(text if len(text) <= 100 else text[:97] + "...")

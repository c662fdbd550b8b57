"""Files in general: limits, encodings, JSON, XML and YAML, names, errors, fingerprints."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import sqlite3
import stat
import struct
import sys
import tomllib
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import yaml
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from pydantic import BaseModel, ValidationError

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.crs import split_compound
from photoplan.geometry.units import MetricSystem, metric_system

_LOOK = 4096
#: First bytes, and what begins with them.
_MAGIC = {
    b"PK\x03\x04": "a ZIP archive; unpack it first",
    b"\x1f\x8b": "a gzip archive; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
    b"%PDF": "a PDF document",
    b"SQLite format 3": "a GeoPackage or SQLite database",
    b"LASF": "a LAS or LAZ point cloud",
    b"ply\n": "a PLY mesh or point cloud",
    b"ply\r": "a PLY mesh or point cloud",
    b"\x00\x00\x27\x0a": "a Shapefile",
    b"\x89HDF": "an HDF5 or NetCDF file",
    b"II*\x00": "a TIFF raster",
    b"MM\x00*": "a TIFF raster",
    b"II+\x00": "a BigTIFF raster",
    b"MM\x00+": "a BigTIFF raster",
    b"\xff\xd8\xff": "a JPEG image",
    b"\x89PNG": "a PNG image",
    b"\x00\x00\x00\x0cjP": "a JPEG 2000 image",
    b"NITF": "a NITF image",
    b"EHFA_HEADER": "an ERDAS Imagine raster",
}
#: Patterns of text, and what holds them; the first that is found counts.
_TEXT = (
    (r'"type"\s*:\s*"(FeatureCollection|Feature|GeometryCollection)"', "GeoJSON"),
    (r'"(?:cmap|crs|ids)"\s*:.*"(?:PROJJSON|projjson)"', "PROJJSON"),
    (r"LINE_OFF\s*[:=]|LINE_NUM_COEFF_1|lineOffset\s*=|<LINE_OFF>|<RFM_Validity", "rational polynomials (RPC)"),
    (r"<LandXML\b", "LandXML"),
    (r"<kml\b", "KML"),
    (r"<gpx\b", "GPX"),
    (r"<VRTDataset\b", "a virtual raster of GDAL"),
    (r"<html\b|<!doctype html", "a web page, perhaps of a download that failed"),
    (r"\A\s*0\s+SECTION\b", "a DXF drawing"),
    (r"\A# Bundle file v", "Bundler's bundle.out; import it into COLMAP or OpenSfM and give that model"),
    (r"\ANVM_V\d", "VisualSFM's NVM; import it into COLMAP and give that model"),
    (r"\A\s*(?:GEOGCS|PROJCS|GEOGCRS|PROJCRS|COMPD_CS)\s*\[", "a CRS as WKT"),
)
_COLMAP = ("cameras.bin", "images.bin", "points3D.bin")


def format_hint(path: Path) -> str:
    """``"; it looks like …"`` for the end of a refusal, or nothing where the file shows no kind that is known.

    Only the first bytes are looked at; a file that cannot be read shows nothing.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_LOOK)
    except OSError:
        return ""
    kind = _kind(path, head)
    return f"; it looks like {kind}" if kind else ""


def _kind(path: Path, head: bytes) -> str | None:
    for magic, name in _MAGIC.items():
        if head.startswith(magic):
            return name
    if path.suffix.lower() == ".bin" and len(head) >= 8 and struct.unpack_from("<Q", head)[0] < 1 << 32:
        known = path.name if path.name in _COLMAP else "a model"
        return f"{known} of COLMAP in binary; give its folder as orientation"
    text = head.decode("utf-8", "replace").lstrip("\ufeff")
    for pattern, name in _TEXT:
        if re.search(pattern, text, re.IGNORECASE):
            return name
    element = re.search(r"<([A-Za-z_][\w.:-]*)", text) if text.lstrip().startswith("<") else None
    if element:
        return f"an XML document of <{element[1]}>"
    return "JSON" if re.match(r'\s*(\{\s*"|\[\s*[\[{"\d])', text) else None


#: Errors that are listed; the rest is counted.
SHOWN = 8


def explain(
    error: ValidationError, data: dict[str, Any], source: str, text: str = "", below: Sequence[int | str] = ()
) -> str:
    """Message for a user: every error with the path of its entry, the line, what was given and what is allowed."""
    lines: list[str] = []
    for item in error.errors(include_url=False):
        location = [*below, *_in_data(item["loc"], data, item["type"])]
        line = line_of(text, location) if text else None
        where = f"{source}:{line}" if line else source
        entry = _entry(location)
        lines.append(f"{where}: {entry + ': ' if entry else ''}{_reason(item)}")
    lines = list(dict.fromkeys(lines))
    more = [f"… and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    return "\n".join(lines[:SHOWN] + more)


def _in_data(loc: Sequence[int | str], data: Any, kind: str) -> list[int | str]:
    """The location without the tags of alternatives that pydantic inserts."""
    found: list[int | str] = []
    here = data
    for k, step in enumerate(loc):
        last = k == len(loc) - 1
        if isinstance(here, dict) and step in here:
            here = here[str(step)]
        elif isinstance(here, list | tuple) and isinstance(step, int) and step < len(here):
            here = here[step]
        elif not (last and kind in ("missing", "extra_forbidden")):
            continue
        found.append(step)
    return found


def _entry(location: Sequence[int | str]) -> str:
    text = ""
    for step in location:
        if isinstance(step, int):
            text += f"[{step + 1}]"
        else:
            text += ("." if text else "") + (
                step if re.fullmatch(r"[A-Za-z0-9_-]+", step) else json.dumps(step, ensure_ascii=False)
            )
    return text


def _reason(item: Any) -> str:
    kind, given = item["type"], repr(item.get("input"))
    given = given if len(given) <= 80 else given[:77] + "…"
    if kind == "missing":
        return "is missing"
    if kind == "extra_forbidden":
        return "unknown entry; look at its spelling"
    if kind == "value_error":
        return str(item["ctx"]["error"])
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        allowed = item.get("ctx", {}).get("expected_tags", "")
        return f"type is not one of {allowed}" if allowed else "type is missing"
    message = item["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{given} given; allowed is {message}" if message != item["msg"] else f"{given} given; {message}"


def line_of(text: str, location: Sequence[int | str]) -> int | None:
    """Line (from 1) of an entry in TOML text as people write it; None where the entry is not found by this search."""
    lines = text.split("\n")
    if not location:
        return None
    if location[0] == "images" and len(location) > 1 and isinstance(location[1], int):
        starts = [n for n, line in enumerate(lines) if re.match(r"\s*\[\[\s*images\s*\]\]", line)]
        if location[1] >= len(starts):
            return None
        start = starts[location[1]]
        return _key_below(lines, start, location[2:]) or start + 1
    for depth in range(len(location), 0, -1):
        header = r"\s*\[\s*" + r"\s*\.\s*".join(_key(s) for s in location[:depth]) + r"\s*\]\s*(#.*)?$"
        for n, line in enumerate(lines):
            if re.match(header, line):
                return _key_below(lines, n, location[depth:]) or n + 1
    return _key_below(lines, -1, location)


def _key(step: int | str) -> str:
    quoted = re.escape(json.dumps(str(step), ensure_ascii=False))
    bare = re.escape(str(step))
    return rf"(?:{bare}|{quoted}|'{bare}')"


def _key_below(lines: list[str], start: int, rest: Sequence[int | str]) -> int | None:
    if not rest:
        return None
    for n in range(start + 1, len(lines)):
        if re.match(r"\s*\[", lines[n]):
            return None
        if re.match(r"\s*" + _key(rest[0]) + r"\s*[=.]", lines[n]):
            return n + 1
    return None


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

_MAGIC_CHECKS: tuple[tuple[bytes, str], ...] = (
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
    for magic, driver in _MAGIC_CHECKS:
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
        f"{path}: not a raster that is read here; allowed are {known}, others after `gdal_translate`{format_hint(path)}"
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


_ABSOLUTE = re.compile(r"(?<![\w./<\\-])(?:/|[A-Za-z]:[/\\])[^\s<>\"'&;:,()\[\]]+[/\\][^\s<>\"'&;:,()\[\]]+")

#: Bytes of a stem at most; file systems allow 255 for a name, and products add a few suffixes.
MAX_BYTES = 120

#: And of a whole name.
MAX_NAME = 240

#: Device names that Windows reserves, with or without a suffix.
_RESERVED = {"con", "prn", "aux", "nul", "clock$"} | {f"{d}{i}" for d in ("com", "lpt") for i in "0123456789¹²³"}

# Two or more characters and a colon: `https:`, `NETCDF:`, `zip+file:`; a single letter is a Windows drive.
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+._-]+:")


def safe_stem(name: str) -> str:
    """File stem for the products of an image called `name`.

    Folders and the suffix of a raster format are dropped; letters and digits of any script, ``-``, ``_`` and inner
    ``.`` stay; everything else becomes ``_``. Reserved device names get a trailing ``_``; stems of more than 120 bytes
    are cut and end with eight digits of a hash of the whole name, so that they stay different.
    """
    text = unicodedata.normalize("NFC", name)
    stem = match_key(name)
    stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in stem).strip(". ").lstrip("-")
    if not any(c.isalnum() for c in stem):
        raise InputError(f"image name {name!r} holds no letter or digit; give the image a name to write products under")
    if stem.split(".")[0].casefold() in _RESERVED:
        head, dot, rest = stem.partition(".")
        stem = f"{head}_{dot}{rest}"
    if len(stem.encode()) > MAX_BYTES:
        mark = hashlib.sha256(text.encode()).hexdigest()[:8]
        stem = stem.encode()[: MAX_BYTES - 9].decode(errors="ignore") + "_" + mark
    return stem


def file_in(folder: Path, name: str) -> Path:
    """Path of a file that is called `name`, wherever the name comes from; it cannot lead out of the folder."""
    name = name if isinstance(name, str) else ""  # what comes from JSON may be anything
    stem, dot, _ = name.partition(".")
    if (
        len(name.encode(errors="replace")) > MAX_NAME
        or not name
        or name.strip(". ") != name
        or not all(c.isalnum() or c in "-_. " for c in name)
        or f"{stem}{dot}".rstrip(".").casefold() in _RESERVED
    ):
        raise InputError(
            f"{name[:200]!r} cannot be the name of a file; letters, digits, '-', '_' and inner '.' are accepted, up to "
            f"{MAX_NAME} bytes"
        )
    return folder / name


def unique_stems(names: Iterable[str]) -> dict[str, str]:
    """File stem of every name; no two names have the same one.

    Names with one base name get their folders in front, as many as tell them apart, then a number. Capitals are ignored
    in the comparison, since common file systems ignore them.
    """
    stems = {name: safe_stem(name) for name in names}
    taken: set[str] = set()
    for name, short in shortest_paths(stems).items():
        stem = safe_stem("_".join(short)) if len(short) > 1 else stems[name]
        plain, number = stem, 2
        while stem.casefold() in taken:
            stem, number = f"{plain}_{number}", number + 1
        taken.add(stem.casefold())
        stems[name] = stem
    return stems


def shortest_paths(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The last folders and the base name of every name: as few folders as tell it from the others.

    Names that no folder tells apart keep what is the same.
    """
    parts = {name: name_parts(name) for name in names}
    short = dict.fromkeys(parts, 1)
    while True:
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, count in short.items():
            groups.setdefault(tuple(p.casefold() for p in parts[name][-count:]), []).append(name)
        longer = [
            n
            for group in groups.values()
            if len({tuple(p.casefold() for p in parts[name]) for name in group}) > 1
            for n in group
            if short[n] < len(parts[n])
        ]
        if not longer:
            return {name: parts[name][-count:] for name, count in short.items()}
        for name in longer:
            short[name] += 1


def name_parts(name: str) -> tuple[str, ...]:
    """Folders and base name of an image; no drive, no ``.`` and ``..``, no raster suffix."""
    folders = re.split(r"[/\\]", unicodedata.normalize("NFC", name.strip()))[:-1]
    return (*(f for f in folders if f not in ("", ".", "..") and not re.fullmatch(r"[A-Za-z]:", f)), match_key(name))


class ImageNames:
    """Images found by any spelling of their names: the one notion of which two names are one image.

    Names are compared without folder and raster suffix. If several images have one base name, the folders decide, from
    the last one upwards, then capitals, then the suffix.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = set(names := list(names))
        self._by_key: dict[str, list[str]] = {}
        for name in dict.fromkeys(names):
            self._by_key.setdefault(match_key(name).casefold(), []).append(name)

    def find(self, name: str) -> str | None:
        """The image that is meant; None if no image has the base name."""
        if name in self._names:
            return name
        known = self._by_key.get(match_key(name).casefold(), [])
        scores = [_likeness(name, other) for other in known]
        fitting = [other for other, score in zip(known, scores) if score == max(scores)]
        if len(fitting) > 1:
            raise InputError(
                f"image {name!r} may be {' or '.join(map(repr, fitting[:4]))}; write its name with the folder"
            )
        return fitting[0] if fitting else None

    def match(self, given: Sequence[str]) -> list[str | None]:
        """The image of each of several names, no two of which are one image; None if no image has the base name."""
        found = [self.find(name) for name in given]
        best: dict[str, int] = {}
        for k, known in enumerate(found):
            if known is None:
                continue
            first = best.setdefault(known, k)
            if first == k:
                continue
            scores = _likeness(given[first], known), _likeness(given[k], known)
            if scores[0] == scores[1]:
                raise InputError(
                    f"{given[first]!r} and {given[k]!r} are both image {known!r} by the base name; rename one, or "
                    "write the folder in all names"
                )
            lost, best[known] = (first, k) if scores[1] > scores[0] else (k, first)
            found[lost] = None
        return found


def _likeness(name: str, other: str) -> tuple[int, bool, bool, bool]:
    """How well two names of one base name fit: equal folders, no folder that differs, capitals, suffix."""
    one, two = name_parts(name)[:-1], name_parts(other)[:-1]
    pairs = list(zip(reversed([p.casefold() for p in one]), reversed([p.casefold() for p in two])))
    equal = next((k for k, (a, b) in enumerate(pairs) if a != b), len(pairs))
    ends = [re.split(r"[/\\]", n)[-1] for n in (name, other)]
    alike = match_key(name) == match_key(other)
    return equal, equal == len(pairs), alike, ends[0].casefold() == ends[1].casefold()


def same_images(names: Iterable[str]) -> dict[str, str]:
    """Each name of a file with the spelling that the file first gives the image.

    An image may be written with or without folders and suffix; names whose folders differ are different images.
    """
    groups: dict[str, dict[str, tuple[str, ...]]] = {}
    for name in dict.fromkeys(names):
        groups.setdefault(match_key(name), {})[name] = name_parts(name)
    found: dict[str, str] = {}
    for group in groups.values():
        parts = set(group.values())
        # The full spellings: no other one goes on to the left of them.
        full = [p for p in parts if not any(q != p and q[-len(p) :] == p for q in parts)]
        first: dict[tuple[str, ...], str] = {}
        for name, own in group.items():
            fitting = [p for p in full if p[-len(own) :] == own]
            if len(fitting) > 1:
                raise InputError(
                    f"image {name!r} may be {' or '.join(repr('/'.join(p)) for p in sorted(fitting)[:4])}; write its "
                    "name with the folder"
                )
            found[name] = first.setdefault(fitting[0], name)
    return found


def match_key(name: str) -> str:
    """What two names of one image have in common: no folder, no raster suffix, Unicode composed."""
    last = re.split(r"[/\\]", unicodedata.normalize("NFC", name.strip()))[-1]
    return re.sub(r"\.(tiff?|jpe?g|png|jp2|j2k|img|vrt|ecw|sid|ntf|nitf|bmp|pix|dng|raw)$", "", last, flags=re.I)


def check_input_name(text: str) -> str:
    """Refuse an input that is not a plain path: GDAL's virtual systems, URLs, driver prefixes, inline documents."""
    plain = text.strip().replace("\\", "/")
    reason = None
    if not plain:
        reason = "it is empty"
    elif any(ord(c) < 32 for c in text):
        reason = "it holds control characters"
    elif re.match(r"/+vsi", plain, flags=re.I):
        reason = "GDAL's virtual file systems are not read"
    elif _SCHEME.match(plain):
        reason = "addresses and driver prefixes are not read"
    elif plain.startswith(("<", "{")):
        reason = "inline documents are not read"
    if reason:
        raise InputError(f"input {text[:200]!r}: {reason}; give the path of a file on this computer")
    return text


def resolve_input(folder: Path, text: str) -> Path:
    """Absolute path of an input, relative ones from `folder`; virtual paths are refused after resolving too."""
    path = Path(check_input_name(text)).expanduser()
    full = Path((folder / path).absolute())
    try:
        full = Path(*full.parts).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # links that lead to themselves, names no file can have
        raise InputError(f"input {text[:200]!r}: leads to no file ({error}); give the path of a file") from error
    check_input_name(str(full))
    return full


def relative_path(file: Path, folder: Path) -> str:
    """Path of a file as the project file states it: from the project's folder, where there is a way."""
    # The folder of the file is resolved, not the file: a link keeps its own name, and so do the products.
    target = file.parent.resolve() / file.name
    try:
        return Path(os.path.relpath(target, folder.absolute().resolve())).as_posix()
    except ValueError:  # another drive
        return target.as_posix()


def stated_path(file: Path | str, folder: Path) -> str:
    """Path of a file as records and reports in a folder state it: from there; its name on another drive."""
    try:
        return Path(os.path.relpath(Path(file).absolute(), folder.absolute())).as_posix()
    except ValueError:
        return Path(file).name


def stated_text(text: str, folder: Path) -> str:
    """Text for files in a folder, in which absolute paths are written from there: it shows nothing of a disk."""
    for here in dict.fromkeys((folder.absolute(), folder.resolve())):
        for up, place in enumerate([here, *here.parents][:-1]):
            pattern = rf"(?<![\w./\\-]){re.escape(str(place))}(?:[/\\]|(?=[\s\"'<>,;:)]|$))"
            text = re.sub(pattern, "../" * up, text) if up else re.sub(pattern, _inside, text)
    for found in sorted(set(_ABSOLUTE.findall(text)), key=len, reverse=True):
        if os.path.lexists(found):
            text = text.replace(found, stated_path(found, folder))
    return text


def _inside(found: re.Match[str]) -> str:
    return "" if found[0][-1] in "/\\" else "."


M = TypeVar("M", bound=BaseModel)


def read_text(path: Path, max_bytes: int) -> str:
    """Text of a UTF-8 file (a byte order mark is dropped, line ends become newlines)."""
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise InputError(f"{path}: {size} bytes; at most {max_bytes} are read from a file of this kind")
        with path.open("rb") as file:  # devices and pipes have no size: never more is read than is allowed
            raw = file.read(max_bytes + 1)
        if len(raw) > max_bytes:
            raise InputError(
                f"{path}: more than {max_bytes} bytes; at most that many are read from a file of this kind"
            )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    return decoded_text(path, raw)


def decoded_text(path: Path, raw: bytes, first_line: int = 1) -> str:
    """UTF-8 text with plain line ends; `raw` begins with the file's line `first_line`."""
    try:
        text = raw.decode("utf-8-sig" if first_line == 1 else "utf-8")
        at, wrong = text.find("\0"), "holds a zero byte; this is not a text file"
        before = text[: max(at, 0)].count("\n")
    except UnicodeDecodeError as error:
        at, wrong = error.start, f"not UTF-8 (byte {raw[error.start]:#04x}); save the file as UTF-8"
        before = raw[:at].count(b"\n")
    if at >= 0:
        raise InputError(f"{path}:{first_line + before}: {wrong}{format_hint(path)}")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_head(path: Path) -> str:
    """The beginning of a text file, to tell formats apart; bytes that are not UTF-8 are replaced."""
    try:
        with path.open("rb") as file:
            raw = file.read(65_536)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    return raw.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path, max_bytes: int = 1_000_000_000) -> Any:
    """Plain contents of a JSON file; NaN and infinity are refused, since JSON has no such numbers."""
    return parse_json(read_text(path, max_bytes), str(path))


def read_json_lines(path: Path, max_bytes: int = 1_000_000_000) -> list[Any]:
    """Plain contents of a file that has a JSON document in each line, with the marks of a JSON sequence (RFC 8142) or
    without, or a single one in all lines.
    """
    text = read_text(path, max_bytes)
    lines = [line.lstrip("\x1e") for line in text.split("\n")]
    first = next((line for line in lines if line.strip()), "")
    # The first line of a document in many lines is no document.
    if not (first.rstrip().endswith("}") and first.lstrip().startswith("{")):
        return [parse_json(text, str(path))]
    return [parse_json(line, str(path), number) for number, line in enumerate(lines, 1) if line.strip()]


def parse_json(text: str, where: str, first_line: int = 1) -> Any:
    """Plain contents of a JSON text, the one place where foreign JSON is taken apart.

    Whole numbers beyond 64 bits become floats; NaN, infinity and numbers too large for a float are refused.
    """

    def refuse(word: str) -> NoReturn:
        raise InputError(f"{where}: holds {word[:40]}, which is no number in JSON; repair the file")

    def number(word: str) -> float:
        value = float(word)
        return value if math.isfinite(value) else refuse(word)

    def whole(word: str) -> int | float:
        return int(word) if len(word) < 19 else number(word)

    try:
        return json.loads(text, parse_constant=refuse, parse_int=whole, parse_float=number)
    except json.JSONDecodeError as error:
        raise InputError(f"{where}:{error.lineno + first_line - 1}: not valid JSON ({error.msg})") from None
    except RecursionError:
        raise InputError(f"{where}: nested far too deep for a file of this kind") from None


def json_object(text: Any, where: str) -> dict[str, Any]:
    """Members of a JSON text that must be an object."""
    if not isinstance(text, str):
        raise InputError(f"{where}: {type(text).__name__} instead of a text in JSON")
    return members(parse_json(text, where), where)


def members(value: Any, where: str) -> dict[str, Any]:
    """The value, if it is an object of JSON; None stands for an empty one."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f"{where}: {str(value)[:60]!r} given; named values in {{ }} are needed")
    return value


def elements(value: Any, where: str) -> list[Any]:
    """The value, if it is a list of JSON; None stands for an empty one."""
    if value is None:
        return []
    if not isinstance(value, list):
        raise InputError(f"{where}: {str(value)[:60]!r} given; a list is needed")
    return value


def number_rows(value: Any, where: str, width: int) -> Floats:
    """A list of lists of `width` finite numbers, shape (n, width); None stands for an empty one."""
    rows = elements(value, where)
    try:
        out = np.array(rows, float).reshape(-1, width) if rows else np.empty((0, width))
    except (TypeError, ValueError, OverflowError, RecursionError):
        out = np.full((1, width), np.nan)
    if not np.isfinite(out).all() or len(out) != len(rows):
        raise InputError(f"{where}: a list of {width} finite numbers each is needed")
    return out


def build(model: type[M], values: dict[str, Any], source: str) -> M:
    """A model of plain values; errors become messages that begin with `source`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(explain(error, values, source)) from None


def finite(value: Any, where: str, count: int | None = None) -> Any:
    """A finite number, or `count` of them as a tuple of floats."""
    if count is not None:
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
            raise InputError(f"{where}: {value!r} given; {count} numbers are needed")
        return tuple(finite(v, where) for v in value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise InputError(f"{where}: {repr(value)[:80]} given; a finite number is needed")
    return float(value)


def whole_number(word: str) -> int | None:
    """Whole number of up to 18 ASCII digits; None if a word is anything else, such as a superscript."""
    return int(word) if word.isascii() and word.isdecimal() and len(word) <= 18 else None


_MAX_BYTES = 100_000


@dataclass(frozen=True)
class StatedCrs:
    """What such a file states."""

    file: Path
    crs: str
    """Horizontal CRS."""
    height_system: str | None
    """None: it states a horizontal CRS alone."""
    system: MetricSystem
    """The same in metres, with what leads coordinates there."""


def crs_beside(path: Path) -> StatedCrs | None:
    """CRS (EPSG code, WKT or PROJ string) in the file of the same name with the suffix ``.prj``; None: there
    is none.
    """
    side = next((p for p in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if p.is_file()), None)
    if side is None:
        return None
    text = read_text(side, _MAX_BYTES).strip()
    crs, heights = split_compound(text, str(side))
    return None if crs is None else StatedCrs(side, crs, heights, metric_system(text, str(side)))


#: A project of 100,000 images stays far below; anything larger is not a project file.
MAX_BYTES_PLAIN_FILES = 200_000_000


def read_toml(path: Path, max_bytes: int = MAX_BYTES_PLAIN_FILES) -> tuple[dict[str, Any], str]:
    """Contents of a TOML file and its text."""
    text = read_text(path, max_bytes)
    try:
        return tomllib.loads(text), text
    except (ValueError, RecursionError) as error:  # whole numbers of thousands of digits are no TOMLDecodeError
        raise InputError(f"{path}: not valid TOML: {error}") from None


def read_entries(path: Path, model: type[M], max_bytes: int = MAX_BYTES_PLAIN_FILES) -> M:
    """Contents of a TOML file as a checked value."""
    contents, text = read_toml(path, max_bytes)
    try:
        return model.model_validate(contents)
    except ValidationError as error:
        raise InputError(explain(error, contents, str(path), text)) from None


#: Levels of nesting that any of our formats could need.
MAX_DEPTH = 32


def read_yaml(path: Path) -> Any:
    """Plain contents of a YAML file.

    Aliases (which let a small file unfold without bound), deep nesting and repeated keys are refused before anything
    is built.
    """
    return parse_yaml(read_text(path, 200_000), path)


def parse_yaml(text: str, path: Path) -> Any:
    """Plain contents of YAML text that was read from `path`; raises InputError as `read_yaml`."""
    try:
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            line = event.start_mark.line + 1 if event.start_mark else 0
            if isinstance(event, yaml.AliasEvent):
                raise InputError(f"{path}:{line}: YAML aliases are not read; write the values out")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise InputError(f"{path}:{line}: nested deeper than {MAX_DEPTH} levels")
        _refuse_repeated_keys(yaml.compose(text, yaml.SafeLoader), path)
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        raise InputError(f"{where}: not valid YAML ({getattr(error, 'problem', None) or error})") from None


def _refuse_repeated_keys(node: Any, path: Path) -> None:
    if isinstance(node, yaml.SequenceNode):
        for child in node.value:
            _refuse_repeated_keys(child, path)
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, child in node.value:
            if str(key.value) in seen:
                raise InputError(f"{path}:{key.start_mark.line + 1}: {key.value!r} is given twice")
            seen.add(str(key.value))
            _refuse_repeated_keys(child, path)


class NotWellFormed(InputError):
    """Text that is not XML, as against XML that is not read for its content."""


def read_xml(path: Path, max_bytes: int) -> Element:
    """Root of an XML file."""
    return parse_xml(read_text(path, max_bytes), str(path))


def parse_xml(text: str, where: str) -> Element:
    """Root of XML text; `where` begins messages. Raises InputError as `read_xml`."""
    try:
        # A declaration of another encoding was right for the bytes; the text has none any more.
        root: Element = fromstring(text.lstrip().encode(), forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError(
            f"{where}: holds a document type or entities ({type(error).__name__}), which are not followed; "
            "write the file again without them"
        ) from None
    except ParseError as error:
        raise NotWellFormed(f"{where}:{error.position[0]}: not valid XML ({error}); get a fresh copy") from None
    except (ValueError, LookupError) as error:
        raise NotWellFormed(f"{where}: cannot be read ({error})") from None
    _refuse_deep(root, where)
    return root


def _refuse_deep(root: Element, where: str) -> None:
    level = [root]
    for _ in range(MAX_DEPTH):
        level = [child for element in level for child in element]
        if not level:
            return
    raise InputError(f"{where}: nested deeper than {MAX_DEPTH} levels; this is no file of this kind")


def element_numbers(element: Element | None, where: str, count: int) -> tuple[float, ...]:
    """The `count` numbers that an element holds as text."""
    words = (element.text or "").split() if element is not None else []
    try:
        values = [float(w) for w in words]
    except ValueError:
        values = []
    if len(values) != count:
        given = " ".join(words)[:80]
        raise InputError(f"{where}: {len(words)} values given ({given!r}); {count} numbers are needed")
    checked: tuple[float, ...] = finite(values, where, count)
    return checked


_BLOCK = 64 << 10
_BLOCKS = 64


@dataclass(frozen=True)
class Fingerprint:
    """What identifies a file's content.

    The digest is sampled: SHA-256 over the size and up to 64 blocks of 64 KiB, spread evenly from the first byte to
    the last (files up to 4 MiB are covered whole). An edit that keeps size and time and falls between the blocks is not
    seen; it is no protection against malice.
    """

    size: int
    """Bytes of the file."""
    digest: str
    """SHA-256 as 64 hexadecimal digits."""


def fingerprint(path: str | os.PathLike[str]) -> Fingerprint:
    """Fingerprint of a file; reads at most 4 MiB, whatever its size."""
    path = Path(path)
    digest = hashlib.sha256()
    try:
        if stat.S_ISFIFO(path.stat().st_mode):
            raise InputError(f"{path}: is a pipe, which can be read once only; give a file")
        with path.open("rb", buffering=0) as file:
            state = os.fstat(file.fileno())
            digest.update(str(state.st_size).encode())
            last = max(0, state.st_size - _BLOCK)
            count = max(1, min(_BLOCKS, -(-state.st_size // _BLOCK)))
            for i in range(count):
                file.seek(last * i // max(1, count - 1))
                digest.update(file.read(_BLOCK))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check that it is there and readable") from error
    return Fingerprint(state.st_size, digest.hexdigest())

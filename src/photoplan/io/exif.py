"""EXIF entries and the XMP packet of a JPEG or TIFF file, read from its header; the pixels are not touched.

EXIF is a TIFF structure (CIPA DC-008, TIFF 6.0): a chain of directories of entries (tag, type, count, value or
offset). Own reading keeps rational numbers exact, which GPS positions of centimetres need.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from photoplan.errors import InputError

ExifValue = str | tuple[float, ...]

#: Entries of a directory, bytes of a value and segments of a JPEG header at most; real ones are far smaller.
MAX_ENTRIES = 1000
MAX_VALUE = 1 << 20
MAX_SEGMENTS = 500
EXIF_DIRECTORY, GPS_DIRECTORY, XMP_TAG = 34665, 34853, 700
#: struct letter and length of one value, by TIFF type; rationals are two numbers.
_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 6: "b", 7: "s", 8: "h", 9: "i", 11: "f", 12: "d"}
_RATIONAL = {5: "I", 10: "i"}
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\0"

#: Names of the entries that photoplan uses, by directory.
_NAMES = {
    0: {271: "Make", 272: "Model", 274: "Orientation", 256: "ImageWidth", 257: "ImageLength", 306: "DateTime"},
    EXIF_DIRECTORY: {
        36867: "DateTimeOriginal",
        37521: "SubSecTimeOriginal",
        37386: "FocalLength",
        41989: "FocalLengthIn35mmFilm",
        40962: "PixelXDimension",
        40963: "PixelYDimension",
        41486: "FocalPlaneXResolution",
        41487: "FocalPlaneYResolution",
        41488: "FocalPlaneResolutionUnit",
    },
    GPS_DIRECTORY: {
        1: "GPSLatitudeRef",
        2: "GPSLatitude",
        3: "GPSLongitudeRef",
        4: "GPSLongitude",
        5: "GPSAltitudeRef",
        6: "GPSAltitude",
        16: "GPSImgDirectionRef",
        17: "GPSImgDirection",
        18: "GPSMapDatum",
        31: "GPSHPositioningError",
    },
}


def read_exif(path: Path) -> tuple[dict[str, ExifValue], str | None]:
    """EXIF entries by their standard names, and the XMP packet as text (None: there is none).

    Raises
    ------
    InputError
        The file is neither JPEG nor TIFF, or its header is damaged.
    """
    try:
        with path.open("rb") as file:
            start = file.read(4)
            if start[:2] == b"\xff\xd8":
                return _of_jpeg(file, path)
            if start in (b"II*\0", b"MM\0*"):
                return _of_tiff(_window(file), path)
            if start in (b"II+\0", b"MM\0+"):
                return {}, None  # BigTIFF: no camera writes it
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(f"{path}: its EXIF header is damaged ({error}); get a fresh copy") from None
    raise InputError(f"{path}: neither JPEG nor TIFF; positions are read from EXIF of these")


def _of_jpeg(file: BinaryIO, path: Path) -> tuple[dict[str, ExifValue], str | None]:
    file.seek(2)
    entries: dict[str, ExifValue] = {}
    xmp: str | None = None
    for _ in range(MAX_SEGMENTS):
        head = file.read(4)
        # The picture starts (SOS), or ends (EOI): no more segments with metadata.
        if len(head) < 4 or head[0] != 0xFF or head[1] in (0xDA, 0xD9):
            break
        (length,) = struct.unpack(">H", head[2:])
        if length < 2:
            break
        segment = file.read(length - 2)
        if head[1] == 0xE1 and segment.startswith(b"Exif\0\0") and not entries:
            entries, _ = _of_tiff(_buffer(segment[6:]), path)
        elif head[1] == 0xE1 and segment.startswith(_XMP_HEAD):
            xmp = segment[len(_XMP_HEAD) :].decode("utf-8", "replace")
    return entries, xmp


_Reader = Callable[[int, int], bytes]


def _buffer(data: bytes) -> _Reader:
    def read(offset: int, count: int) -> bytes:
        if offset + count > len(data):
            raise ValueError("an entry points beyond its end")
        return data[offset : offset + count]

    return read


def _window(file: BinaryIO) -> _Reader:
    def read(offset: int, count: int) -> bytes:
        file.seek(offset)
        data = file.read(count)
        if len(data) < count:
            raise ValueError("an entry points beyond its end")
        return data

    return read


def _of_tiff(read: _Reader, path: Path) -> tuple[dict[str, ExifValue], str | None]:
    mark = read(0, 4)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(mark)
    if order is None:
        raise ValueError("it begins with no byte order")
    (first,) = struct.unpack(order + "I", read(4, 4))
    entries: dict[str, ExifValue] = {}
    xmp: str | None = None
    pending = [(0, first)]
    for directory, offset in pending:
        for tag, value in _directory(read, order, offset):
            if directory == 0 and tag in (EXIF_DIRECTORY, GPS_DIRECTORY) and not isinstance(value, str):
                pending.append((tag, int(value[0])))
            elif directory == 0 and tag == XMP_TAG:
                xmp = value if isinstance(value, str) else bytes(int(v) for v in value).decode("utf-8", "replace")
            elif tag in _NAMES[directory]:
                entries[_NAMES[directory][tag]] = value
    return entries, xmp


def _directory(read: _Reader, order: str, offset: int) -> list[tuple[int, ExifValue]]:
    (count,) = struct.unpack(order + "H", read(offset, 2))
    if count > MAX_ENTRIES:
        raise ValueError(f"a directory of {count} entries")
    found = []
    for k in range(count):
        entry = read(offset + 2 + 12 * k, 12)
        tag, kind, number = struct.unpack(order + "HHI", entry[:8])
        letter = _RATIONAL.get(kind) or _TYPES.get(kind)
        if letter is None or not number:
            continue
        each = struct.calcsize(order + letter) * (2 if kind in _RATIONAL else 1)
        size = each * number
        if size > MAX_VALUE:
            continue  # a preview, a maker note
        if size <= 4:
            raw = entry[8 : 8 + size]
        else:
            raw = read(struct.unpack(order + "I", entry[8:])[0], size)
        found.append((tag, _value(raw, order, kind, letter, number)))
    return found


def _value(raw: bytes, order: str, kind: int, letter: str, number: int) -> ExifValue:
    if letter == "s":
        return raw.split(b"\0")[0].decode("utf-8", "replace").strip() if kind == 2 else raw.decode("utf-8", "replace")
    if kind in _RATIONAL:
        parts = struct.unpack(f"{order}{2 * number}{letter}", raw)
        # A denominator of zero is how cameras say that they do not know.
        return tuple(a / b if b else float("nan") for a, b in zip(parts[::2], parts[1::2]))
    return tuple(float(v) for v in struct.unpack(f"{order}{number}{letter}", raw))

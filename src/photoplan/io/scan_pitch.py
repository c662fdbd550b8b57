"""How finely a scan was sampled, as its file states it or a person writes it."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import Any

from photoplan.errors import UsageError
from photoplan.io.gdal import open_raster
from photoplan.io.raster_info import read_info

_INCH = 25.4
#: Millimetres that a resolution tag counts pixels in: 2 is the inch, 3 the centimetre (TIFF 6.0, EXIF 2.3).
_UNITS = {"2": _INCH, "3": 10.0}
_NAMES = (
    ("TIFFTAG_XRESOLUTION", "TIFFTAG_YRESOLUTION", "TIFFTAG_RESOLUTIONUNIT"),
    ("EXIF_XResolution", "EXIF_YResolution", "EXIF_ResolutionUnit"),
)


def read_pitch(path: Path) -> tuple[float, float] | None:
    """Distance of two columns and of two rows in millimetres, from the resolution tags of a TIFF, JPEG or EXIF header.

    None where the file states none, or states it without a unit.
    """
    info = read_info(path)
    with open_raster(info.path, info.driver) as file:
        tags: dict[str, Any] = file.tags()
    for x, y, unit in _NAMES:
        length = _UNITS.get(str(tags.get(unit, "2")).strip()[:1])
        per = [_number(tags.get(name)) for name in (x, y)]
        if length and per[0] and per[1]:
            return length / per[0], length / per[1]
    return _jfif(info.path) if info.driver == "JPEG" else None


def _jfif(path: Path) -> tuple[float, float] | None:
    """Density in a JFIF header (ITU-T T.871, 10.1): unit 1 is the inch, 2 the centimetre, 0 states a ratio only."""
    with path.open("rb") as file:
        head = file.read(18)
    if len(head) < 18 or head[:4] != b"\xff\xd8\xff\xe0" or head[6:11] != b"JFIF\0":
        return None
    length = {1: _INCH, 2: 10.0}.get(head[13])
    across, down = struct.unpack(">HH", head[14:18])
    return (length / across, length / down) if length and across and down else None


def parse_pitch(text: str) -> tuple[float, float]:
    """Distance of two columns and of two rows in millimetres, from ``1200dpi``, ``21um`` or ``21,20.8um``."""
    match = re.fullmatch(r"\s*([\d.]+)(?:\s*,\s*([\d.]+))?\s*(dpi|um|µm|μm)\s*", text, re.IGNORECASE)
    numbers = [_number(match[k] or match[1]) for k in (1, 2)] if match else [None]
    if match is None or None in numbers:
        raise UsageError(f"scan resolution {text!r}; write for example 1200dpi or 21um, or 21,20.8um for columns, rows")
    first, second = (_INCH / v if match[3].lower() == "dpi" else v / 1000 for v in numbers if v)
    return first, second


def _number(text: Any) -> float | None:
    """A positive number; EXIF values stand in brackets."""
    try:
        value = float(str(text).strip().strip("()"))
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None

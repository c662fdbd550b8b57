"""Control measured for OpenDroneMap: ``gcp_list.txt``.

The first line is the CRS: ``EPSG:32632``, a PROJ string, or ``WGS84 UTM 32N``. Every other line is one measurement:
``X Y Z column row image [name]``, separated by white space; further words are not used. Z may be ``NaN``: the point has
no known height. Lines without a name belong to one point where their coordinates are equal, and get a name from their
order.

Pixels: OpenSfM, which computes with these files, takes (column + 0.5, row + 0.5) as the distance from the image's
upper-left corner, so that (0, 0) is the centre of the upper-left pixel as it is here; nothing is added.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.errors import InputError, named_by
from photoplan.geometry.crs import crs_label, crs_step, parse_crs, same_crs
from photoplan.geometry.heights import heights_in
from photoplan.geometry.units import metric_system
from photoplan.io.names import same_images
from photoplan.io.plain_files import read_text
from photoplan.io.table_lines import NUMBER, number

MAX_BYTES = 100_000_000
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.I)


@dataclass(frozen=True, eq=False)
class GcpList:
    """What such a file holds."""

    crs: str
    """Horizontal CRS of the ground points."""
    ground: GroundPoints
    """All as control; standard deviations are not stated."""
    points: ImagePoints
    """Their measurements."""


@dataclass(frozen=True)
class _Line:
    number: int
    XYZ: tuple[float, float, float]
    xy: tuple[float, float]
    image: str
    name: str | None


def read_gcp_list(path: Path, crs: str | None = None, height_system: str | None = None) -> GcpList:
    """Control and its measurements."""
    path = Path(path)
    lines = [(n, text.strip()) for n, text in enumerate(read_text(path, MAX_BYTES).split("\n"), 1) if text.strip()]
    if not lines:
        raise InputError(f"{path}: holds no line with data")
    system = metric_system(_crs(f"{path}:{lines[0][0]}", lines[0][1]))
    own = system.crs
    rows = [_line(path, line, text) for line, text in lines[1:] if not text.startswith("#")]
    if not rows:
        raise InputError(f"{path}: holds a CRS and no measurement")
    names = _names(rows)
    places: dict[str, _Line] = {}
    measured: dict[tuple[str, str], int] = {}
    try:
        spelled = same_images(row.image for row in rows)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    for row, name in zip(rows, names):
        first = places.setdefault(name, row)
        if not np.array_equal(first.XYZ, row.XYZ, equal_nan=True):
            raise InputError(f"{path}:{row.number}: point {name!r} has other coordinates than in line {first.number}")
        at = measured.setdefault((name, spelled[row.image]), row.number)
        if at != row.number:
            raise InputError(
                f"{path}:{row.number}: point {name!r} is measured in image {row.image!r} in line {at} already; keep "
                "one of the measurements"
            )
    XYZ = system.to_metres(np.array([row.XYZ for row in places.values()], float), f"{path}: heights")
    XYZ = heights_in(XYZ, own, system.heights, height_system, str(path))
    if crs is not None and not same_crs(own, crs):
        with named_by(path):
            XYZ[:, :2] = crs_step(own, crs)(XYZ[:, :2])
        own = crs
    elif parse_crs(own).is_geographic:
        raise InputError(
            f"{path}: points are geographic ({crs_label(own)}); say which projected CRS they are wanted in"
        )
    ground = GroundPoints(tuple(places), XYZ, np.full((len(places), 3), np.nan), np.zeros(len(places), bool))
    table = [(name, spelled[row.image], *row.xy) for row, name in zip(rows, names)]
    return GcpList(own, ground, ImagePoints.from_rows(table))


def _crs(where: str, text: str) -> str:
    utm = _UTM.fullmatch(text)
    if utm:
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise InputError(f"{where}: UTM zone {zone}; zones are 1 to 60")
        return f"EPSG:{32600 + zone + 100 * (utm[2].upper() == 'S')}"
    if len(text.split()) >= 6 and sum(bool(NUMBER.fullmatch(word)) for word in text.split()[:5]) == 5:
        raise InputError(f"{where}: the first line is a measurement; it must state the CRS, such as EPSG:32632")
    parse_crs(text, where)
    return text


def _line(path: Path, line: int, text: str) -> _Line:
    words = text.split()
    if len(words) < 6:
        raise InputError(f"{path}:{line}: {len(words)} words; X Y Z column row image are needed")
    values = []
    for what, word in zip(("X", "Y", "Z", "column", "row"), words):
        if what == "Z" and word.casefold() == "nan":
            values.append(np.nan)
            continue
        values.append(number(word, f"{path}:{line}: {what}"))
    X, Y, Z, col, row = values
    return _Line(number=line, XYZ=(X, Y, Z), xy=(col, row), image=words[5], name=words[6] if len(words) > 6 else None)


def _names(rows: list[_Line]) -> list[str]:
    """Names of the points; those without one are called after the order of their places."""
    places: dict[tuple[str, ...], str] = {}
    taken = {row.name for row in rows}
    out = []
    for row in rows:
        if row.name is not None:
            out.append(row.name)
            continue
        key = tuple(repr(v) for v in row.XYZ)
        if key not in places:
            count = len(places) + 1
            while f"gcp_{count}" in taken:
                count += 1
            places[key] = f"gcp_{count}"
            taken.add(places[key])
        out.append(places[key])
    return out


def is_gcp_list(path: Path) -> bool:
    """Whether a text file begins with a CRS, as these files do and tables do not."""
    if path.suffix.lower() != ".txt":
        return False
    try:
        with path.open("rb") as file:
            first = file.read(1000).decode("utf-8-sig", errors="replace").lstrip().split("\n")[0].strip()
    except OSError:
        return False
    return bool(_UTM.fullmatch(first) or re.match(r"EPSG:\d+(\+\d+)?$|\+proj=", first, re.I))

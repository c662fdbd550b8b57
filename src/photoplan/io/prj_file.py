"""The file ``NAME.prj`` beside a table, which states the CRS of its coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.io.plain_files import read_text

_MAX_BYTES = 100_000


@dataclass(frozen=True)
class StatedCrs:
    """What such a file states."""

    file: Path
    crs: str
    """Horizontal CRS."""
    height_system: str | None
    """None: it states a horizontal CRS alone."""


def crs_beside(path: Path) -> StatedCrs | None:
    """CRS (EPSG code, WKT or PROJ string) in the file of the same name with the suffix ``.prj``; None: there is none.

    Raises
    ------
    InputError
        The file cannot be read, or states no CRS that is known.
    """
    side = next((p for p in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if p.is_file()), None)
    if side is None:
        return None
    text = read_text(side, _MAX_BYTES).strip()
    parse_crs(text, str(side))
    return StatedCrs(side, *split_compound(text))

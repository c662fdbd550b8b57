"""Exterior orientations from files of any known format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from photoplan.io import orientation_csv, orientation_opensfm, orientation_toml
from photoplan.io.orientation_table import OrientationTable, TableFormat

__all__ = ["ORIENTATION_FORMATS", "read_orientation"]

#: Reader of every format, by file suffix; any other suffix is read as a table of text.
ORIENTATION_FORMATS: dict[str, Callable[[Path, TableFormat], OrientationTable]] = {
    ".toml": orientation_toml.read,
    ".json": orientation_opensfm.read,
}


def read_orientation(path: str | Path, form: TableFormat | None = None) -> OrientationTable:
    """Orientation table of a file: own TOML, ``reconstruction.json`` of OpenSfM, or a table of text.

    Parameters
    ----------
    path : str or Path
    form : TableFormat, optional
        What a table of text does not say of itself: columns, angle unit, rotation.

    Raises
    ------
    InputError
        The file cannot be used.
    """
    path = Path(path)
    return ORIENTATION_FORMATS.get(path.suffix.lower(), orientation_csv.read)(path, form or TableFormat())

"""The registry of file formats for orientations: reading and writing files of any of them."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

from photoplan.errors import InputError, UsageError
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.files import read_head
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, OrientationTable
from photoplan.io.orientation.form import TableFormat
from photoplan.io.product import check_output
from photoplan.io.store import together, write_atomically

#: Module and value of every format, by name; the value is `FORMAT` unless it is named.
FORMATS: dict[str, str] = {
    "csv": "photoplan.io.orientation.text:CSV",
    "toml": "photoplan.io.orientation.toml",
    "opensfm": "photoplan.io.orientation.opensfm",
    "patb": "photoplan.io.orientation.text:PATB",
    "bingo": "photoplan.io.orientation.text:BINGO",
    "bluh": "photoplan.io.orientation.text:BLUH",
    "inpho": "photoplan.io.orientation.inpho",
    "metashape": "photoplan.io.orientation.metashape",
    "pix4d": "photoplan.io.orientation.pix4d",
    "opk": "photoplan.io.orientation.text:OPK",
    "exif": "photoplan.io.orientation.exif",
    "odm": "photoplan.io.orientation.opensfm:ODM",
    "colmap": "photoplan.io.orientation.colmap",
    "opencv": "photoplan.io.camera.opencv",
}

#: Formats whose reader says what is wrong with a file that no format claims, by suffix; else it is a table of text.
_BY_SUFFIX = {".toml": "toml", ".json": "opensfm"}


def orientation_format(name: str) -> OrientationFormat:
    """The format of a name."""
    if name not in FORMATS:
        raise UsageError(f"orientation format {name!r}; allowed are {', '.join(FORMATS)}")
    module, _, value = FORMATS[name].partition(":")
    found: OrientationFormat = getattr(import_module(module), value or "FORMAT")
    return found


def choose_format(path: Path, form: TableFormat) -> OrientationFormat:
    """The one format that a file is of, by its content."""
    if form.columns is not None:
        # Only a table has columns to be declared.
        return orientation_format("csv")
    head = "" if path.is_dir() else read_head(path)
    claiming = [f for f in map(orientation_format, FORMATS) if f.sniff(path, head)]
    if path.is_dir() and not claiming:
        raise InputError(f"{path}: a folder without photographs (JPEG, TIFF) or a COLMAP model; give one, or a file")
    if len(claiming) > 1:
        kinds = ", ".join(f"{f.name} ({f.title})" for f in claiming)
        raise InputError(f"{path}: its content does not tell which format it is: {kinds}; say it with `format`")
    return claiming[0] if claiming else orientation_format(_BY_SUFFIX.get(path.suffix.lower(), "csv"))


def read_orientation_block(
    path: str | Path, form: TableFormat | None = None, format: str | None = None
) -> OrientationBlock:
    """Oriented images of a file, with cameras where it holds them; coordinates are brought into metres."""
    path, form = Path(path), form or TableFormat()
    chosen = choose_format(path, form) if format is None else orientation_format(format)
    block = chosen.read(path, form)
    return replace(block, table=block.table.in_metres())


def read_orientation(path: str | Path, form: TableFormat | None = None, format: str | None = None) -> OrientationTable:
    """Orientation table of a file; see `read_orientation_block`."""
    return read_orientation_block(path, form, format).table


def write_orientation(block: OrientationBlock, path: str | Path, format: str, *, overwrite: bool = False) -> list[Path]:
    """Write a block in a format; each file appears complete or not at all."""
    render = orientation_format(format).render
    if render is None:
        raise UsageError(f"orientation format {format} is read only; written are {', '.join(written_formats())}")
    texts = render(block, Path(path))
    for file in texts:
        check_output(file, overwrite=overwrite)
    with together():
        for file, text in texts.items():
            try:
                make_parents(file.parent)
            except OSError as error:
                raise disk_error(file.parent, error) from None
            write_atomically(file, text.encode())
    return list(texts)


def written_formats() -> list[str]:
    """Names of the formats that can be written."""
    return [name for name in FORMATS if orientation_format(name).render is not None]

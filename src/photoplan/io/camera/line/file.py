"""Line cameras from files of any known format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.appearance import looks_like
from photoplan.io.camera.line import csm, dimap
from photoplan.io.camera.line.model import MAX_BYTES, StatedLine
from photoplan.io.markup_files import read_xml
from photoplan.io.plain_files import read_json


def _isd(path: Path) -> StatedLine:
    return csm.read(read_json(path, MAX_BYTES), path)


def _document(path: Path) -> StatedLine:
    root = read_xml(path, MAX_BYTES)
    if not dimap.is_it(root):
        raise InputError(f"{path}: an XML document of <{root.tag}> without the physical model of a line camera")
    return dimap.read(root, path)


#: Reader of every format, by file suffix.
LINE_FORMATS: dict[str, Callable[[Path], StatedLine]] = {".json": _isd, ".isd": _isd, ".xml": _document}


def read_line(path: Path) -> StatedLine:
    """A line camera of a file: CSM support data (ISD, JSON), or a DIMAP document with a physical model.

    Raises
    ------
    InputError
        The format is unknown, or the file cannot be used.
    """
    read = LINE_FORMATS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path}: not a file of a line camera ({', '.join(LINE_FORMATS)}){looks_like(path)}")
    return read(path)


def is_line(path: Path) -> bool:
    """Whether a file states a line camera; a file that cannot be read does not."""
    kind = path.suffix.lower()
    try:
        if kind == ".xml":
            return dimap.is_it(read_xml(path, MAX_BYTES))
        return kind in LINE_FORMATS and "line_scan_rate" in read_json(path, MAX_BYTES)
    except (InputError, TypeError):
        return False

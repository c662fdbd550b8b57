"""Line cameras from files of any known format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.camera.line import csm, dimap, strip
from photoplan.io.camera.line.model import MAX_BYTES, StatedLine
from photoplan.io.files import looks_like, read_json, read_xml


def _isd(path: Path) -> StatedLine:
    return csm.read(read_json(path, MAX_BYTES), path)


def _document(path: Path) -> StatedLine:
    root = read_xml(path, MAX_BYTES)
    if not dimap.is_it(root):
        raise InputError(f"{path}: an XML document of <{root.tag}> without the physical model of a line camera")
    return dimap.read(root, path)


#: Reader of every format that states a single line, by file suffix.
LINE_FORMATS: dict[str, Callable[[Path], StatedLine]] = {".json": _isd, ".isd": _isd, ".xml": _document}


def read_line(path: Path, detectors: str | None = None) -> StatedLine:
    """A line camera of a file: CSM support data (ISD, JSON), DIMAP with a physical model, or an aerial strip (TOML)."""
    kind = path.suffix.lower()
    if kind == ".toml":
        return strip.read(path, detectors)
    if kind not in LINE_FORMATS:
        known = ", ".join([*LINE_FORMATS, ".toml"])
        raise InputError(f"{path}: not a file of a line camera ({known}){looks_like(path)}")
    if detectors is not None:
        raise InputError(f"{path}: holds a single line of detectors; take `detectors = {detectors!r}` out")
    return LINE_FORMATS[kind](path)


def describe_line(path: Path) -> dict[str, str]:
    """A line camera in words, by name; of several lines of detectors the first, and the names of all."""
    if path.suffix.lower() != ".toml":
        return read_line(path).describe()
    names = strip.names(path)
    return {**read_line(path, names[0]).describe(), "detectors": ", ".join(names)}


def line_files(path: Path) -> list[Path]:
    """The file of a line camera, and those that it names; what is wrong with them is told when they are read."""
    if path.suffix.lower() != ".toml":
        return [path]
    try:
        return [path, *strip.files_beside(path)]
    except InputError:
        return [path]


def is_line(path: Path) -> bool:
    """Whether a file states a line camera; a file that cannot be read does not."""
    kind = path.suffix.lower()
    try:
        if kind == ".toml":
            return strip.is_it(path)
        if kind == ".xml":
            return dimap.is_it(read_xml(path, MAX_BYTES))
        return kind in LINE_FORMATS and "line_scan_rate" in read_json(path, MAX_BYTES)
    except (InputError, TypeError):
        return False

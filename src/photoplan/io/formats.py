"""Registries of camera and orientation file formats; files of any of them are read and written here.

A camera from a calibration report of the U.S. Geological Survey is a camera in photoplan's TOML
(``docs/templates/usgs-camera.toml`` is a template); beside its ``[cameras.NAME]`` the file may have a table
``[report]`` with ``distances_mm``, the printed distances between fiducial marks. Coordinates are typed from paper, and
a wrong digit would bend every image of the camera unnoticed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from photoplan.errors import InputError, UsageError
from photoplan.io.camera.model import Camera, CameraEntry
from photoplan.io.camera.opencv import is_opencv, read_opencv, read_orthority
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.files import explain, finite, format_hint, read_head, read_toml
from photoplan.io.orientation import opensfm, projects, structure_from_motion
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, OrientationTable, TableFormat
from photoplan.io.product import check_output
from photoplan.io.store import together, write_atomically

#: Coordinates and distances are printed to a micrometre each; rounding makes 2 µm, and the least-squares solution that
#: the coordinates come from one more.
TOLERANCE_UM = 3.0


def distance_differences(
    fiducials_mm: Mapping[str, tuple[float, float]], distances_mm: Mapping[str, float], where: str
) -> dict[str, float]:
    """Distance from the coordinates minus the printed one, micrometres, by pair."""
    found = {}
    for pair, printed in distances_mm.items():
        distance = finite(printed, f"{where}: distance {pair}")
        first, _, second = pair.partition("-")
        if first not in fiducials_mm or second not in fiducials_mm or first == second or distance <= 0:
            raise InputError(
                f"{where}: distance {pair!r} = {distance} mm; a key names two of the marks "
                f"({', '.join(fiducials_mm)}) with a hyphen between, and the distance is positive"
            )
        computed = math.dist(fiducials_mm[first], fiducials_mm[second])
        found[pair] = (computed - distance) * 1000.0
    return found


def check_report(contents: Mapping[str, Any], cameras: Mapping[str, CameraEntry], where: str) -> None:
    """Compare the ``[report]`` of a TOML file, if it has one, with the camera that it is about."""
    report = contents.get("report")
    if report is None:
        return
    where = f"{where}: report"
    if not isinstance(report, dict) or not isinstance(report.get("distances_mm"), dict):
        raise InputError(f"{where}: needed is distances_mm = {{ 1-2 = 311.128, … }} and, of several cameras, camera")
    name = report.get("camera", next(iter(cameras)) if len(cameras) == 1 else None)
    camera = cameras.get(name) if isinstance(name, str) else None
    system = camera.fiducial_system if camera is not None else None
    if system is None:
        raise InputError(f"{where}: camera = {name!r}; name one of the film cameras: {', '.join(map(repr, cameras))}")
    differences = distance_differences(system.places_mm, report["distances_mm"], where)
    wrong = {pair: d for pair, d in differences.items() if abs(d) > TOLERANCE_UM}
    if wrong:
        told = ", ".join(f"{pair} by {d:+.0f} µm" for pair, d in wrong.items())
        raise InputError(
            f"{where}: the fiducial marks of camera {name!r} do not have the printed distances: {told} (allowed are "
            f"±{TOLERANCE_UM:.0f}); compare coordinates and distances with the paper"
        )


_CAMERAS = TypeAdapter(dict[str, Camera])


def _text(path: Path) -> dict[str, CameraEntry]:
    """Cameras of one of the formats whose files end in ``.txt``."""
    head = read_head(path)
    if head.lstrip().lower().startswith("filename imagewidth"):
        return dict(projects.read_pix4d(path, TableFormat()).cameras)
    if "CAMERA_ID, MODEL" in head or path.name == "cameras.txt":
        return structure_from_motion.read_colmap_cameras(path)
    raise InputError(
        f"{path}: no camera format; of text files, COLMAP's cameras.txt and Pix4D's calibrated_camera_parameters.txt "
        f"describe cameras{format_hint(path)}"
    )


def _toml(path: Path) -> dict[str, CameraEntry]:
    """Cameras of the ``[cameras.NAME]`` tables of a project file, alone or in a whole project.

    A table ``[report]`` beside them is compared with them.
    """
    contents, text = read_toml(path)
    cameras = contents.get("cameras")
    if not isinstance(cameras, dict) or not cameras:
        raise InputError(f"{path}: holds no [cameras.NAME] table")
    try:
        described: dict[str, CameraEntry] = {**_CAMERAS.validate_python(cameras)}
    except ValidationError as error:
        raise InputError(explain(error, cameras, str(path), text, ("cameras",))) from None
    check_report(contents, described, str(path))
    return described


def _yaml(path: Path) -> dict[str, CameraEntry]:
    return read_opencv(path) if is_opencv(path) else read_orthority(path)


def _json(path: Path) -> dict[str, CameraEntry]:
    return read_opencv(path) if is_opencv(path) else opensfm.read_cameras(path)


#: Reader of every format, by file suffix.
CAMERA_FORMATS: dict[str, Callable[[Path], dict[str, CameraEntry]]] = {
    ".toml": _toml,
    ".yaml": _yaml,
    ".yml": _yaml,
    ".json": _json,
    ".xml": structure_from_motion.read_metashape_cameras,
    ".cam": projects.read_pix4d_cameras,
    ".txt": _text,
    ".bin": structure_from_motion.read_colmap_cameras,
}


@dataclass(frozen=True)
class CameraFile:
    """Cameras of a file."""

    file: Path
    cameras: dict[str, CameraEntry]
    """Descriptions by name."""
    normalised: bool
    """True if the format relates everything to the image's size, so that a camera fits its images at any resolution."""


def read_cameras(path: str | Path) -> CameraFile:
    """Cameras of a file: own TOML, YAML (orthority's layout, OpenCV), JSON of OpenSfM and OpenDroneMap, Metashape's
    ``cameras.xml``, Pix4D's ``.cam`` and ``calibrated_camera_parameters.txt``, COLMAP's
    ``cameras.txt`` and ``cameras.bin``.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in CAMERA_FORMATS:
        known = ", ".join(CAMERA_FORMATS)
        raise InputError(f"{path}: no camera format has the suffix {suffix!r}; allowed are {known}{format_hint(path)}")
    cameras = CAMERA_FORMATS[suffix](path)
    if not cameras:
        raise InputError(f"{path}: describes no camera")
    return CameraFile(path, cameras, suffix == ".json" and not is_opencv(path))


#: Module and value of every format, by name; the value is `FORMAT` unless it is named.
FORMATS: dict[str, str] = {
    "csv": "photoplan.io.orientation.text:CSV",
    "toml": "photoplan.io.orientation.text:TOML",
    "opensfm": "photoplan.io.orientation.opensfm",
    "patb": "photoplan.io.orientation.text:PATB",
    "bingo": "photoplan.io.orientation.text:BINGO",
    "bluh": "photoplan.io.orientation.text:BLUH",
    "inpho": "photoplan.io.orientation.projects:INPHO",
    "metashape": "photoplan.io.orientation.structure_from_motion:METASHAPE",
    "pix4d": "photoplan.io.orientation.projects:PIX4D",
    "opk": "photoplan.io.orientation.text:OPK",
    "exif": "photoplan.io.image_metadata:EXIF",
    "odm": "photoplan.io.orientation.opensfm:ODM",
    "colmap": "photoplan.io.orientation.structure_from_motion:COLMAP",
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

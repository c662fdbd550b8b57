"""Camera descriptions from files of any known format.

A camera from a calibration report of the U.S. Geological Survey is a camera in photoplan's TOML
(``docs/templates/usgs-camera.toml`` is a template); beside its ``[cameras.NAME]`` the file may have a table
``[report]`` with ``distances_mm``, the printed distances between fiducial marks. Coordinates are typed from paper, and
a wrong digit would bend every photograph of the camera unseen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from photoplan.errors import InputError
from photoplan.io.camera.model import Camera, CameraEntry
from photoplan.io.camera.opencv import is_opencv, read_opencv, read_orthority
from photoplan.io.files import explain, finite, looks_like, read_head, read_toml
from photoplan.io.orientation import colmap as orientation_colmap
from photoplan.io.orientation import metashape as orientation_metashape
from photoplan.io.orientation import opensfm, pix4d
from photoplan.io.orientation.form import TableFormat

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
        return dict(pix4d.read(path, TableFormat()).cameras)
    if "CAMERA_ID, MODEL" in head or path.name == "cameras.txt":
        return orientation_colmap.read_cameras(path)
    raise InputError(
        f"{path}: no camera format; of text files, COLMAP's cameras.txt and Pix4D's calibrated_camera_parameters.txt "
        f"describe cameras{looks_like(path)}"
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
    ".xml": orientation_metashape.read_cameras,
    ".cam": pix4d.read_cameras,
    ".txt": _text,
    ".bin": orientation_colmap.read_cameras,
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
        raise InputError(f"{path}: no camera format has the suffix {suffix!r}; allowed are {known}{looks_like(path)}")
    cameras = CAMERA_FORMATS[suffix](path)
    if not cameras:
        raise InputError(f"{path}: describes no camera")
    return CameraFile(path, cameras, suffix == ".json" and not is_opencv(path))

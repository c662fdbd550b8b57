"""Camera descriptions from files of any known format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from photoplan.errors import InputError
from photoplan.io.camera import opencv as camera_opencv
from photoplan.io.camera import opensfm as camera_opensfm
from photoplan.io.camera import pix4d as camera_pix4d
from photoplan.io.camera import yaml as camera_yaml
from photoplan.io.camera.kinds import Camera
from photoplan.io.camera.model import CameraEntry
from photoplan.io.camera.usgs import check_report
from photoplan.io.files import explain, looks_like, read_head, read_toml
from photoplan.io.orientation import colmap as orientation_colmap
from photoplan.io.orientation import metashape as orientation_metashape
from photoplan.io.orientation import pix4d as orientation_pix4d
from photoplan.io.orientation.form import TableFormat

_CAMERAS = TypeAdapter(dict[str, Camera])


def _text(path: Path) -> dict[str, CameraEntry]:
    """Cameras of one of the formats whose files end in ``.txt``."""
    head = read_head(path)
    if head.lstrip().lower().startswith("filename imagewidth"):
        return dict(orientation_pix4d.read(path, TableFormat()).cameras)
    if "CAMERA_ID, MODEL" in head or path.name == "cameras.txt":
        return orientation_colmap.read_cameras(path)
    raise InputError(
        f"{path}: no camera format; of text files, COLMAP's cameras.txt and Pix4D's calibrated_camera_parameters.txt "
        f"describe cameras{looks_like(path)}"
    )


def _toml(path: Path) -> dict[str, CameraEntry]:
    """Cameras of the ``[cameras.NAME]`` tables of a project file, alone or in a whole project.

    A table ``[report]`` beside them is compared with them; see `photoplan.io.camera.usgs`.
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
    return camera_opencv.read(path) if camera_opencv.is_opencv(path) else camera_yaml.read(path)


def _json(path: Path) -> dict[str, CameraEntry]:
    return camera_opencv.read(path) if camera_opencv.is_opencv(path) else camera_opensfm.read(path)


#: Reader of every format, by file suffix.
CAMERA_FORMATS: dict[str, Callable[[Path], dict[str, CameraEntry]]] = {
    ".toml": _toml,
    ".yaml": _yaml,
    ".yml": _yaml,
    ".json": _json,
    ".xml": orientation_metashape.read_cameras,
    ".cam": camera_pix4d.read,
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
    """Whether the format relates everything to the image's size, so that a camera fits its images at any resolution."""


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
    return CameraFile(path, cameras, suffix == ".json" and not camera_opencv.is_opencv(path))

"""Camera descriptions from files of any known format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io import camera_opensfm, camera_toml, camera_yaml
from photoplan.io.camera_model import FilmCamera, FrameCamera

__all__ = ["CAMERA_FORMATS", "CameraFile", "read_cameras"]

#: Reader of every format, by file suffix.
CAMERA_FORMATS: dict[str, Callable[[Path], dict[str, FrameCamera | FilmCamera]]] = {
    ".toml": camera_toml.read,
    ".yaml": camera_yaml.read,
    ".yml": camera_yaml.read,
    ".json": camera_opensfm.read,
}

#: Formats whose cameras are independent of the resolution of the images.
_NORMALISED = (".json",)


@dataclass(frozen=True)
class CameraFile:
    """Cameras of a file."""

    file: Path
    cameras: dict[str, FrameCamera | FilmCamera]
    """Descriptions by name."""
    normalised: bool
    """Whether the format relates everything to the image's size, so that a camera fits its images at any resolution."""


def read_cameras(path: str | Path) -> CameraFile:
    """Cameras of a file: own TOML, YAML (orthority's layout), or JSON of OpenSfM and OpenDroneMap.

    Raises
    ------
    InputError
        The format is unknown, or the file cannot be used.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in CAMERA_FORMATS:
        raise InputError(f"{path}: no camera format has the suffix {suffix!r}; allowed are {', '.join(CAMERA_FORMATS)}")
    cameras = CAMERA_FORMATS[suffix](path)
    if not cameras:
        raise InputError(f"{path}: describes no camera")
    return CameraFile(path, cameras, suffix in _NORMALISED)

"""Cameras from photoplan's own TOML: the ``[cameras.NAME]`` tables of a project file, alone or in a whole project.

A table ``[report]`` beside them is compared with them; see `photoplan.io.camera.usgs`.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from photoplan.errors import InputError
from photoplan.io.camera.kinds import Camera
from photoplan.io.camera.model import CameraEntry
from photoplan.io.camera.usgs import check_report
from photoplan.io.project.errors import explain
from photoplan.io.toml_file import read_toml

_CAMERAS = TypeAdapter(dict[str, Camera])


def read(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a TOML file by name.

    Raises
    ------
    InputError
        There is no ``[cameras.NAME]`` table, or an entry is wrong; the message names its line.
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

"""The project file: the one place for inputs, their CRS and their height systems."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from photoplan.errors import InputError
from photoplan.geometry.crs import require_projected_metres
from photoplan.geometry.heights import check_height_system, require_metric_heights
from photoplan.io.disk import received
from photoplan.io.names import resolve_input
from photoplan.io.naming import write_atomically
from photoplan.io.plain_files import read_toml
from photoplan.io.project.errors import explain
from photoplan.io.project.model import Project
from photoplan.io.project.write import project_text
from photoplan.io.raster_info import read_info


def load_project(path: str | Path) -> Project:
    """Read and check a project file; a folder stands for the `project.toml` in it.

    Inputs that it names are not opened here, except film scans whose size the project does not state; their paths, the
    CRS and the height systems are checked.

    Raises
    ------
    InputError
        The file or an entry is wrong; the message names the entry and its line.
    """
    path = Path(path)
    if (path / "project.toml").is_file():
        path = path / "project.toml"
    data, text = read_toml(path)
    folder = path.resolve().parent
    return parse_project(_with_sizes(data, folder), folder, str(path), text)


def _with_sizes(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Entries of a project with the sizes of measured film scans that only the files state."""
    images, cameras = data.get("images"), data.get("cameras")
    if not isinstance(images, list) or not isinstance(cameras, dict):
        return data
    sized = []
    for image in images:
        name, file = (image.get("camera"), image.get("file")) if isinstance(image, dict) else (None, None)
        camera = cameras.get(name) if isinstance(name, str) and isinstance(file, str) else None
        if isinstance(camera, dict) and image.get("fiducials") and "size" not in {**camera, **image}:
            # What is wrong with the file is said where it is opened.
            with suppress(InputError):
                image = {**image, "size": [*read_info(resolve_input(folder, str(file))).size]}
        sized.append(image)
    return {**data, "images": sized}


def parse_project(data: dict[str, Any], folder: Path, source: str, text: str = "") -> Project:
    """Project of the plain contents of a project file; `source` and `text` are for messages."""
    received(folder)
    if "folder" in data:
        raise InputError(f"{source}: unknown entry 'folder'")
    try:
        project = Project.model_validate({**data, "folder": folder})
    except ValidationError as error:
        raise InputError(explain(error, data, source, text)) from None
    project = project.in_standard_axes()
    require_projected_metres(project.crs, f"{source}: crs")
    terrain = None if project.terrain is None else project.terrain.height_system
    if terrain is not None:
        check_height_system(terrain, f"{source}: [terrain] height_system")
    if project.orientation.height_system is not None:
        # Every Z of the project, of control and of positions refers to it, and all are metres.
        require_metric_heights(project.orientation.height_system, f"{source}: [orientation] height_system")
    for objects in project.objects:
        if objects.height_system is not None:
            check_height_system(objects.height_system, f"{source}: [[objects]] {objects.file} height_system")
    return project


def write_project(path: str | Path, project: Project) -> None:
    """Write a project file with a comment for every entry; `load_project` gives an equal project again.

    The file appears complete or not at all.
    """
    write_atomically(Path(path), project_text(project).encode())


def project_schema() -> str:
    """JSON Schema of the project file, as text."""
    return json.dumps(Project.model_json_schema(), indent=2, ensure_ascii=False)

"""Exterior orientation from photoplan's own TOML.

The file has the entries of a project that concern orientation: ``crs``, ``[orientation]`` (height system, angle unit,
rotation) and ``[[images]]`` with ``name``, ``center``, ``angles`` and, where needed, ``camera`` and ``fiducials``. A
whole project file is read too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.io.camera_model import Fiducials, Name, Triple
from photoplan.io.orientation_block import OrientationBlock, OrientationFormat
from photoplan.io.orientation_table import OrientationTable, OrientedImage, TableFormat
from photoplan.io.project_errors import explain
from photoplan.io.project_model import Orientation
from photoplan.io.toml_file import read_toml

__all__ = ["FORMAT", "read"]


class _Line(BaseModel):
    # What else a project states of an image (its file, its size) is not needed here.
    model_config = ConfigDict(frozen=True, extra="ignore")
    name: Name
    center: Triple
    angles: Triple
    camera: Name | None = None
    fiducials: Fiducials | None = None


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")
    crs: Name | None = None
    orientation: Orientation = Orientation()
    images: Annotated[tuple[_Line, ...], Field(min_length=1)]


def read(path: Path, form: TableFormat) -> OrientationTable:
    """Orientation table of a TOML file; it states its own angle unit and rotation, so `form` is not used.

    Raises
    ------
    InputError
        An entry is wrong; the message names its line.
    """
    contents, text = read_toml(path)
    try:
        file = _File.model_validate(contents)
    except ValidationError as error:
        raise InputError(explain(error, contents, str(path), text)) from None
    crs, heights = None, None
    if file.crs is not None:
        parse_crs(file.crs, f"{path}: crs")
        crs, heights = split_compound(file.crs)
    if file.orientation.height_system is not None:
        heights = file.orientation.height_system
    images = tuple(OrientedImage(i.name, i.center, i.angles, i.camera, None, i.fiducials) for i in file.images)
    return OrientationTable(
        path, images, file.orientation.angle_unit, file.orientation.rotation, crs=crs, height_system=heights
    )


FORMAT = OrientationFormat(
    name="toml",
    title="photoplan's own TOML",
    sniff=lambda path, head: path.suffix.lower() == ".toml",
    read=lambda path, form: OrientationBlock(read(path, form)),
)

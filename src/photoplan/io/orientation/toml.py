"""Exterior orientation from photoplan's own TOML, and to it.

The file has the entries of a project that concern orientation: ``crs``, ``[orientation]`` (height system, angle unit,
rotation), ``[cameras.NAME]`` and ``[[images]]`` with ``name``, ``center``, ``angles`` and, where needed, ``camera``,
``file``, ``size`` and ``fiducials``. A whole project file is read too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.io.camera.model import Camera, Fiducials, Name, Pixels, Triple
from photoplan.io.files import explain, read_toml
from photoplan.io.orientation.block import (
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    OrientedImage,
    require_map,
)
from photoplan.io.orientation.form import TableFormat
from photoplan.io.project.file import camera_lines, toml_value
from photoplan.io.project.model import Orientation


class _TomlLine(BaseModel):
    # What else a project states of an image is not needed here.
    model_config = ConfigDict(frozen=True, extra="ignore")
    name: Name
    center: Triple | None = None
    angles: Triple | None = None
    camera: Name | None = None
    file: Name | None = None
    size: tuple[Pixels, Pixels] | None = None
    fiducials: Fiducials | None = None
    sigma_center: Triple | None = None
    sigma_angles: Triple | None = None


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")
    crs: Name | None = None
    orientation: Orientation = Orientation()
    cameras: dict[Name, Camera] = Field(default_factory=dict)
    images: Annotated[tuple[_TomlLine, ...], Field(min_length=1)]


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of a TOML file with their cameras; it states its own angle unit and rotation: `form`
    is not used.
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
    images: list[OrientedImage] = []
    notes: list[str] = []
    for i in file.images:
        if i.center is not None and i.angles is not None:
            images.append(
                OrientedImage(
                    name=i.name, center=i.center, angles=i.angles, camera=i.camera, line=None, fiducials=i.fiducials
                )
            )
        elif i.center is not None or i.angles is not None:
            raise InputError(f"{path}: image {i.name!r}: center and angles go together; give both or none")
    if not images:
        raise InputError(f"{path}: none of the {len(file.images)} images has center and angles")
    if len(images) < len(file.images):
        notes.append(f"{path.name}: {len(file.images) - len(images)} images are not oriented and left out")
    notes += _not_taken(file, path)
    table = OrientationTable(
        path,
        tuple(images),
        file.orientation.angle_unit,
        file.orientation.rotation,
        crs=crs,
        height_system=heights,
        notes=tuple(notes),
    )
    names = {image.name for image in images}
    files = {i.name: i.file for i in file.images if i.file is not None and i.name in names}
    sizes = {i.name: i.size for i in file.images if i.size is not None and i.name in names}
    return OrientationBlock(table, file.cameras, files, sizes)


def _not_taken(file: _File, path: Path) -> list[str]:
    """Notes on what a project states of its orientations and no orientation file does."""
    notes = []
    corrections = [f"earth curvature ({file.orientation.earth_curvature})"]
    corrections = corrections if file.orientation.earth_curvature != "none" else []
    corrections += ["refraction"] if file.orientation.refraction else []
    if corrections:
        notes.append(f"{path.name}: orientations hold with {' and '.join(corrections)}; whoever reads them must know")
    if any(i.sigma_center is not None or i.sigma_angles is not None for i in file.images):
        notes.append(f"{path.name}: standard deviations of orientations are not taken over")
    return notes


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """The text of a file; numbers that are camera to ground already stay as they are."""
    require_map(block, path)
    table = block.table
    unit, order = (table.angle_unit, table.rotation) if table.direction == "camera-to-ground" else ("deg", "opk")
    lines = ["# Orientations of photoplan; lengths are metres unless the name of an entry says otherwise."]
    if table.crs is not None:
        lines.append(f"crs = {toml_value(table.crs)}")
    lines += ["", "[orientation]"]
    if table.height_system is not None:
        lines.append(f"height_system = {toml_value(table.height_system)}")
    lines += [f"angle_unit = {toml_value(unit)}", f"rotation = {toml_value(order)}", ""]
    for name, camera in block.cameras.items():
        lines += camera_lines(name, camera)
    for image, angles in zip(table.images, block.angles(order, unit)):
        entries = {
            "name": image.name,
            "file": block.files.get(image.name),
            "camera": image.camera if image.camera is not None or not block.cameras else block.camera_name(image),
            "center": list(image.center),
            "angles": angles.tolist(),
            "fiducials": image.fiducials,
            "size": block.sizes.get(image.name),
        }
        lines += ["[[images]]", *(f"{k} = {toml_value(v)}" for k, v in entries.items() if v is not None), ""]
    return {path: "\n".join(lines)}


FORMAT = OrientationFormat(
    name="toml",
    title="photoplan's own TOML",
    sniff=lambda path, head: path.suffix.lower() == ".toml",
    read=read,
    render=render,
    suffix=".toml",
    angles=True,
)

"""Orientation files from one format to another, and what a format cannot hold."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import canonical_crs, require_projected_metres
from photoplan.io.camera.file import read_cameras
from photoplan.io.orientation.block import Loss, OrientationBlock, without_lenses
from photoplan.io.orientation.file import (
    choose_format,
    orientation_format,
    read_orientation_block,
    write_orientation,
    written_formats,
)
from photoplan.io.orientation.table import Direction, OrientationTable, OrientedImage, TableFormat, degrees_of
from photoplan.io.product import check_output
from photoplan.orientation.readings import turn_matrix
from photoplan.plain import pick
from photoplan.products.init.match import camera_name
from photoplan.products.init.run import placed


@dataclass(frozen=True)
class ConvertRequest:
    """What is asked."""

    orientation: Path
    """File, or folder of a format with several files; a project too."""
    target: str
    """Format to write, of `photoplan.io.orientation.file.FORMATS`."""
    output: Path | None = None
    """None: beside the orientation, called after it and the format."""
    format: str | None = None
    """Format to read; None: by the content."""
    form: TableFormat = field(default_factory=TableFormat)
    """What the file does not say of itself."""
    camera: Path | None = None
    """File with cameras, instead of those that the orientation file holds."""
    crs: str | None = None
    """CRS to write: declares that of a file without one, else the orientations are carried into it."""
    camera_axes: str = "up-back"
    """Directions of the camera's y and z in the file that is read: up-back, or down-forward."""
    turned: int = 0
    """Angle by which images are turned against the camera's axes of the file, counter-clockwise, degrees."""
    matrix: Direction | None = None
    """What matrices of the written file do, where its format leaves that open."""
    drop_lens: bool = False
    """Whether a camera is written without its lens where the format has no such lens."""
    overwrite: bool = False


@dataclass(frozen=True)
class ConvertReport:
    """What came out."""

    files: tuple[Path, ...]
    source_format: str
    target_format: str
    images: int
    cameras: tuple[str, ...]
    crs: str | None
    notes: tuple[str, ...]
    """How the file was read."""
    lost: tuple[Loss, ...]
    """What the target format cannot hold."""

    def json_fields(self) -> dict[str, Any]:
        """Formats as from and to."""
        own = pick(self, "files", "images", "cameras", "crs", "notes", "lost")
        return {**own, "from": self.source_format, "to": self.target_format}


def convert_orientation(request: ConvertRequest) -> ConvertReport:
    """Write an orientation file in another format.

    Raises
    ------
    UsageError
        The format is unknown or only read, an output exists or is an input, or a lens would be lost unasked.
    InputError
        The orientation cannot be used, or lacks something that the format needs.
    """
    target = orientation_format(request.target)
    if target.render is None:
        raise UsageError(f"orientation format {target.name} is read only; written are {', '.join(written_formats())}")
    source, block = read_block(request.orientation, request.form, request.format)
    if request.camera is not None:
        block = with_cameras(block, request.camera)
    block = replace(_in_crs(_with_axes(block, request), request.crs), matrix=request.matrix)
    output = request.output or _beside(request.orientation, target.name, target.suffix)
    block = _files_from(block, output if not target.suffix else output.parent)
    block, lost = _without_lost_lenses(block, target.losses(block), request)
    inputs = [p for p in (request.orientation, request.camera) if p is not None and not p.is_dir()]
    for file in target.render(block, output):
        check_output(file, inputs, overwrite=request.overwrite)
    files = write_orientation(block, output, target.name, overwrite=request.overwrite)
    table = block.table
    return ConvertReport(
        files=tuple(files),
        source_format=source,
        target_format=target.name,
        images=len(table.images),
        cameras=tuple(block.cameras),
        crs=table.crs,
        notes=table.notes,
        lost=lost,
    )


def read_block(path: Path, form: TableFormat, format: str | None) -> tuple[str, OrientationBlock]:
    """Name of a file's format, and its contents."""
    name = format or choose_format(path, form).name
    return name, read_orientation_block(path, form, name)


def with_cameras(block: OrientationBlock, path: Path) -> OrientationBlock:
    """The block with the cameras of a file.

    Raises
    ------
    InputError
        The file cannot be used, or an image's camera is not in it.
    """
    cameras = read_cameras(path)
    table = block.table
    images = tuple(replace(image, camera=camera_name(image, cameras, table.file)) for image in table.images)
    used = {image.camera for image in images}
    described = {name: camera for name, camera in cameras.cameras.items() if name in used}
    return replace(block, table=replace(table, images=images), cameras=described)


def _with_axes(block: OrientationBlock, request: ConvertRequest) -> OrientationBlock:
    """The block with its rotations brought to our camera axes."""
    F = turn_matrix(request.camera_axes, request.turned)
    if np.array_equal(F, np.eye(3)):
        return block
    return replace(block, table=_with_poses(block.table, block.table.centers, degrees_of(block.table.rotations @ F.T)))


def _with_poses(table: OrientationTable, centers: NDArray[np.float64], opk: NDArray[np.float64]) -> OrientationTable:
    images = tuple(
        OrientedImage(i.name, _triple(c), _triple(a), i.camera, i.line, i.fiducials)
        for i, c, a in zip(table.images, centers, opk)
    )
    return replace(table, images=images, angle_unit="deg", rotation="opk", direction="camera-to-ground")


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in values)
    return a, b, c


def _in_crs(block: OrientationBlock, crs: str | None) -> OrientationBlock:
    """The block in a CRS; heights stay as they are."""
    if crs is None:
        return block
    require_projected_metres(crs, "`crs`")
    table, crs = block.table, canonical_crs(crs)
    if table.crs is None and table.origin is None:
        return replace(block, table=replace(table, crs=crs))
    centers, opk = placed(table, crs, table.height_system or "same")
    if centers is not table.centers:
        table = _with_poses(table, centers, opk)
    return replace(block, table=replace(table, crs=crs, crs_file=None, origin=None))


def _beside(path: Path, name: str, suffix: str) -> Path:
    return path.with_name(f"{path.stem}_{name}{suffix}")


def _files_from(block: OrientationBlock, folder: Path) -> OrientationBlock:
    """The block with paths of image files that exist written from another folder."""
    source = block.table.file if block.table.file.is_dir() else block.table.file.parent
    files = {}
    for name, file in block.files.items():
        found = source / file
        try:
            there = not Path(file).is_absolute() and found.is_file()
            files[name] = Path(os.path.relpath(found.resolve(), folder.resolve())).as_posix() if there else file
        except (OSError, ValueError):  # a name that no file can have, or another drive
            files[name] = file
    return replace(block, files=files)


def _without_lost_lenses(
    block: OrientationBlock, losses: Iterable[Loss], request: ConvertRequest
) -> tuple[OrientationBlock, tuple[Loss, ...]]:
    lost = tuple(losses)
    lenses = [loss for loss in lost if loss.kind == "lens"]
    if not lenses:
        return block, lost
    if not request.drop_lens:
        raise UsageError(
            f"{request.target} holds {'; '.join(loss.text for loss in lenses)}; measured points would be off by the "
            "distortion. Choose another format, or say `drop_lens` and correct the images before"
        )
    if not block.cameras:
        raise InputError(f"{block.table.file}: a lens would be lost, and no camera is described")
    return without_lenses(block), lost

"""Orientation files from one format to another, what a format cannot hold, and which readings fit measured points."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.lenses import Interior, Lens
from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.bounds import area_fault, area_note
from photoplan.geometry.crs import canonical_crs, require_projected_metres
from photoplan.geometry.frames import triple
from photoplan.geometry.local import enu_of_geodetic
from photoplan.geometry.pose import degrees_of
from photoplan.io.files import ImageNames
from photoplan.io.formats import (
    choose_format,
    orientation_format,
    read_cameras,
    read_orientation_block,
    write_orientation,
    written_formats,
)
from photoplan.io.image_metadata import IMAGE_SUFFIXES
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationTable,
    OrientedImage,
    TableFormat,
    without_lenses,
)
from photoplan.io.points import named_as, read_ground_points, read_image_points
from photoplan.io.product import check_output
from photoplan.io.project.model import Image, interior_of, lens_of
from photoplan.io.store import recording
from photoplan.orientation.conventions import (
    Convention,
    FittedConvention,
    StatedPoses,
    fitting,
    judge_conventions,
    sights_of,
    turn_matrix,
)
from photoplan.plain import counted, pick
from photoplan.products.budget import write_polynomials
from photoplan.products.init import camera_name, placed
from photoplan.products.plausibility import differences, on_map, stated_positions
from photoplan.project.cameras import is_there
from photoplan.requests.orient import ConvertRequest

#: Formats whose poses are read as those of a system in true metres.
_CARTESIAN = ("colmap", "metashape", "odm", "opensfm", "opk")


@dataclass(frozen=True)
class ConvertReport(Result):
    """Files of a conversion, and what they cannot hold."""

    files: tuple[Path, ...]
    source_format: str
    target_format: str
    images: int
    cameras: tuple[str, ...]
    crs: str | None
    notes: tuple[str, ...]
    """Remarks on how the file was read."""
    lost: tuple[Loss, ...]
    """Losses: what the target format cannot hold."""
    dry_run: bool

    def json_fields(self) -> dict[str, Any]:
        """Formats as from and to."""
        own = pick(self, "files", "images", "cameras", "crs", "notes", "lost")
        return {**own, "from": self.source_format, "to": self.target_format}

    def written(self) -> Sequence[Path]:
        """Return the files that were, or would be, written."""
        return self.files

    def messages(self) -> Sequence[str]:
        """Return what was converted, what is lost, and how the file was read."""
        nothing = "; nothing is written" if self.dry_run else ""
        lines = [f"  {counted(self.images, 'image')}, from {self.source_format} to {self.target_format}{nothing}"]
        lines += [f"  {self.target_format} holds {loss.text}" for loss in self.lost]
        return [*lines, *noted(self.notes)]


def convert(request: ConvertRequest, events: Events = SILENT) -> Result:
    """Write an orientation in another format, polynomials of a project, or list readings, whichever is set."""
    if request.list_readings and request.image_points is not None and request.control is not None:
        return list_readings(request, request.image_points, request.control)
    return write_polynomials(request) if request.target == "rpc" else convert_orientation(request)


def convert_orientation(request: ConvertRequest) -> ConvertReport:
    """Write an orientation file in another format.

    Raises
    ------
    UsageError
        The format is unknown or only read, an output exists or is an input, or a lens would be lost unasked.
    InputError
        The orientation cannot be used, or lacks something that the format needs.
    """
    target = orientation_format(request.target or "")
    if target.render is None:
        raise UsageError(f"orientation format {target.name} is read only; written are {', '.join(written_formats())}")
    source, block = read_block(request.orientation, request.form, request.format)
    images = _image_files(block)
    if request.camera is not None:
        block = with_cameras(block, request.camera)
    block = replace(_in_crs(_with_axes(block, request), request.crs), matrix=request.matrix)
    outside = _judged_area(block.table, request.beyond_area)
    if block.table.true_metres and target.name not in _CARTESIAN:
        outside += (
            f"the poses are in true metres, and {target.name} does not say so: use them with earth_curvature strict "
            "(`photoplan init` with `earth_curvature`)",
        )
    source_file = request.orientation
    output = request.output or source_file.with_name(f"{source_file.stem}_{target.name}{target.suffix}")
    block = _files_from(block, output if not target.suffix else output.parent)
    block, lost = _without_lost_lenses(block, target.losses(block), request)
    inputs = [p for p in (request.orientation, request.camera) if p is not None and not p.is_dir()]
    files = list(target.render(block, output))
    for file in files:
        check_output(file, inputs, overwrite=request.overwrite)
    table = block.table
    with recording("convert", request, inputs) as record:
        if not request.dry_run:
            files = write_orientation(block, output, target.name, overwrite=request.overwrite)
        report = ConvertReport(
            files=tuple(files),
            source_format=source,
            target_format=target.name,
            images=len(table.images),
            cameras=tuple(block.cameras),
            crs=table.crs,
            notes=(*table.notes, *outside, *_against_positions(block, images)),
            lost=lost,
            dry_run=request.dry_run,
        )
        record(() if request.dry_run else report.files, report)
    return report


def _judged_area(table: OrientationTable, beyond: bool) -> tuple[str, ...]:
    """Note centres a little outside the area of their CRS; refuse those far outside unless they are meant."""
    if table.crs is None or table.origin is not None or beyond:
        return ()
    names = [image.name for image in table.images]
    fault = area_fault(table.crs, table.centers, names)
    if fault is not None:
        raise InputError(f"{table.file}: projection centre of {fault}")
    note = area_note(table.crs, table.centers, names)
    return () if note is None else (f"projection centre of {note}",)


def _against_positions(block: OrientationBlock, files: Mapping[str, Path]) -> tuple[str, ...]:
    """Return contradictions between poses and positions of receivers, in the file or in its images."""
    table = block.table
    stated = stated_positions(table, files)
    if table.origin is not None:
        here = enu_of_geodetic(table.origin, stated)
    elif table.crs is not None:
        here = on_map(stated, table.crs)
    else:
        return ()
    return differences([image.name for image in table.images], table.centers, here)


def _image_files(block: OrientationBlock) -> dict[str, Path]:
    """Return image files that an orientation file names, or that lie next to it under the names of its images."""
    folder = block.table.file if block.table.file.is_dir() else block.table.file.parent
    names = [image.name for image in block.table.images]
    try:
        beside = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
        matched = ImageNames(names).match([path.as_posix() for path in beside])
    except (OSError, InputError):  # a folder that may be entered, but not listed; names that fit several images
        beside, matched = [], []
    found = {name: path for path, name in zip(beside, matched) if name is not None}
    found |= {name: folder / name for name in names if "/" in name and is_there(folder / name)}
    found |= {name: folder / file for name, file in block.files.items() if is_there(folder / file)}
    return found


def read_block(path: Path, form: TableFormat, format: str | None) -> tuple[str, OrientationBlock]:
    """Name of a file's format, and its contents."""
    name = format or choose_format(path, form).name
    return name, read_orientation_block(path, form, name)


def with_cameras(block: OrientationBlock, path: Path) -> OrientationBlock:
    """Return the block with the cameras of a file."""
    cameras = read_cameras(path)
    table = block.table
    images = tuple(replace(image, camera=camera_name(image, cameras, table.file)) for image in table.images)
    used = {image.camera for image in images}
    described = {name: camera for name, camera in cameras.cameras.items() if name in used}
    return replace(block, table=replace(table, images=images), cameras=described)


def _with_axes(block: OrientationBlock, request: ConvertRequest) -> OrientationBlock:
    """Return the block with its rotations in our camera axes."""
    F = turn_matrix(request.camera_axes, request.turned)
    if np.array_equal(F, np.eye(3)):
        return block
    return replace(block, table=_with_poses(block.table, block.table.centers, degrees_of(block.table.rotations @ F.T)))


def _with_poses(table: OrientationTable, centers: NDArray[np.float64], opk: NDArray[np.float64]) -> OrientationTable:
    images = tuple(
        OrientedImage(
            name=i.name, center=triple(c), angles=triple(a), camera=i.camera, line=i.line, fiducials=i.fiducials
        )
        for i, c, a in zip(table.images, centers, opk)
    )
    return replace(table, images=images, angle_unit="deg", rotation="opk", direction="camera-to-ground")


def _in_crs(block: OrientationBlock, crs: str | None) -> OrientationBlock:
    """Return the block in a CRS, with heights in metres in their own height system."""
    block = replace(block, table=block.table.heights_in_metres(None))
    if crs is None:
        return block
    require_projected_metres(crs, "`crs`")
    table, crs = block.table, canonical_crs(crs)
    if table.crs is None and table.origin is None:
        return replace(block, table=replace(table, crs=crs))
    centers, opk = placed(table, crs)
    if centers is not table.centers:
        table = _with_poses(table, centers, opk)
    return replace(block, table=replace(table, crs=crs, crs_file=None, origin=None, true_metres=block.table.cartesian))


def _files_from(block: OrientationBlock, folder: Path) -> OrientationBlock:
    """Return the block with paths of existing image files written from another folder."""
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


#: Readings that are listed besides those that fit.
OTHERS = 5
#: Beyond this median even the best reading does not fit, pixels.
POOR = 20.0


@dataclass(frozen=True)
class ReadingsReport(Result):
    """Readings of a file with their errors, the best first."""

    format: str
    points: int
    images: int
    matrices: bool
    """True if the file states matrices, so that units and orders have no meaning."""
    fitting: tuple[FittedConvention, ...]
    others: tuple[FittedConvention, ...]
    """The next ones, for comparison."""
    notes: tuple[str, ...]

    def options(self, reading: Convention) -> str:
        """Return the options by which `photoplan convert` reads the file so."""
        words = [] if self.matrices else [f"`angle_unit` {reading.angle_unit}", f"`rotation` {reading.rotation}"]
        words.append(f"`rotation_direction` {reading.direction}")
        if reading.camera_axes != Convention.camera_axes:
            words.append(f"`camera_axes` {reading.camera_axes}")
        if reading.turned:
            words.append(f"`image_turned` {reading.turned}")
        if reading.swapped:
            words.append("and exchange X and Y")
        if reading.mirrored:
            words.append("and mirror the images (film: mirrored = true)")
        return " ".join(words)

    def json_fields(self) -> dict[str, Any]:
        """Readings with the options that declare them."""
        return {
            **pick(self, "format", "points", "images", "notes"),
            "fitting": [self._fields(found) for found in self.fitting],
            "others": [self._fields(found) for found in self.others],
        }

    def summary(self) -> Sequence[str]:
        """Return a line for each reading with its error and the options that declare it."""
        kinds = (("fits", self.fitting), ("", self.others))
        return [
            f"{r.median:10.2f} px  {fits:4}  {self.options(r.reading)}" for fits, readings in kinds for r in readings
        ]

    def messages(self) -> Sequence[str]:
        """Return how many points were compared, and notes."""
        return [f"  medians of {counted(self.points, 'point')} in {counted(self.images, 'image')}", *noted(self.notes)]

    def _fields(self, found: FittedConvention) -> dict[str, Any]:
        reading = found.reading
        stated = {} if self.matrices else pick(reading, "angle_unit", "rotation")
        axes = pick(
            reading, "camera_axes", "mirrored", "swapped", rotation_direction="direction", image_turned="turned"
        )
        return {**stated, **axes, "median_px": found.median, "options": self.options(reading)}


def list_readings(request: ConvertRequest, image_points: Path, control: Path) -> ReadingsReport:
    """Judge all readings of an orientation file by measured points."""
    # So that no unit or direction is refused, whatever they are; gon allows the largest numbers.
    form = request.form.replace(angle_unit="gon", rotation="opk", direction="camera-to-ground")
    name, block = read_block(request.orientation, form, request.format)
    if request.camera is not None:
        block = with_cameras(block, request.camera)
    if not block.cameras:
        raise UsageError("to compare readings the camera has to be known; give `camera` FILE")
    table = block.table
    names = tuple(image.name for image in table.images)
    observed, unknown = named_as(read_image_points(image_points), names)
    ground = read_ground_points(control, crs=table.crs)
    cameras, notes = _cameras(block)
    sights = sights_of(names, cameras, observed, ground)
    if unknown:
        notes.append(f"{len(unknown)} images of {image_points.name} have no orientation ({unknown[0]!r} …)")
    open_angles = orientation_format(name).angles
    if open_angles:
        at = [table.rotation.index(letter) for letter in "opk"]
        poses = StatedPoses(names, table.centers, angles=np.array([i.angles for i in table.images], float)[:, at])
    else:
        poses = StatedPoses(names, table.centers, matrices=table.rotations)
    results = judge_conventions(poses, sights)
    fits = fitting(results)
    if fits[0].median > POOR:
        notes.append(
            f"even the best reading leaves {fits[0].median:.0f} px: are orientation and control in one coordinate "
            "system with heights of one kind, and is it the right camera?"
        )
    others = [r for r in results if r not in fits and np.isfinite(r.median)][:OTHERS]
    seen = len(np.unique(sights.image))
    return ReadingsReport(
        format=name,
        points=len(sights.image),
        images=seen,
        matrices=not open_angles,
        fitting=fits,
        others=tuple(others),
        notes=tuple(notes),
    )


def _cameras(block: OrientationBlock) -> tuple[dict[str, tuple[Interior, Lens]], list[str]]:
    """Return interior orientation and lens of every image, and notes on images without one."""
    found: dict[str, tuple[Interior, Lens]] = {}
    missing = []
    for image in block.table.images:
        camera = block.camera(image)
        if not camera.places(image.fiducials):
            missing.append(image.name)
            continue
        # Only the marks and the size of the image matter here; no file is opened.
        described = Image(
            name=image.name,
            file="none",
            camera=block.camera_name(image),
            fiducials=image.fiducials,
            size=block.sizes.get(image.name),
        )
        found[image.name] = (interior_of(camera, described), lens_of(camera))
    if not found:
        raise InputError(f"{block.table.file}: no image has measured fiducial marks; `photoplan fiducials` finds them")
    notes = [f"{len(missing)} film images have no measured fiducial marks ({missing[0]!r} …)"] if missing else []
    return found, notes

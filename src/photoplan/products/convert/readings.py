"""Which readings of an orientation file fit measured points: files in, a list with the options to give out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.errors import InputError, UsageError
from photoplan.io.ground_points import read_ground_points
from photoplan.io.image_points import named_as, read_image_points
from photoplan.io.orientation.block import OrientationBlock
from photoplan.io.orientation.file import orientation_format
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.io.project.model import Image
from photoplan.orientation.readings import (
    FittedReading,
    Reading,
    StatedPoses,
    fitting,
    judge_readings,
    sights_of,
)
from photoplan.plain import pick
from photoplan.products.convert.run import ConvertRequest, read_block, with_cameras

#: Readings that are listed besides those that fit.
OTHERS = 5
#: Beyond this median even the best reading does not fit, pixels.
POOR = 20.0


@dataclass(frozen=True)
class ReadingsReport:
    """Readings of a file with their errors, the best first."""

    format: str
    points: int
    images: int
    matrices: bool
    """Whether the file states matrices, so that units and orders have no meaning."""
    fitting: tuple[FittedReading, ...]
    others: tuple[FittedReading, ...]
    """The next ones, for comparison."""
    notes: tuple[str, ...]

    def options(self, reading: Reading) -> str:
        """What to give to `photoplan convert` so that it reads the file so."""
        words = [] if self.matrices else [f"`angle_unit` {reading.angle_unit}", f"`rotation` {reading.rotation}"]
        words.append(f"`rotation_direction` {reading.direction}")
        if reading.camera_axes != Reading.camera_axes:
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

    def _fields(self, found: FittedReading) -> dict[str, Any]:
        reading = found.reading
        stated = {} if self.matrices else pick(reading, "angle_unit", "rotation")
        axes = pick(
            reading, "camera_axes", "mirrored", "swapped", rotation_direction="direction", image_turned="turned"
        )
        return {**stated, **axes, "median_px": found.median, "options": self.options(reading)}


def list_readings(request: ConvertRequest, image_points: Path, control: Path) -> ReadingsReport:
    """Judge all readings of an orientation file by measured points.

    Raises
    ------
    UsageError
        No camera is known.
    InputError
        A file cannot be used, or too few points are known in both.
    """
    name, block = _as_stated(request)
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
    results = judge_readings(poses, sights)
    fits = fitting(results)
    if fits[0].median > POOR:
        notes.append(
            f"even the best reading leaves {fits[0].median:.0f} px: are orientation and control in one coordinate "
            "system with heights of one kind, and is it the right camera?"
        )
    others = [r for r in results if r not in fits and np.isfinite(r.median)][:OTHERS]
    seen = len(np.unique(sights.image))
    return ReadingsReport(name, len(sights.image), seen, not open_angles, fits, tuple(others), tuple(notes))


def _as_stated(request: ConvertRequest) -> tuple[str, OrientationBlock]:
    """The file's numbers: read so that no unit or direction is refused; what they are taken for does not matter."""
    # Of all units gon allows the largest numbers.
    form = replace(request.form, angle_unit="gon", rotation="opk", direction="camera-to-ground")
    form = replace(form, declared=frozenset({"rotation", "direction"}))
    return read_block(request.orientation, form, request.format)


def _cameras(block: OrientationBlock) -> tuple[dict[str, tuple[Interior, Lens]], list[str]]:
    """Interior orientation and lens of every image, and notes on images without one."""
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

"""Oriented images together with their cameras, and what a file format for them is.

To add a format, define an `OrientationFormat` of four functions in a module of its family, and add a line to
`photoplan.io.orientation.file.FORMATS`. Nothing else changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.pose import ANGLE_UNITS, angles_from_rotation
from photoplan.io.camera.model import CameraEntry, IdealLens, UnusableCamera
from photoplan.io.orientation.form import Direction, TableFormat
from photoplan.io.orientation.table import OrientationTable, OrientedImage

LossKind = Literal["lens", "camera", "film", "crs", "height_system", "other"]


def without_unusable(table: OrientationTable, faults: Mapping[str, UnusableCamera]) -> OrientationTable:
    """The table without images of cameras that cannot be used, with a note; `faults` is by the camera's name."""
    lost = [image for image in table.images if image.camera in faults]
    if not lost:
        return table
    first = faults[lost[0].camera or ""]
    keep = [k for k, image in enumerate(table.images) if image.camera not in faults]
    if not keep:
        raise first
    count = "1 image is" if len(lost) == 1 else f"{len(lost)} images are"
    return replace(
        table,
        images=tuple(table.images[k] for k in keep),
        positions=None if table.positions is None else table.positions[keep],
        notes=(*table.notes, f"warning: {count} left out, whose camera cannot be used ({lost[0].name} …): {first}"),
    )


@dataclass(frozen=True)
class Loss:
    """Something that a format cannot hold."""

    kind: LossKind
    """``lens``: a file with the camera but without its lens would be wrong; such a file is written only on demand.
    Everything else is only told."""
    text: str
    """What is lost, and where to keep it; a sentence without a full stop."""


@dataclass(frozen=True, eq=False)
class OrientationBlock:
    """Everything that is known of a block of oriented images; checked at birth."""

    table: OrientationTable
    """Poses and the names of the images and of their cameras."""
    cameras: Mapping[str, CameraEntry] = field(default_factory=dict)
    """Descriptions by name; empty where the file holds none. With one camera, images need not name it."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Image files by image name, as stated (relative to the orientation file, or absolute); not all are known."""
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Width and height in pixels by image name, where the camera does not state them."""
    matrix: Direction | None = None
    """What rotation matrices do in a file that is written, where its format leaves that open; None: as is usual."""

    def __post_init__(self) -> None:
        names = {image.name for image in self.table.images}
        for what, known in (("file", self.files), ("size", self.sizes)):
            unknown = next((name for name in known if name not in names), None)
            if unknown is not None:
                raise InputError(f"{self.table.file}: {what} of image {unknown!r}, which is not in the block")
        if not self.cameras:
            return
        for image in self.table.images:
            self.camera_name(image)

    def camera_name(self, image: OrientedImage) -> str:
        """Name of an image's camera."""
        known = ", ".join(map(repr, self.cameras)) or "none"
        if image.camera is None:
            if len(self.cameras) == 1:
                return next(iter(self.cameras))
            raise InputError(f"{self.table.file}: image {image.name!r} names no camera; cameras are {known}")
        if image.camera not in self.cameras:
            raise InputError(
                f"{self.table.file}: camera {image.camera!r} of image {image.name!r} is not described; "
                f"cameras are {known}"
            )
        return image.camera

    def camera(self, image: OrientedImage) -> CameraEntry:
        """Description of an image's camera; raises as `camera_name`."""
        return self.cameras[self.camera_name(image)]

    def size(self, image: OrientedImage) -> tuple[int, int] | None:
        """Width and height of an image in pixels, None if they are not known."""
        own = self.sizes.get(image.name)
        return own if own is not None or not self.cameras else self.camera(image).size

    def angles(self, order: str, unit: str) -> NDArray[np.float64]:
        """Angles of all images, shape (n, 3), for camera-to-ground matrices: in the sequence of `order`, in `unit`."""
        table = self.table
        if (table.angle_unit, table.rotation, table.direction) == (unit, order, "camera-to-ground"):
            # Numbers that are already so stay untouched.
            return np.array([i.angles for i in table.images], np.float64)
        scale = ANGLE_UNITS[unit] / (2 * np.pi)
        angles = np.array([angles_from_rotation(R, order) for R in table.rotations], np.float64) * scale
        # Rounded below the noise of the conversion; adding zero turns −0.0 into 0.0.
        return np.asarray(np.round(angles, 12) + 0.0, np.float64)


@dataclass(frozen=True)
class OrientationFormat:
    """A file format for orientations."""

    name: str
    """As users spell it."""
    title: str
    """As users know it."""
    sniff: Callable[[Path, str], bool]
    """Whether a file may be of this format: its path and its first 64 KiB as text (line ends are newlines, bytes that
    are not UTF-8 are replaced; empty for a folder). If two formats claim one file, the user is asked; a format without
    any mark of its own claims none and has to be stated. What no format claims is read as a table of text."""
    read: Callable[[Path, TableFormat], OrientationBlock]
    """What the file holds; `TableFormat` only where the format leaves conventions open. Raises InputError."""
    render: Callable[[OrientationBlock, Path], Mapping[Path, str]] | None = None
    """Text of all files to be written under a path that the user gave (a folder for formats of several files); writes
    nothing itself. Raises InputError where something that the format needs is not known. None: read only."""
    losses: Callable[[OrientationBlock], Iterable[Loss]] = lambda block: ()
    """What of a block the format cannot hold."""
    suffix: str = ".txt"
    """Of a file that the user gives no name; empty for a folder."""
    angles: bool = False
    """Whether files hold three angles that could mean something else than they are taken for."""


def require_map(block: OrientationBlock, path: Path) -> None:
    """Refuse a block in a local tangential system, for formats that cannot state its origin."""
    if block.table.origin is not None:
        raise InputError(
            f"{path}: the orientations of {block.table.file} are in a local system that this format cannot state; "
            "carry them into a map with `crs` EPSG:nnnn"
        )


def require_cameras(block: OrientationBlock, path: Path, what: str) -> None:
    """Refuse a block without cameras, for formats that describe them; `what` names the file in the message."""
    if not block.cameras:
        raise InputError(f"{path}: {what} describes the cameras, and none is given; name the file that does")


def without_lenses(block: OrientationBlock) -> OrientationBlock:
    """The block with all lenses taken as free of distortion."""
    cameras = {name: camera.model_copy(update={"lens": IdealLens()}) for name, camera in block.cameras.items()}
    return replace(block, cameras=cameras)


def common_losses(block: OrientationBlock, *, cameras: bool, crs: bool = False, film: bool = True) -> list[Loss]:
    """Losses of a format that holds what is True, and no lens nor height system."""
    lost: list[Loss] = []
    if block.cameras and not cameras:
        names = ", ".join(map(repr, block.cameras))
        lost.append(Loss("camera", f"no cameras ({names}): keep the file that describes them"))
    if cameras:
        for name, camera in block.cameras.items():
            if camera.fiducial_system is not None and not film:
                lost.append(Loss("film", f"no fiducial marks (camera {name!r})"))
            if camera.lens.type != "none":
                lost.append(Loss("lens", f"no lens of type {camera.lens.type} (camera {name!r})"))
    if block.table.crs is not None and not crs:
        lost.append(Loss("crs", "no coordinate system: state it to whoever reads the file"))
    if block.table.height_system is not None:
        lost.append(Loss("height_system", f"no height system ({block.table.height_system})"))
    return lost


def name_losses(block: OrientationBlock, most: int) -> Iterable[Loss]:
    """The loss of a format whose names have so many characters at the most."""
    long = [image.name for image in block.table.images if len(image.name) > most]
    if long:
        yield Loss("other", f"names of more than {most} characters may not be taken ({long[0]!r}): shorten them")


def height_losses(table: OrientationTable) -> Iterable[Loss]:
    """The loss of a format whose heights are understood as ellipsoidal."""
    if table.crs is not None and table.height_system != "ellipsoidal":
        stated = table.height_system or "not stated"
        yield Loss("height_system", f"heights as ellipsoidal ones only (these are: {stated})")

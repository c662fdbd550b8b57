"""Orientations as file formats read and write them; `OrientationFormat`, the declaration of a format.

To add a format, define an `OrientationFormat` of four functions in a module of its family, and add a line to
`photoplan.io.formats.FORMATS`. Nothing else changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from photoplan.arrays import Floats
from photoplan.errors import InputError, UsageError
from photoplan.geometry.bounds import odd_angles, odd_place
from photoplan.geometry.pose import (
    angle_in_radians,
    angle_in_unit,
    angles_from_rotation,
    degrees_of,
    rotation_from_angles,
)
from photoplan.geometry.units import agreed_metres, metric_heights, metric_system, unit_label
from photoplan.io.camera.model import CameraEntry, IdealLens, UnusableCamera
from photoplan.request import Request, opt

Direction = Literal["camera-to-ground", "ground-to-camera"]
_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}


class TableFormat(Request):
    """Form and conventions of a table of numbers.

    A file format with conventions of its own gives way to those that are set, also to the value of the default.
    """

    columns: str | None = opt(
        "Columns of a table: name,x,y,z,omega,phi,kappa[,camera] in their order, - for one that is not used; or by the "
        "header: name=LABEL,x=…",
        None,
        section="input",
    )
    delimiter: str | None = opt("Delimiter of a table [the one that splits all lines equally].", None,
                                choices=_DELIMITERS, section="input")  # fmt: skip
    decimal_comma: bool = opt("Numbers of a table are written 1,5.", False, section="input")
    angle_unit: Literal["deg", "gon", "rad"] = opt("Unit of angles [deg, or the format's own].", "deg", section="input")
    rotation: Literal["opk", "pok", "kpo", "kop", "okp", "pko"] = opt(
        "Order of omega, phi, kappa, whatever the order of columns; the first is primary [opk, or the format's own].",
        "opk",
        section="input",
    )
    direction: Direction = opt(
        "Direction of the file's rotation [camera-to-ground; some formats require it].",
        "camera-to-ground",
        flag="rotation-direction",
        section="input",
    )

    def check(self) -> None:
        """Refuse unknown delimiters, and a comma with two meanings."""
        if self.delimiter not in (None, *_DELIMITERS.values()):
            raise UsageError(f"delimiter {self.delimiter!r} must be one of {', '.join(_DELIMITERS)}")
        if self.delimiter == "," and self.decimal_comma:
            raise UsageError("a comma cannot be both delimiter and decimal sign")

    @classmethod
    def of(cls, angle_unit: str, rotation: str) -> Self:
        """Return the format of a table in the conventions of a project; usual ones yield to the file's own."""
        usual, given = cls(), {"angle_unit": angle_unit, "rotation": rotation}
        return cls(**{name: value for name, value in given.items() if value != getattr(usual, name)})

    def declares(self, name: str) -> bool:
        """Return whether a convention was set."""
        return name in self.model_fields_set

    def conventions(self, angle_unit: str, rotation: str, direction: Direction) -> tuple[str, str, Direction]:
        """Return angle unit, rotation and direction for a format that defines its own, unless others are declared."""
        return (
            self.angle_unit if self.declares("angle_unit") else angle_unit,
            self.rotation if self.declares("rotation") else rotation,
            self.direction if self.declares("direction") else direction,
        )


#: By the letters that spell an order of rotations.
ANGLE_NAMES = {"o": "omega", "p": "phi", "k": "kappa"}


@dataclass(frozen=True)
class OrientedImage:
    """One line of an orientation table."""

    name: str
    center: tuple[float, float, float]
    """Projection centre in the table's system, in its units (metres once `read_orientation_block` returns it)."""
    angles: tuple[float, float, float]
    """Angles in the table's unit, in the sequence of its rotation order."""
    camera: str | None = None
    """Name of the camera, where the table states it."""
    line: int | None = None
    """Line in the file."""
    fiducials: dict[str, tuple[float, float]] | None = None
    """Measured fiducial marks [column, row], where the table states them."""


@dataclass(frozen=True, eq=False)
class OrientationTable:
    """All images of an orientation file and what the numbers mean."""

    file: Path
    images: tuple[OrientedImage, ...]
    angle_unit: str = "deg"
    rotation: str = "opk"
    direction: Direction = "camera-to-ground"
    crs: str | None = None
    """Horizontal CRS; None if the file does not state it."""
    crs_file: Path | None = None
    """The file that states it, where it is another one."""
    height_system: str | None = None
    """None if the file does not state it."""
    origin: tuple[float, float, float] | None = None
    """Latitude, longitude (degrees, WGS 84) and height of a local tangential system (east, north, up), where positions
    and rotations refer to one; None where they refer to `crs`."""
    true_metres: bool = False
    """True if the poses were computed in a Cartesian system of true metres (geocentric, or about a point) and brought
    into `crs` place by place; else they were adjusted in map coordinates, whose scale and curvature they absorbed."""
    positions: Floats | None = None
    """Latitude, longitude (degrees, WGS 84) and height that a receiver measured, shape (n, 3), where the file states
    them beside the poses; NaN for images without. They were not used to place the poses."""
    notes: tuple[str, ...] = ()
    """Remarks on how the file was read."""
    map_unit: float = 1.0
    """Metres in the unit in which the file states X and Y; `in_metres` has converted them."""
    height_unit: float | None = None
    """Metres upwards in the unit of Z that the file states, converted like X and Y; None: it states no height system,
    and Z is as in the file."""

    def in_metres(self) -> OrientationTable:
        """The table with X and Y in metres, and Z too if the file states its height system."""
        if self.crs is None:
            return self
        system = metric_system(self.crs, f"{self.file}: CRS")
        heights, rise = self.height_system, None
        if heights is not None:
            heights, rise = metric_heights(heights, f"{self.file}: heights")
        if (system.scale, rise or 1.0) == (1.0, 1.0):
            return replace(self, height_unit=rise)
        factors = np.array([system.scale, system.scale, rise or 1.0])
        units = "" if system.scale == 1.0 else f"X and Y in {unit_label(system.scale)}"
        units += "" if rise is None else f"{', ' if units else ''}heights in {unit_label(rise)}"
        X, Y, Z = (np.array([image.center for image in self.images]) * factors).T.tolist()
        images = tuple(replace(image, center=center) for image, center in zip(self.images, zip(X, Y, Z)))
        return replace(
            self,
            images=images,
            crs=system.crs,
            height_system=heights,
            notes=(*self.notes, f"{self.file.name}: {units}; converted to metres"),
            map_unit=system.scale,
            height_unit=rise,
        )

    def heights_in_metres(self, declared: str | None) -> OrientationTable:
        """The table with Z in metres, by the unit that the file states, else by that of a declared height system."""
        where = f"{self.file}: heights"
        word = (declared or "same").strip().casefold()
        system = None
        if word not in ("same", "ellipsoidal"):
            system = metric_heights(declared or "", "declared height system")[1]
        if self.height_unit is not None:
            if system is not None:
                agreed_metres(abs(self.height_unit), system, where, in_one_file=False)
            return self
        if system is None and self.map_unit == 1.0:
            return self
        rise = agreed_metres(None, system, where, in_one_file=False)
        if rise == 1.0:
            return self
        images = tuple(
            replace(image, center=(image.center[0], image.center[1], image.center[2] * rise)) for image in self.images
        )
        return replace(self, images=images, height_unit=rise)

    def __post_init__(self) -> None:
        if not self.images:
            raise InputError(f"{self.file}: holds no image")
        first: dict[str, OrientedImage] = {}
        for image in self.images:
            if image.name in first:
                lines = [str(i.line) for i in (first[image.name], image) if i.line is not None]
                where = f" (lines {' and '.join(lines)})" if lines else ""
                raise InputError(f"{self.file}: image {image.name!r} is given twice{where}; keep one of them")
            first[image.name] = image
            odd = odd_angles(image.angles, self.angle_unit, [ANGLE_NAMES[letter] for letter in self.rotation])
            if odd is None and self.crs is not None:
                odd = odd_place(image.center, camera=True)
            if odd is not None:
                line = f":{image.line}" if image.line is not None else ""
                raise InputError(f"{self.file}{line}: image {image.name!r}: {odd}")

    @property
    def cartesian(self) -> bool:
        """Return whether the poses are right in true metres, so that ground of the map needs `earth_curvature`
        strict."""
        return self.true_metres or self.origin is not None

    @cached_property
    def centers(self) -> Floats:
        """Projection centres, shape (n, 3)."""
        return np.array([i.center for i in self.images], float)

    @cached_property
    def rotations(self) -> Floats:
        """R_ground_camera of every image, shape (n, 3, 3), in the axes of the table's system."""
        angles = angle_in_radians(np.array([i.angles for i in self.images], float), self.angle_unit)
        R = rotation_from_angles(angles, self.rotation)
        return R if self.direction == "camera-to-ground" else np.swapaxes(R, 1, 2)

    def opk_degrees(self) -> Floats:
        """ω, φ, κ in degrees, shape (n, 3); numbers that are already so stay untouched."""
        if (self.angle_unit, self.rotation, self.direction) == ("deg", "opk", "camera-to-ground"):
            return np.array([i.angles for i in self.images], float)
        return degrees_of(self.rotations)


def posed(
    name: str, center: ArrayLike, R_ground_camera: Floats, camera: str | None = None, line: int | None = None
) -> OrientedImage:
    """An image whose rotation is given by a matrix (3, 3), with ω, φ, κ in degrees; `center` is X, Y, Z, metres."""
    X, Y, Z = np.asarray(center, float).tolist()
    omega, phi, kappa = degrees_of(R_ground_camera[None])[0].tolist()
    return OrientedImage(name=name, center=(X, Y, Z), angles=(omega, phi, kappa), camera=camera, line=line)


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
    """Sentence without a full stop: the property that is lost, and where to keep it."""


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
    """Direction of rotation matrices in a file that is written, if its format leaves that open; None for the usual
    one."""

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

    def angles(self, order: str, unit: str) -> Floats:
        """Angles of all images, shape (n, 3), for camera-to-ground matrices: in the sequence of `order`, in `unit`."""
        table = self.table
        if (table.angle_unit, table.rotation, table.direction) == (unit, order, "camera-to-ground"):
            # Numbers that are already so stay untouched.
            return np.array([i.angles for i in table.images], np.float64)
        angles = angle_in_unit(np.array([angles_from_rotation(R, order) for R in table.rotations], np.float64), unit)
        # Rounded below the noise of the conversion; adding zero turns −0.0 into 0.0.
        return np.asarray(np.round(angles, 12) + 0.0, np.float64)


@dataclass(frozen=True)
class OrientationFormat:
    """A file format for orientations; a new one is an instance of this, listed in `photoplan.io.formats.FORMATS`."""

    name: str
    """Name as users spell it."""
    title: str
    """Title as users know it."""
    sniff: Callable[[Path, str], bool]
    """Test of a file that may be of this format: its path and its first 64 KiB as text (line ends are newlines, bytes
    that are not UTF-8 are replaced; empty for a folder). If two formats claim one file, the user is asked; a format
    without any mark of its own claims none and has to be stated. A file that no format claims is read as a table of
    text."""
    read: Callable[[Path, TableFormat], OrientationBlock]
    """Function that reads a file; `TableFormat` counts only if the format leaves conventions open. Raises
    InputError."""
    render: Callable[[OrientationBlock, Path], Mapping[Path, str]] | None = None
    """Text of all files to be written under a path that the user gave (a folder for formats of several files); writes
    nothing itself. Raises InputError where something that the format needs is not known. None: read only."""
    losses: Callable[[OrientationBlock], Iterable[Loss]] = lambda block: ()
    """Function that returns the properties of a block that the format cannot hold."""
    suffix: str = ".txt"
    """Suffix of a file that the user gives no name; empty for a folder."""
    angles: bool = False
    """True if files hold three angles that could mean something else than they are taken for."""


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

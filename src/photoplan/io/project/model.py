"""The project file: cameras, images, orientation, terrain, and their limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Discriminator, Field, PrivateAttr, Strict, Tag, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from photoplan.arrays import Floats
from photoplan.cameras.fiducials import Affine2D, FiducialFit
from photoplan.cameras.lenses import Interior, Lens
from photoplan.errors import InputError, UsageError
from photoplan.geometry.bounds import area_fault, bounds_fault, odd_angles, odd_place
from photoplan.geometry.frames import CylinderFrame, ImageFrame, WallFrame
from photoplan.geometry.pose import ANGLE_UNITS
from photoplan.io.camera.line import line_files
from photoplan.io.camera.model import (
    Camera,
    CameraEntry,
    Entry,
    Fiducials,
    Name,
    NotNegative,
    Number,
    Pair,
    Pixels,
    Positive,
    Restoration,
    Restore,
    Triple,
)
from photoplan.io.files import check_input_name, resolve_input, unique_stems

Deviation = tuple[str, Floats]
"""An error's name, and what it changes of the numbers that state a geometry."""

InputName = Annotated[str, Field(max_length=4000)]


class ImageEntry(Entry, ABC):
    """An image, of whatever geometry.

    A kind of geometry is a file of its own with a subclass, a line in `photoplan.io.project.model` and one in
    `photoplan.project.cameras`.
    """

    name: Name
    """Products are called after it."""
    file: InputName
    size: tuple[Pixels, Pixels] | None = None
    """Width and height of this image, where nothing else states them."""
    alpha: Annotated[bool, Strict()] | None = None
    """True if bands tagged as alpha are masks, false if they are colours; None if their values decide."""
    restore: Restore | None = None
    """Filter that it is restored with before anything is made of it; None: that of its camera, if there is one."""
    balance: InputName | None = None
    """Balance file by which its grey values agree with those of other images, after all else; None: they stay."""

    @field_validator("file", "balance")
    @classmethod
    def _file(cls, text: str | None) -> str | None:
        return None if text is None else plain_file(text)

    @property
    @abstractmethod
    def geometry_file(self) -> str | None:
        """File that its geometry is read from, beside that of its pixels; None: there is none."""

    def geometry_files(self, resolve: Callable[[str], Path]) -> list[Path]:
        """All files that its geometry is read from, beside that of its pixels; `resolve` finds what entries name."""
        return [] if self.geometry_file is None else [resolve(self.geometry_file)]

    @property
    def unoriented(self) -> str | None:
        """Return why products leave the image out; None if it is oriented."""
        return None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return remarks on its geometry, a clause each."""
        return ()

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """Independent errors of its geometry, each one standard deviation large."""
        raise InputError(f"image {self.name!r}: its kind of geometry states no accuracy that a raster could be made of")

    def moved(self, change: Floats, cameras: Mapping[str, CameraEntry]) -> tuple[ImageEntry, Mapping[str, CameraEntry]]:
        """It and the cameras with its geometry changed by a part of one of its `deviations`."""
        raise NotImplementedError

    @property
    @abstractmethod
    def described_by(self) -> str | None:
        """Name of the [cameras.NAME] table that it needs; None: it needs none."""


def plain_file(text: str) -> str:
    """A name of a file as an entry states it; raises ValueError where no file can have it."""
    try:
        return check_input_name(text)
    except InputError as error:
        raise ValueError(str(error)) from None


class FrameImage(ImageEntry):
    """One image of a frame camera, whose interior and exterior orientation a file states."""

    frame: InputName
    """File of camera and orientation."""

    @field_validator("frame")
    @classmethod
    def _frame(cls, text: str) -> str:
        return plain_file(text)

    @property
    def geometry_file(self) -> str:
        """That file."""
        return self.frame

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None


class LineImage(ImageEntry):
    """One image of a line camera, whose trajectory and directions a file states."""

    line: InputName
    """File of the line camera."""
    detectors: Name | None = None
    """Name of the line of detectors, if the file has several."""
    correction: InputName | None = None
    """File of corrections of its trajectory, as `photoplan adjust` writes them."""
    mount: Name | None = None
    """Images of one mount share boresight, lever arm and clock in an adjustment; None: those of one file do."""

    _change: tuple[float, ...] = PrivateAttr(default=())

    @field_validator("line", "correction")
    @classmethod
    def _line(cls, text: str | None) -> str | None:
        return None if text is None else plain_file(text)

    @property
    def geometry_file(self) -> str:
        """The file of the line camera."""
        return self.line

    def geometry_files(self, resolve: Callable[[str], Path]) -> list[Path]:
        """That file, the record of the flight beside it, and the corrections."""
        correction = [] if self.correction is None else [resolve(self.correction)]
        return [*line_files(resolve(self.line)), *correction]

    @property
    def remarks(self) -> tuple[str, ...]:
        """Its correction."""
        return () if self.correction is None else (f"trajectory is corrected by {self.correction}",)

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """See `ImageEntry.deviations`: six parts of what its correction says of the trajectory's poses."""
        if self.correction is None:
            raise InputError(
                f"image {self.name!r}: nothing is known of the accuracy of its trajectory; `photoplan adjust` writes "
                "it into the file of its `correction`, as [accuracy]"
            )
        return tuple(("trajectory", row) for row in np.eye(6))

    def moved(self, change: Floats, cameras: Mapping[str, CameraEntry]) -> tuple[LineImage, Mapping[str, CameraEntry]]:
        """See `ImageEntry.moved`; on a flight without tremor, which makes no difference to errors."""
        image = self.model_copy()
        image._change = tuple(change.tolist())
        return image, cameras

    @property
    def change(self) -> tuple[float, ...]:
        """Parts of the errors of its trajectory by which it is moved; empty: it is as it is."""
        return self._change

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None


#: What `rpc` says if the image file holds them itself.
TAGS = "tags"

#: Standard deviations of shift (pixels) and drift (pixels per pixel) beyond which nothing is known of an image.
_MOST_DEVIATION = (1e6, 1e6, 1.0, 1.0, 1.0, 1.0)


class RpcImage(ImageEntry):
    """One image whose geometry a file of rational polynomials states, or the image file itself."""

    rpc: InputName
    """``tags``: the image file holds them; else the file that does."""
    shift: Pair | None = None
    """Shift that is added to the polynomials' column and row, pixels."""
    scale: Positive | None = None
    """Pixels of the image file for one of the polynomials, before the shift; None: one, and sizes are compared."""
    drift: tuple[Number, Number, Number, Number] | None = None
    """Drift that is added to the shift: to the column by column and row, to the row by column and row, per pixel."""
    covariance: Annotated[tuple[Number, ...], Field(max_length=21)] | None = None
    """Covariances of shift and drift: the lower triangle by rows, of two or six numbers; pixels and pixels per
    pixel."""

    @field_validator("rpc")
    @classmethod
    def _rpc(cls, text: str) -> str:
        return plain_file(text)

    @field_validator("covariance")
    @classmethod
    def _covariance(cls, values: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if values is not None and len(values) not in (3, 21):
            raise ValueError(f"covariance of {len(values)} numbers; 3 of shift, or 21 of shift and drift are needed")
        if values is not None and min(values[0], values[2]) < 0:
            raise ValueError("covariance with a variance below 0; it is the lower triangle by rows")
        return values

    @property
    def geometry_file(self) -> str | None:
        """The file of polynomials; None: the image file holds them."""
        return None if self.rpc == TAGS else self.rpc

    @property
    def described_by(self) -> None:
        """It needs no camera."""
        return None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Its correction."""
        scaled = () if self.scale in (None, 1.0) else (f"polynomials are scaled by {self.scale:g}",)
        if self.shift is None:
            return scaled
        known = "accuracy not stated"
        if self.covariance is not None:
            known = f"± {self.covariance[0] ** 0.5:.2g}, {self.covariance[2] ** 0.5:.2g} px"
        x, y = self.shift
        return (*scaled, f"polynomials are corrected by {x:+.2f}, {y:+.2f} px ({known})")

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """See `ImageEntry.deviations`: of shift and drift."""
        if self.covariance is None:
            raise InputError(
                f"image {self.name!r}: nothing is known of the accuracy of its polynomials; `photoplan adjust` writes "
                "their covariance, or state it in [[images]]: covariance = [VARIANCE OF COLUMN, 0, VARIANCE OF ROW]"
            )
        size = 2 if len(self.covariance) == 3 else 6
        C = np.zeros((size, size))
        C[np.tril_indices(size)] = self.covariance
        scale = np.sqrt(np.maximum(np.diag(C), 1e-300))
        odd = scale > np.array(_MOST_DEVIATION)[:size]
        if odd.any():
            raise InputError(
                f"image {self.name!r}: covariance says ± {scale[odd][0]:.3g} {'px' if odd[:2].any() else 'px per px'}: "
                "that is no accuracy; is it that of its polynomials?"
            )
        values, axes = np.linalg.eigh((np.tril(C) + np.tril(C, -1).T) / np.outer(scale, scale))
        if values[0] < -1e-3:
            raise InputError(f"image {self.name!r}: covariance is none; `photoplan adjust` writes it")
        return tuple(("polynomials", a * scale * np.sqrt(max(v, 0.0))) for v, a in zip(values, axes.T))

    def moved(self, change: Floats, cameras: Mapping[str, CameraEntry]) -> tuple[RpcImage, Mapping[str, CameraEntry]]:
        """See `ImageEntry.moved`."""
        x, y, *rest = (
            change + np.array([*(self.shift or (0.0, 0.0)), *(self.drift or (0.0,) * 4)])[: len(change)]
        ).tolist()
        return self.model_copy(update={"shift": (x, y)} | ({"drift": tuple(rest)} if rest else {})), cameras

    @property
    def correction(self) -> Affine2D | None:
        """From the polynomials' positions to those in the image; None: they are equal."""
        if self.shift is None and self.drift is None:
            return None
        (x, y), (xx, xy, yx, yy) = self.shift or (0.0, 0.0), self.drift or (0.0, 0.0, 0.0, 0.0)
        return Affine2D(a1=1.0 + xx, a2=xy, a3=x, a4=yx, a5=1.0 + yy, a6=y)


#: Metres (or units of an angle or a camera's parameter) beyond which a standard deviation says nothing.
_MOST_DEVIATION_POSED = 1e6
_ANGLES = {"o": "omega", "p": "phi", "k": "kappa"}

Correlation = tuple[Annotated[float, Strict(), Field(ge=-1, le=1)], ...]


def turned_angles(angles: Sequence[float], unit: str, order: str) -> Triple:
    """Return angles of a camera system that is turned by half a circle about its x axis, within half a circle.

    Half a turn about x adds to ω, and reverses the sense of the rotations between ω and the camera.
    """
    half = ANGLE_UNITS[unit] / 2
    turned = [round(sign * angle, 12) + 0.0 for sign, angle in zip(_senses(order), angles)]
    at = order.index("o")
    turned[at] = round(angles[at] - half if angles[at] > 0 else angles[at] + half, 12) + 0.0
    return (turned[0], turned[1], turned[2])


def _senses(order: str) -> list[float]:
    """Return −1 for each angle whose sense half a turn of the camera about x reverses, else 1."""
    return [-1.0 if k > order.index("o") else 1.0 for k in range(3)]


def turned_correlation(correlation: Sequence[float], order: str, camera: CameraEntry) -> tuple[float, ...]:
    """Return the correlations after `turned_angles`: those of reversed angles and of what is odd in x change sign."""
    signs = [1.0, 1.0, 1.0, *_senses(order)]
    signs += [-1.0 if name in camera.odd_in_x else 1.0 for name in camera.sigma or {}]
    size = int((1 + np.sqrt(1 + 8 * len(correlation))) / 2)
    if size > len(signs):
        raise InputError(f"correlation has {len(correlation)} numbers, more than orientation and camera have")
    pairs = zip(*np.tril_indices(size, -1))
    return tuple(float(r * signs[i] * signs[j]) for r, (i, j) in zip(correlation, pairs))


class Image(ImageEntry):
    """One image with a pose: oriented, or to be oriented."""

    camera: Name
    center: Triple | None = None
    """Projection centre X0, Y0, Z0 in the project's CRS and the orientation's height system, metres; None: the image
    is not oriented yet."""
    angles: Triple | None = None
    """Three angles in the sequence and unit that [orientation] states."""
    sigma_center: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """Standard deviations of the projection centre, metres, as `photoplan adjust` and `resect` found them."""
    sigma_angles: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """Standard deviations of the angles, in their unit."""
    correlation: Correlation | None = None
    """The correlation matrix of centre, angles and, after a calibration, what `sigma` of the camera lists, below its
    diagonal, row by row; None: they are not correlated."""
    approximate: Annotated[bool, Strict()] | None = None
    """True if center and angles are initial values that `photoplan adjust` could not improve: products leave the image
    out."""
    fiducials: Fiducials | None = None
    """Measured fiducial marks of a film scan: name = [column, row], pixels."""

    @model_validator(mode="after")
    def _both(self) -> Self:
        if (self.center is None) != (self.angles is None):
            raise ValueError("center and angles go together: give both, or none for an image that is not oriented")
        if self.correlation is not None and (self.sigma_center is None or self.sigma_angles is None):
            raise ValueError("correlation goes with sigma_center and sigma_angles")
        return self

    @property
    def geometry_file(self) -> None:
        """Its geometry stands in the project."""
        return None

    @property
    def described_by(self) -> str:
        """Its camera."""
        return self.camera

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """See `ImageEntry.deviations`: of centre, angles and camera."""
        if self.sigma_center is None or self.sigma_angles is None:
            raise InputError(
                f"image {self.name!r}: nothing is known of the accuracy of its orientation; `photoplan adjust` and "
                "`resect` write sigma_center and sigma_angles, or state them in [[images]]"
            )
        of_camera = cameras[self.camera].sigma or {}
        sigma = np.array([*self.sigma_center, *self.sigma_angles, *of_camera.values()])
        if sigma.max() > _MOST_DEVIATION_POSED:
            raise InputError(
                f"image {self.name!r}: a standard deviation of {sigma.max():.3g} in orientation or camera is no "
                "accuracy"
            )
        names = ["X0", "Y0", "Z0", *(_ANGLES[letter] for letter in rotation), *(f"camera {name}" for name in of_camera)]
        R, joined = self._correlations(len(of_camera))
        values, axes = np.linalg.eigh(R)
        if joined and values[0] < -1e-3:
            raise InputError(f"image {self.name!r}: correlation is that of no covariance; `photoplan adjust` writes it")
        together = "orientation" if joined <= 6 else "orientation and camera"
        largest = np.abs(axes).argmax(axis=0)
        return tuple(
            (together if k < joined else names[k], axis * np.sqrt(max(value, 0.0)) * sigma)
            for k, value, axis in zip(largest.tolist(), values, axes.T)
        )

    def _correlations(self, of_camera: int) -> tuple[Floats, int]:
        """Correlation matrix of centre, angles and so many parameters of the camera; how many first ones it states."""
        size, given = 6 + of_camera, np.array(self.correlation or (), float)
        joined = {0: 0, 15: 6, size * (size - 1) // 2: size}.get(len(given))
        if joined is None:
            raise InputError(
                f"image {self.name!r}: correlation has {len(given)} numbers; 15 for centre and angles, or "
                f"{size * (size - 1) // 2} for them and the {of_camera} parameters of its camera"
            )
        R = np.eye(size)
        R[:joined, :joined][np.tril_indices(joined, -1)] = given
        return np.tril(R) + np.tril(R, -1).T, joined

    def moved(self, change: Floats, cameras: Mapping[str, CameraEntry]) -> tuple[Image, Mapping[str, CameraEntry]]:
        """See `ImageEntry.moved`."""
        camera = cameras[self.camera]
        center, angles = (np.array(part) for part in self.pose_numbers)
        update = {"center": tuple(center + change[:3]), "angles": tuple(angles + change[3:6])}
        by_name = dict(zip(camera.sigma or {}, change[6:].tolist()))
        return self.model_copy(update=update), {**cameras, self.camera: camera.moved(by_name, self.camera)}

    def scene_turned(self, unit: str, order: str, camera: CameraEntry) -> Image:
        """Return the image with its angles for a scene on the other side of the image, see `turned_angles`."""
        update: dict[str, object] = {}
        if self.angles is not None:
            update["angles"] = turned_angles(self.angles, unit, order)
        if self.correlation:
            update["correlation"] = turned_correlation(self.correlation, order, camera)
        return self.model_copy(update=update) if update else self

    @property
    def unoriented(self) -> str | None:
        """See `ImageEntry`."""
        if self.center is None:
            return "has no orientation; `photoplan resect` or `photoplan adjust` determines it"
        return "its orientation is approximate: `photoplan adjust` could not determine it" if self.approximate else None

    @property
    def pose_numbers(self) -> tuple[Triple, Triple]:
        """Projection centre and angles as stated."""
        if self.center is None or self.angles is None:
            raise InputError(f"image {self.name!r} {self.unoriented}")
        return self.center, self.angles


#: The entry that only images of a kind have; an image without any of them has a pose.
_BY_ENTRY: dict[str, type[ImageEntry]] = {"rpc": RpcImage, "line": LineImage, "frame": FrameImage}


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return next((kind.__name__ for entry, kind in _BY_ENTRY.items() if entry in value), Image.__name__)
    return type(value).__name__


AnyImage = Annotated[
    Annotated[Image, Tag("Image")]
    | Annotated[RpcImage, Tag("RpcImage")]
    | Annotated[LineImage, Tag("LineImage")]
    | Annotated[FrameImage, Tag("FrameImage")],
    Discriminator(_kind),
]


def image_size(camera: CameraEntry, image: Image) -> tuple[int, int]:
    """Width and height of an image as the project states it."""
    size = image.size or camera.size
    if size is None:
        raise InputError(f"image {image.name!r}: its size is stated neither with the image nor with its camera")
    return size


def fiducial_fit(camera: CameraEntry, image: Image, model: str | None = None) -> FiducialFit:
    """Adjustment of an image's fiducial marks; see `photoplan.io.camera.model.FiducialSystem.fit`."""
    system = camera.fiducial_system
    if system is None:
        raise InputError(f"image {image.name!r}: its camera has no fiducial marks")
    try:
        return system.fit(image.fiducials, model)
    except InputError as error:
        raise type(error)(f"image {image.name!r}: {error}") from None


def interior_of(camera: CameraEntry, image: Image, size: tuple[int, int] | None = None) -> Interior:
    """Interior orientation of an image."""
    size = size or image_size(camera, image)
    try:
        return camera.interior_orientation(size, image.fiducials)
    except InputError as error:
        raise type(error)(f"image {image.name!r}: {error}") from None


def lens_of(camera: CameraEntry) -> Lens:
    """Lens of a camera; raises InputError where the coefficients cannot be a lens's."""
    return camera.lens.made(camera)


class StatedTerrain(Entry):
    """Terrain of a project: a raster of heights, a terrain model, or one height everywhere."""

    file: InputName | None = None
    height: Number | None = None
    crs: Name | None = None
    """CRS of a file that does not state one, such as an ASCII grid."""
    height_system: Name | None = None
    sigma: NotNegative | InputName | None = None
    """Standard deviation of the heights, metres, where the file states none; or a raster of them."""

    @field_validator("height")
    @classmethod
    def _is_height(cls, value: float | None) -> float | None:
        odd = None if value is None else odd_place((0.0, 0.0, value), camera=True)
        if odd is not None:
            raise ValueError(odd)
        return value

    @field_validator("file", "sigma")
    @classmethod
    def _file(cls, text: str | float | None) -> str | float | None:
        return plain_file(text) if isinstance(text, str) else text

    @property
    def files(self) -> list[str]:
        """Names of all files that it states."""
        return [file for file in (self.file, self.sigma) if isinstance(file, str)]

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.file is None) == (self.height is None):
            raise ValueError("give either file (heights: a raster or a terrain model) or height (one everywhere)")
        return self


class Objects(Entry):
    """A file of objects on the terrain: houses, bridges, walls, trees."""

    file: InputName
    """CityJSON; polygons in space as GeoPackage, GeoJSON, Shapefile or DXF; meshes as OBJ or PLY."""
    role: Literal["paint", "occluder"] | None = None
    """True if a true orthophoto shows them, false if they only hide what is behind them; None for what the file states,
    else meshes hide and all others are shown."""
    layer: Name | None = None
    """Type of CityJSON's objects, if not buildings and bridges; layer of a vector file or a drawing."""
    crs: Name | None = None
    """Horizontal CRS, where the file does not state it."""
    height_system: Name | None = None
    """Height system of a file that does not state it; "same" for that of the terrain."""
    offset: Triple | None = None
    """Vector that is added to X, Y, Z of the file, metres, for meshes with an origin of their own."""
    sigma: tuple[NotNegative, NotNegative] | None = None
    """Standard deviations of each horizontal coordinate and of the height of an object as a whole, metres."""

    @field_validator("file")
    @classmethod
    def _file(cls, text: str) -> str:
        return plain_file(text)


Bounds = tuple[Number, Number, Number, Number]


class StatedTarget(Entry):
    """A wall, vault, column or image that products lie on instead of the map."""

    frame: Annotated[str, Field(min_length=1, max_length=4000)]
    """`wall:…`, `vault:…`, `column:…` or `image:…`, as the option `target` takes it."""
    relief: Number | InputName = 0.0
    """Offset of the surface from the frame along its normal, metres, or a raster of offsets by `photoplan surface`."""
    sigma: NotNegative | InputName | None = None
    """Standard deviation of the offsets, metres, or a raster of them; None: unknown."""
    bounds: Bounds | None = None
    """Lowest u, v and highest u, v, metres; None for those of the relief or of the image."""

    @field_validator("relief", "sigma")
    @classmethod
    def _file(cls, text: str | float | None) -> str | float | None:
        return plain_file(text) if isinstance(text, str) else text

    @property
    def files(self) -> list[str]:
        """Names of all files that it states."""
        return [file for file in (self.relief, self.sigma) if isinstance(file, str)]


def _frame_kind(frame: Any) -> str:
    """Return the kind of a target's frame, whether it is a value or comes from a file."""
    names = frame if isinstance(frame, dict) else vars(frame)
    return "image" if "distance" in names else "cylinder" if "radius" in names else "wall"


class PlacedTarget(StatedTarget):
    """A target with its frame as numbers, in the height system of the cameras: what a worker needs of it."""

    space: Annotated[
        Annotated[WallFrame, Tag("wall")]
        | Annotated[ImageFrame, Tag("image")]
        | Annotated[CylinderFrame, Tag("cylinder")],
        Discriminator(_frame_kind),
    ]
    """The frame."""
    bounds: Bounds
    """Lowest u, v and highest u, v of what products show, metres."""


class Orientation(Entry):
    """Meaning of the numbers of all [[images]]."""

    height_system: Name | None = None
    angle_unit: Literal["deg", "gon", "rad"] = "deg"
    rotation: Literal["opk", "pok", "kpo", "kop", "okp", "pko"] = "opk"
    scene: Literal["z < 0", "z > 0"] = "z < 0"
    """Side of the image on which the scene lies in the camera system of the stated numbers. ``z > 0`` (Ecker 1991,
    section 8.1): angles, and image coordinates in millimetres, are converted when the project is read."""
    earth_curvature: Literal["none", "correction", "strict"] = "none"
    refraction: Annotated[bool, Strict()] = False


class ObservationsEntry(Entry):
    """Files of measurements that determine orientations, and their accuracy where the files do not state it."""

    image_points: tuple[InputName, ...] = ()
    """Measured image points: point, image, column, row."""
    control: tuple[InputName, ...] = ()
    """Ground points, control and check."""
    image_points_columns: InputName | None = None
    """Columns of tables of image points in their order, as ``point,image,-,x,y``; None: as their headers say."""
    control_columns: InputName | None = None
    """Columns of tables of ground points, as ``name,-,x,y,z`` in their order or ``name=Nr,x=East,y=North,z=H``."""
    decimal_comma: Annotated[bool, Strict()] | None = None
    """True if tables of image and ground points write numbers as 1,5."""
    positions: InputName | None = None
    """Table of observed projection centres, with or without attitudes."""
    sigma_image: Positive = 0.5
    """Standard deviation of an image coordinate, pixels."""
    sigma_control: tuple[NotNegative, NotNegative] | None = None
    """Standard deviation of control: each horizontal coordinate, height, metres."""
    sigma_position: tuple[Positive, Positive] | None = None
    """Standard deviation of observed positions: each horizontal coordinate, height, metres."""
    sigma_attitude: Positive | None = None
    """Standard deviation of observed attitudes, in the unit of [orientation]; None: attitudes are not observations."""

    @field_validator("image_points", "control")
    @classmethod
    def _files(cls, files: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(plain_file(text) for text in files)

    @field_validator("positions")
    @classmethod
    def _positions(cls, text: str | None) -> str | None:
        return None if text is None else plain_file(text)


Parameter = Literal["c", "x0", "y0", "k1", "k2", "k3", "p1", "p2", "b1", "b2"]


class RpcAdjustment(Entry):
    """Unknowns of images with rational polynomials."""

    correction: Literal["shift", "drift", "affine"] = "shift"
    """A shift; a shift and what changes by row; or all six parameters of an affine correction."""
    sigma: tuple[Positive, Positive] = (10.0, 2.0)
    """Standard deviations a priori: of the shift, and of what changes until the border, pixels."""


class StripAdjustment(Entry):
    """Unknowns of trajectories of line cameras, as standard deviations a priori; 0 holds them fixed."""

    boresight: NotNegative = 0.0
    """About each axis of the camera, degrees."""
    lever_arm: NotNegative = 0.0
    """Along each axis, metres."""
    time_offset: NotNegative = 0.0
    """Seconds."""
    knots: Positive | None = None
    """Seconds between knots of corrections that change with time; None: there are none."""
    position: Positive = 0.05
    """Standard deviation of corrections of the positions, metres."""
    attitude: Positive = 0.005
    """Standard deviation of corrections of the attitudes, degrees."""
    smooth_position: Positive | None = None
    """Standard deviation of their second differences from knot to knot, metres; None if they need not be smooth."""
    smooth_attitude: Positive | None = None
    """The same of the attitudes, degrees."""


class Adjustment(Entry):
    """Unknowns of `photoplan adjust` besides orientations and points; options of the command override them."""

    calibrate: dict[Name, tuple[Parameter, ...]] = Field(default_factory=dict)
    """Parameters of each camera that are unknowns."""
    prior_sigma: dict[Name, dict[Parameter, Positive]] = Field(default_factory=dict)
    """Standard deviations with which parameters are known beforehand, by camera."""
    lever_arm: Triple = (0.0, 0.0, 0.0)
    """Antenna minus projection centre in camera axes (x right, y up, z towards the viewer), metres."""
    lever_arm_sigma: NotNegative = 0.0
    """Its standard deviation, metres; 0: it is held fixed."""
    datum: Literal["observations", "orientations"] = "observations"
    """Datum of the block: control and observed positions, or the orientations that the project states."""
    drift: Literal["none", "shift", "linear"] = "none"
    """Drift of observed positions in each strip: none, a shift, or a shift and a change linear in time."""
    boresight: Annotated[bool, Strict()] = False
    """True if three small rotations between the observed attitudes and the camera are unknowns."""
    rpc: RpcAdjustment = RpcAdjustment()
    strips: StripAdjustment = StripAdjustment()


class OrthoDefaults(Entry):
    """Defaults of `photoplan ortho`; options of the command override them."""

    resolution: Positive | None = None
    bounds: tuple[Number, Number, Number, Number] | None = None
    kernel: Name | None = None
    tolerance: Positive | None = None
    true: Annotated[bool, Strict()] | None = None
    hidden: Literal["show", "nodata", "mark"] | None = None
    nodata: Number | Literal["auto", "mask"] | None = None
    compress: Name | None = None
    overviews: Annotated[bool, Strict()] | None = None

    @field_validator("bounds")
    @classmethod
    def _bounds(cls, b: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if b is not None and (fault := bounds_fault(b)) is not None:
            raise ValueError(fault)
        return b


class Project(Entry):
    """All inputs of a block of images, checked against each other."""

    format: Literal[1] = 1
    crs: Annotated[str, Field(min_length=1, max_length=20_000)]
    beyond_area: Annotated[bool, Strict()] = False
    """True if places far outside the area of use of the CRS are meant; they are refused otherwise."""
    terrain: StatedTerrain | None = None
    objects: tuple[Objects, ...] = ()
    orientation: Orientation = Orientation()
    observations: ObservationsEntry = ObservationsEntry()
    adjustment: Adjustment = Adjustment()
    cameras: dict[Name, Camera] = Field(default_factory=dict)
    images: tuple[AnyImage, ...]
    ortho: OrthoDefaults = OrthoDefaults()
    targets: dict[Name, StatedTarget] = Field(default_factory=dict)
    """Walls, vaults, columns and images that products can lie on, by their names."""
    target: SkipJsonSchema[PlacedTarget | None] = None
    """The target on which the products at hand lie; None for the map. A project file does not state it."""
    defaults: dict[Name, dict[Name, Any]] = Field(default_factory=dict)
    """Options of commands, by the command's name, that hold unless others are given."""
    folder: SkipJsonSchema[Path] = Field(default=Path(), exclude=True)
    """Folder of the project file, from which relative paths start; not an entry of the file."""
    _unusable: dict[str, str] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.images:
            raise ValueError("no [[images]] entry; a project needs at least one image")
        names: set[str] = set()
        for number, image in enumerate(self.images, 1):
            where = f"image {image.name!r} (entry {number})"
            if image.name in names:
                raise ValueError(f"{where}: the name is given twice")
            names.add(image.name)
            if isinstance(image, Image):
                self._check_posed(image, where)
        if "map" in self.targets:
            raise ValueError("[targets.map]: `map` is the map itself; give the target another name")
        unknown = [name for name in self.adjustment.calibrate if name not in self.cameras]
        if unknown:
            raise ValueError(f"[adjustment] calibrate: camera {unknown[0]!r} is not described")
        try:
            unique_stems(names)
        except InputError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def stems(self) -> dict[str, str]:
        """File stem of the products of every image, by its name; no two are equal."""
        return unique_stems(image.name for image in self.images)

    def _check_posed(self, image: Image, where: str) -> None:
        """Refuse an image whose camera is not described, or whose marks or pose cannot be."""
        if image.camera not in self.cameras:
            known = ", ".join(map(repr, self.cameras)) or "none"
            raise ValueError(f"{where}: camera {image.camera!r} is not described; cameras are {known}")
        camera = self.cameras[image.camera]
        if image.fiducials is not None:
            try:
                camera.check_fiducials(image.fiducials, bool(image.size or camera.size), image.camera)
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from None
        if image.center is not None and image.angles is not None:
            odd = odd_angles(image.angles, self.orientation.angle_unit) or odd_place(image.center, camera=True)
            if odd is not None:
                raise ValueError(f"{where}: {odd}")

    def in_standard_axes(self) -> Self:
        """Return the project with the scene at z < 0: angles and millimetres of the image are converted."""
        if self.orientation.scene == "z < 0":
            return self
        unit, order = self.orientation.angle_unit, self.orientation.rotation
        return self.model_copy(
            update={
                "orientation": self.orientation.model_copy(update={"scene": "z < 0"}),
                "cameras": {name: camera.x_reversed() for name, camera in self.cameras.items()},
                "images": tuple(
                    image.scene_turned(unit, order, self.cameras[image.camera]) if isinstance(image, Image) else image
                    for image in self.images
                ),
            }
        )

    @property
    def ground(self) -> StatedTerrain:
        """The [terrain] entry."""
        if self.terrain is None:
            raise InputError("the project states no [terrain]; give file or height there")
        return self.terrain

    @property
    def plane_crs(self) -> str | None:
        """The CRS of the plane that products lie in; None on a target, whose plane has none."""
        return self.crs if self.target is None else None

    def area_fault(self, XY: ArrayLike, names: Sequence[str] = ()) -> str | None:
        """Return why places (n, 2 or more columns) cannot be in the project's CRS; None if they can, or are meant to
        be."""
        return None if self.beyond_area else area_fault(self.crs, XY, names)

    def resolve(self, file: str) -> Path:
        """Absolute path of an entry `file`, relative ones from the project's folder."""
        return resolve_input(self.folder, file)

    def select(self, patterns: Sequence[str] | None = None) -> list[str]:
        """Names of the images that match one of `patterns` (``*`` and ``?`` allowed), in the project's order."""
        names = [image.name for image in self.images]
        if patterns is None:
            return names
        chosen: set[str] = set()
        for pattern in (patterns,) if isinstance(patterns, str) else patterns:
            found = [n for n in names if n == pattern or fnmatchcase(n, pattern)]
            if not found:
                raise UsageError(
                    f"image {pattern!r} is not in the project; "
                    f"its {len(names)} images begin with {', '.join(names[:5])}"
                )
            chosen.update(found)
        return [n for n in names if n in chosen]

    def leaving_out(self, reasons: Mapping[str, str]) -> Self:
        """Return the project with images that `oriented` lists with these reasons, as their files cannot be used."""
        project = self.model_copy()
        project._unusable = {**self._unusable, **reasons}
        return project

    @property
    def unusable(self) -> Mapping[str, str]:
        """Images that `leaving_out` names, with the reasons."""
        return self._unusable

    def oriented(self, names: Sequence[str], approximate: bool = False) -> tuple[list[str], list[str]]:
        """The oriented ones of some images, and a line for each of the others; `approximate` ones count if asked for.

        Images that `leaving_out` names are listed among the others.
        """
        reasons = {name: self.any_image(name).unoriented for name in names}
        if approximate:
            reasons |= {i.name: None for i in self.posed if i.name in reasons and i.center is not None}
        reasons |= {name: reason for name, reason in self._unusable.items() if name in reasons}
        left_out = [f"{name}: {reason}" for name, reason in reasons.items() if reason is not None]
        if len(left_out) == len(names) > 0:
            others = f" (nor has any other of {len(names)} images)" if len(names) > 1 else ""
            raise InputError(f"image {left_out[0]}{others}")
        return [name for name in names if reasons[name] is None], left_out

    def restoration(self, image: ImageEntry) -> Restoration | None:
        """Return how an image of the project is restored: as it states itself, else as its camera does; None if it is
        not."""
        camera = image.described_by
        return image.restore or (None if camera is None else self.cameras[camera].restore)

    def ortho_settings(self) -> dict[str, Any]:
        """Return the values of the `[ortho]` table, by the names of
        `photoplan.products.orthophoto.plan.OrthoSettings`."""
        stated = self.ortho.model_dump(exclude_none=True)
        if "nodata" in stated:
            stated["nodata"] = str(stated["nodata"])
        return stated

    @property
    def posed(self) -> tuple[Image, ...]:
        """The images with a camera and a pose of their own, known or to be determined."""
        return tuple(image for image in self.images if isinstance(image, Image))

    @property
    def height_system(self) -> str | None:
        """Height system of all geometry: the orientation's. Rational polynomials alone need none: it is ellipsoidal."""
        return self.orientation.height_system or (None if self.posed else "ellipsoidal")

    def alone(self, names: Sequence[str]) -> Self:
        """The project with these images only, and the cameras that they need."""
        images = tuple(self.any_image(name) for name in names)
        cameras = {image.described_by: self.cameras[image.described_by] for image in images if image.described_by}
        return self.model_copy(update={"images": images, "cameras": cameras})

    def image(self, name: str) -> Image:
        """The image of this name, which has a camera and a pose."""
        image = self.any_image(name)
        if not isinstance(image, Image):
            raise InputError(
                f"image {name!r} has no pose, its geometry is in a file; this is done with frame images alone"
            )
        return image

    def any_image(self, name: str) -> AnyImage:
        """The image of this name, whatever its geometry."""
        for image in self.images:
            if image.name == name:
                return image
        raise InputError(
            f"image {name!r} is not in the project; its {len(self.images)} images begin with "
            f"{', '.join(i.name for i in self.images[:5])}"
        )

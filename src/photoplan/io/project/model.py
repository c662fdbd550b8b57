"""What a project file says, as checked and frozen values. Files are read and written in `photoplan.io.project.file`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from numpy.typing import ArrayLike
from pydantic import Field, PrivateAttr, Strict, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from photoplan.errors import InputError, UsageError
from photoplan.geometry.bounds import area_fault, bounds_fault, odd_angles, odd_place
from photoplan.io.camera.kinds import Camera
from photoplan.io.camera.model import Entry, Name, NotNegative, Number, Positive, Restoration, Triple
from photoplan.io.names import resolve_input, unique_stems
from photoplan.io.project.image import ImageEntry, InputName, plain_file
from photoplan.io.project.kinds import AnyImage
from photoplan.io.project.posed import Image


class StatedTerrain(Entry):
    """Where the ground is: a raster of heights, a terrain model, or one height everywhere."""

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
    """Whether a true orthophoto shows them, or they only hide what is behind them; None: what the file says, else
    meshes hide and all others are shown."""
    layer: Name | None = None
    """Type of CityJSON's objects, if not buildings and bridges; layer of a vector file or a drawing."""
    crs: Name | None = None
    """Horizontal CRS, where the file does not state it."""
    height_system: Name | None = None
    """Where the file does not state it; "same": that of the terrain."""
    offset: Triple | None = None
    """What is added to X, Y, Z of the file, metres: of meshes with an origin of their own."""
    sigma: tuple[NotNegative, NotNegative] | None = None
    """Standard deviations of each horizontal coordinate and of the height of an object as a whole, metres."""

    @field_validator("file")
    @classmethod
    def _file(cls, text: str) -> str:
        return plain_file(text)


class Orientation(Entry):
    """What the numbers of all [[images]] mean."""

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
    """Whether tables of image and ground points write numbers as 1,5."""
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
    """What is unknown of images with rational polynomials."""

    correction: Literal["shift", "drift", "affine"] = "shift"
    """A shift; a shift and what changes by row; or all six parameters of an affine correction."""
    sigma: tuple[Positive, Positive] = (10.0, 2.0)
    """What is known beforehand: standard deviation of the shift, and of what changes until the border, pixels."""


class StripAdjustment(Entry):
    """What is unknown of trajectories of line cameras, as standard deviations known beforehand; 0: held fixed."""

    boresight: NotNegative = 0.0
    """About each axis of the camera, degrees."""
    lever_arm: NotNegative = 0.0
    """Along each axis, metres."""
    time_offset: NotNegative = 0.0
    """Seconds."""
    knots: Positive | None = None
    """Seconds between knots of corrections that change with time; None: there are none."""
    position: Positive = 0.05
    """Of corrections of the positions, metres."""
    attitude: Positive = 0.005
    """Of corrections of the attitudes, degrees."""
    smooth_position: Positive | None = None
    """Of their second differences from knot to knot, metres; None: they are not known to be smooth."""
    smooth_attitude: Positive | None = None
    """The same of the attitudes, degrees."""


class Adjustment(Entry):
    """What `photoplan adjust` estimates besides orientations and points; options of the command override it."""

    calibrate: dict[Name, tuple[Parameter, ...]] = Field(default_factory=dict)
    """Parameters of each camera that are unknowns."""
    prior_sigma: dict[Name, dict[Parameter, Positive]] = Field(default_factory=dict)
    """Standard deviations with which parameters are known beforehand, by camera."""
    lever_arm: Triple = (0.0, 0.0, 0.0)
    """Antenna minus projection centre in camera axes (x right, y up, z towards the viewer), metres."""
    lever_arm_sigma: NotNegative = 0.0
    """Its standard deviation, metres; 0: it is held fixed."""
    datum: Literal["observations", "orientations"] = "observations"
    """What places the block: control and observed positions, or the orientations that the project states."""
    drift: Literal["none", "shift", "linear"] = "none"
    """Drift of observed positions in each strip: none, a shift, or a shift and a change linear in time."""
    boresight: Annotated[bool, Strict()] = False
    """Whether three small rotations between the observed attitudes and the camera are unknowns."""
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
    """Whether places far outside the area of use of the CRS are meant; they are refused otherwise."""
    terrain: StatedTerrain | None = None
    objects: tuple[Objects, ...] = ()
    orientation: Orientation = Orientation()
    observations: ObservationsEntry = ObservationsEntry()
    adjustment: Adjustment = Adjustment()
    cameras: dict[Name, Camera] = Field(default_factory=dict)
    images: tuple[AnyImage, ...]
    ortho: OrthoDefaults = OrthoDefaults()
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

    def area_fault(self, XY: ArrayLike, names: Sequence[str] = ()) -> str | None:
        """Why places (n, 2 or more columns) cannot be in the project's CRS; None if they can, or are meant to be."""
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
        """How an image of the project is restored: as it states itself, else as its camera does; None: not at all."""
        camera = image.described_by
        return image.restore or (None if camera is None else self.cameras[camera].restore)

    def ortho_settings(self) -> dict[str, Any]:
        """What the `[ortho]` table states, by the names of `photoplan.products.orthophoto.settings.OrthoSettings`."""
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

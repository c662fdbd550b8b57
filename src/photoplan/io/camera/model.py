"""Descriptions of cameras and lenses in project and camera files, as checked and frozen entries.

Each knows the lens or the interior orientation that computes. To add a kind of camera, derive it from `CameraEntry` and
add it to `Camera`; everything else asks the camera.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    Tag,
    field_validator,
    model_validator,
)

from photoplan.cameras.fiducials import MODELS, FiducialFit, fit_marks
from photoplan.cameras.lenses import Brown, Fisheye, Interior, Lens, NoLens, OpenCV, RadialTable, Reversed
from photoplan.cameras.marks import EachMark, Marks
from photoplan.errors import InputError
from photoplan.io.files import build, check_input_name

#: No length, angle or coefficient of a project is larger; products of several still are finite numbers.
LARGEST = 1e15
Number = Annotated[float, Strict(), Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=1000)]


Positive = Annotated[float, Strict(), Field(gt=0, le=LARGEST, allow_inf_nan=False)]
NotNegative = Annotated[float, Strict(), Field(ge=0, le=LARGEST, allow_inf_nan=False)]
Pixels = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
Fiducials = dict[Name, Pair]


class UnusableCamera(InputError):
    """A camera of a model that has no form here; only its images suffer."""


class Entry(BaseModel):
    """Base of every entry: unknown keys are errors, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class LensEntry(Entry, ABC):
    """A lens, of whatever kind."""

    type: str

    @property
    def needs(self) -> Literal["mm", "px"] | None:
        """Unit in which the camera must be stated for the coefficients to have a meaning; None: they are ratios."""
        return None

    @abstractmethod
    def made(self, camera: CameraEntry) -> Lens:
        """The lens that computes; raises InputError where the coefficients cannot be a lens's."""

    odd_in_x: ClassVar[frozenset[str]] = frozenset()
    """Coefficients that change their sign when x is counted the other way."""

    def x_reversed(self) -> Self:
        """Return the lens for image coordinates with the x axis reversed."""
        return self.model_copy(update={name: -getattr(self, name) + 0.0 for name in self.odd_in_x})


class IdealLens(LensEntry):
    """A lens without distortion."""

    type: Literal["none"] = "none"

    def made(self, camera: CameraEntry) -> Lens:
        """No distortion."""
        return NoLens()


class BrownLens(LensEntry):
    """Brown's lens: radial k1–k4, decentring p1–p2, affinity b1 and shear b2."""

    type: Literal["brown"]
    unit: Literal["tangent", "mm", "px"] = "tangent"
    """Unit of the coordinates that the coefficients multiply: divided by the camera constant, millimetres or pixels."""
    y_axis: Literal["up", "down"] = "up"
    """Direction of y where they were determined."""
    meaning: Literal["distortion", "correction"] = "distortion"
    """``distortion`` is added to ideal coordinates, ``correction`` to measured ones."""
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    b1: Number = 0.0
    b2: Number = 0.0
    k4: Number = 0.0
    odd_in_x: ClassVar[frozenset[str]] = frozenset({"p1", "b2"})

    @property
    def needs(self) -> Literal["mm", "px"] | None:
        """Its unit, unless that is the tangent."""
        return None if self.unit == "tangent" else self.unit

    def made(self, camera: CameraEntry) -> Lens:
        """Brown's lens; reversed where the coefficients correct."""
        c = 1.0
        if self.unit == "mm":
            c = camera.constant_mm
        elif camera.pixels is not None and self.unit == "px":
            c = camera.pixels.focal[0]
        k, p, b = (self.k1, self.k2, self.k3, self.k4), (self.p1, self.p2), (self.b1, self.b2)
        made = Brown.from_image_units(c, k=k, p=p, b=b)
        if self.y_axis == "down":
            k = (made.k1, made.k2, made.k3, made.k4)
            made = Brown.from_y_down(k=k, p=(made.p1, made.p2), b=(made.b1, made.b2))
        return Reversed(made) if self.meaning == "correction" else made


class OpenCVLens(LensEntry):
    """OpenCV's lens with eight coefficients: rational radial k1–k6 and tangential p1–p2."""

    type: Literal["opencv"]
    k1: Number = 0.0
    k2: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    k5: Number = 0.0
    k6: Number = 0.0
    odd_in_x: ClassVar[frozenset[str]] = frozenset({"p2"})

    def made(self, camera: CameraEntry) -> Lens:
        """OpenCV's lens."""
        return OpenCV(**self.model_dump(exclude={"type"}))


class OpenCVFisheyeLens(LensEntry):
    """OpenCV's fisheye lens: a polynomial k1–k4 of the angle of incidence."""

    type: Literal["opencv_fisheye"]
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0

    def made(self, camera: CameraEntry) -> Lens:
        """OpenCV's fisheye."""
        return Fisheye(self.k1, self.k2, self.k3, self.k4)


class RadialTableLens(LensEntry):
    """Radial distortion of a calibration report: micrometres at field angles (degrees) or at radii (millimetres)."""

    type: Literal["radial_table"]
    angles_deg: tuple[Number, ...] | None = None
    radii_mm: tuple[Number, ...] | None = None
    distortion_um: tuple[Number, ...]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.angles_deg is None) == (self.radii_mm is None):
            raise ValueError("a radial table needs either angles_deg or radii_mm")
        at = self.angles_deg if self.angles_deg is not None else self.radii_mm
        assert at is not None
        if len(at) != len(self.distortion_um) or len(at) < 2:
            raise ValueError(
                f"{len(at)} positions and {len(self.distortion_um)} distortions; equal numbers, at least 2"
            )
        if at[0] < 0 or any(b <= a for a, b in pairwise(at)):
            raise ValueError("positions of a radial table must not be negative and must increase")
        if self.angles_deg is not None and at[-1] >= 90:
            raise ValueError(f"field angle {at[-1]}°; a radial table ends below 90°")
        return self

    @property
    def needs(self) -> Literal["mm", "px"] | None:
        """Millimetres."""
        return "mm"

    def made(self, camera: CameraEntry) -> Lens:
        """The table, divided by the camera constant."""
        if self.angles_deg is not None:
            return RadialTable.from_angles(self.angles_deg, self.distortion_um, camera.constant_mm)
        return RadialTable.from_radii(self.radii_mm or (), self.distortion_um, camera.constant_mm)


#: The registry of lenses.
AnyLens = Annotated[
    IdealLens | BrownLens | OpenCVLens | OpenCVFisheyeLens | RadialTableLens, Field(discriminator="type")
]


class Restoration(Entry):
    """Restoration of images before anything is made of them."""

    filter: Annotated[str, Field(min_length=1, max_length=4000)]
    """A restoration filter: TOML, or one kernel as rows of numbers."""
    linearisation: Annotated[str, Field(min_length=1, max_length=4000)] = "linear"
    """``linear``, ``srgb``, or a file with a table."""

    @field_validator("filter", "linearisation")
    @classmethod
    def _plain(cls, text: str) -> str:
        try:
            return check_input_name(text)
        except InputError as error:
            raise ValueError(str(error)) from None

    @property
    def files(self) -> tuple[str, ...]:
        """Files that it names."""
        table = () if self.linearisation in ("linear", "srgb") else (self.linearisation,)
        return (self.filter, *table)


def _restoration(value: Any) -> Any:
    """A name alone is that of the filter."""
    return {"filter": value} if isinstance(value, str) else value


Restore = Annotated[Restoration, BeforeValidator(_restoration)]


@dataclass(frozen=True)
class InPixels:
    """A camera in pixels."""

    size: tuple[int, int]
    focal: tuple[float, float]
    """Camera constant in x and y."""
    point: tuple[float, float]
    """Column and row of the principal point, (0, 0) the centre of the upper-left pixel."""


@dataclass(frozen=True)
class FiducialSystem:
    """The fiducial marks of a camera whose images are scans."""

    places_mm: Fiducials
    """Calibrated marks by name, x right and y upwards."""
    model: str
    """Transformation from them to a scan: one of `photoplan.cameras.fiducials.MODELS`."""
    mirrored: bool
    """True if the film was scanned through its back."""
    looks: Marks | None
    """Appearance of the marks; None if it is not described."""

    def fit(self, measured: Fiducials | None, model: str | None = None) -> FiducialFit:
        """Adjustment of the marks of a scan, with residuals and sigma0; `model` in place of the camera's."""
        if not measured:
            raise InputError("the fiducial marks of its scan are not measured; `photoplan fiducials` finds them")
        return fit_marks(model or self.model, self.places_mm, measured, mirrored=self.mirrored)


class CameraEntry(Entry, ABC):
    """A camera, of whatever kind: those that there are stand in `photoplan.io.camera.model`."""

    type: str
    size: tuple[Pixels, Pixels] | None
    camera_constant_mm: Positive | None
    principal_point_mm: Pair | None
    lens: AnyLens = IdealLens()
    restore: Restore | None = None
    """Filter that its images are restored with, where they state no other."""
    sigma: dict[Name, NotNegative] | None = None
    """Standard deviations of c, x0, y0 and coefficients of the lens, by these names and in the units stated here."""

    comments: ClassVar[Mapping[str, str]]
    """Entries in the order in which they are written, each with its comment; lens and filter follow."""

    @property
    @abstractmethod
    def pixels(self) -> InPixels | None:
        """The camera in pixels; None where each image has its own."""

    @property
    @abstractmethod
    def states_pixels(self) -> bool:
        """Return whether its interior orientation is computed in pixels; else in millimetres."""

    @property
    @abstractmethod
    def fiducial_system(self) -> FiducialSystem | None:
        """The marks that place an image; None: it needs none."""

    @abstractmethod
    def interior_orientation(self, size: tuple[int, int], fiducials: Fiducials | None) -> Interior:
        """Interior orientation of an image of `size` with these measured marks."""

    @abstractmethod
    def check_fiducials(self, fiducials: Fiducials, sized: bool, name: str) -> None:
        """Refuse measured marks that an image of this camera, called `name`, cannot have, with ValueError.

        `sized` tells whether the size of the scan is stated.
        """

    def places(self, fiducials: Fiducials | None) -> bool:
        """Return whether the interior orientation of an image with these measured marks is known."""
        return bool(fiducials) or self.fiducial_system is None

    @property
    def constant_mm(self) -> float:
        """Camera constant in millimetres; raises InputError where it is not stated so."""
        if self.camera_constant_mm is None:
            raise InputError("the lens is described in millimetres; give camera_constant_mm")
        return self.camera_constant_mm

    @property
    def odd_in_x(self) -> frozenset[str]:
        """Names of stated values that change their sign when x of the image is counted the other way."""
        return frozenset()

    def x_reversed(self) -> Self:
        """Return the camera with the x axis reversed in what it states about the image plane."""
        return self

    def moved(self, change: Mapping[str, float], name: str) -> Self:
        """It, called `name`, with what its `sigma` lists changed."""
        lens: dict[str, float] = {}
        entries: dict[str, object] = {}
        for key, d in change.items():
            if key == "c" and self.camera_constant_mm is not None:
                entries["camera_constant_mm"] = self.camera_constant_mm + d
            elif key == "c" and self.pixels is not None:
                fx, fy = self.pixels.focal
                entries["focal_px"] = (fx + d, fy * (fx + d) / fx)
            elif key in type(self.lens).model_fields and isinstance(getattr(self.lens, key), float):
                lens[key] = getattr(self.lens, key) + d
            elif key not in ("x0", "y0"):
                raise InputError(f"camera {name!r}: sigma of {key!r}; allowed are c, x0, y0 and what its lens states")
        dx, dy = change.get("x0", 0.0), change.get("y0", 0.0)
        if (dx or dy) and self.states_pixels and self.pixels is not None:
            x, y = self.pixels.point
            entries["principal_point_px"] = (x + dx, y + dy)
        elif dx or dy:
            x, y = self.principal_point_mm or (0.0, 0.0)
            entries["principal_point_mm"] = (x + dx, y + dy)
        if lens:
            entries["lens"] = self.lens.model_copy(update=lens)
        return self.model_copy(update=entries)


class FrameEntry(CameraEntry):
    """A digital frame camera: by its focal length in pixels, or by camera constant and pixel or sensor size."""

    type: Literal["frame"] = "frame"
    size: tuple[Pixels, Pixels]
    """Width and height in pixels."""
    focal_px: Positive | tuple[Positive, Positive] | None = None
    """Camera constant in pixels; two numbers where pixels are not square (x, y)."""
    camera_constant_mm: Positive | None = None
    pixel_size_um: Positive | tuple[Positive, Positive] | None = None
    sensor_size_mm: tuple[Positive, Positive] | None = None
    principal_point_px: Pair | None = None
    """Column and row of the principal point, (0, 0) the centre of the upper-left pixel; default the image's middle."""
    principal_point_mm: Pair | None = None
    """The same as x0 to the right and y0 upwards from the image's middle, millimetres."""

    comments: ClassVar[Mapping[str, str]] = {
        "type": "digital frame camera",
        "size": "width and height, pixels",
        "focal_px": "camera constant in pixels; [x, y] if they differ",
        "camera_constant_mm": "",
        "pixel_size_um": "",
        "sensor_size_mm": "",
        "principal_point_px": "column, row",
        "principal_point_mm": "x right, y up, from the middle of the image",
    }

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.focal_px is None) == (self.camera_constant_mm is None):
            raise ValueError("give either focal_px or camera_constant_mm")
        sizes = (self.pixel_size_um is not None) + (self.sensor_size_mm is not None)
        if self.camera_constant_mm is not None and sizes != 1:
            raise ValueError("camera_constant_mm needs either pixel_size_um or sensor_size_mm")
        if self.focal_px is not None and sizes:
            raise ValueError("focal_px stands alone: leave out pixel_size_um and sensor_size_mm")
        if self.principal_point_mm is not None and self.focal_px is not None:
            raise ValueError("principal_point_mm goes with camera_constant_mm; with focal_px give principal_point_px")
        if self.principal_point_mm is not None and self.principal_point_px is not None:
            raise ValueError("give either principal_point_px or principal_point_mm")
        if self.camera_constant_mm is None and self.lens.needs == "mm":
            raise ValueError("a radial table and a lens in unit mm need camera_constant_mm instead of focal_px")
        return self

    @property
    def fiducial_system(self) -> None:
        """There is none."""
        return None

    @property
    def pixels(self) -> InPixels:
        """The camera in pixels."""
        w, h = self.size
        middle = (w - 1) / 2, (h - 1) / 2
        if self.camera_constant_mm is None:
            assert self.focal_px is not None
            focal = self.focal_px if isinstance(self.focal_px, tuple) else (self.focal_px, self.focal_px)
            return InPixels(self.size, focal, self.principal_point_px or middle)
        px, py = self._pixel_mm
        x0, y0 = self.principal_point_mm or (0.0, 0.0)
        point = self.principal_point_px or (middle[0] + x0 / px, middle[1] - y0 / py)
        return InPixels(self.size, (self.camera_constant_mm / px, self.camera_constant_mm / py), point)

    @property
    def states_pixels(self) -> bool:
        """Return whether the principal point is stated in pixels, or nothing is in millimetres."""
        return self.camera_constant_mm is None or self.principal_point_px is not None

    @property
    def _pixel_mm(self) -> tuple[float, float]:
        """Side lengths of a pixel in millimetres."""
        if self.sensor_size_mm is not None:
            return self.sensor_size_mm[0] / self.size[0], self.sensor_size_mm[1] / self.size[1]
        assert self.pixel_size_um is not None
        pair = self.pixel_size_um if isinstance(self.pixel_size_um, tuple) else (self.pixel_size_um,) * 2
        return pair[0] / 1000, pair[1] / 1000

    def interior_orientation(self, size: tuple[int, int], fiducials: Fiducials | None) -> Interior:
        """Interior orientation, the same for all images; `fiducials` are not used."""
        if not self.states_pixels:
            assert self.camera_constant_mm is not None
            return Interior.metric(size, self.camera_constant_mm, self._pixel_mm, self.principal_point_mm or (0.0, 0.0))
        pixels = self.pixels
        col, row = pixels.point
        return Interior.digital(size, pixels.focal, (col - (size[0] - 1) / 2, row - (size[1] - 1) / 2))

    def check_fiducials(self, fiducials: Fiducials, sized: bool, name: str) -> None:
        """A digital image has no marks."""
        raise ValueError(f'fiducials are given, but camera {name!r} is digital (type = "frame")')


def frame_in_pixels(pixels: InPixels, lens: Mapping[str, Any], where: str) -> CameraEntry:
    """The description of a camera that is known in pixels, with the entries of its lens; `where` begins messages."""
    fx, fy = pixels.focal
    focal = fx if fx == fy else pixels.focal
    values = {"size": pixels.size, "focal_px": focal, "principal_point_px": pixels.point, "lens": dict(lens)}
    return build(FrameEntry, values, where)


class FilmEntry(CameraEntry):
    """A film camera whose photographs were scanned; each image states where its fiducial marks are in the scan."""

    type: Literal["film"]
    camera_constant_mm: Positive
    fiducials_mm: Fiducials
    """Calibrated fiducial marks: name = [x, y], x right and y upwards, millimetres."""
    principal_point_mm: Pair = (0.0, 0.0)
    """Principal point of the calibration report in the system of the fiducial marks."""
    interior: Literal["similarity", "affine", "bilinear"] = "affine"
    mirrored: Annotated[bool, Strict()] = False
    """True if the film was scanned through its back, so that left and right are exchanged."""
    size: tuple[Pixels, Pixels] | None = None
    """Width and height of the scans in pixels, where all are equal."""
    marks: Marks | None = None
    """Appearance of the fiducial marks: one description for all, or one for each by name."""

    comments: ClassVar[Mapping[str, str]] = {
        "type": "scanned film; each image states its measured fiducial marks",
        "camera_constant_mm": "",
        "principal_point_mm": "in the system of the fiducial marks, x right, y up",
        "interior": '"similarity", "affine" or "bilinear": from the marks to the scan',
        "mirrored": "true if the film was scanned through its back",
        "size": "width and height of the scans, pixels",
        "fiducials_mm": "calibrated marks: name = [x, y]",
        "marks": "what the marks look like, mm",
    }

    @field_validator("fiducials_mm")
    @classmethod
    def _marks(cls, marks: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        if len(set(marks.values())) != len(marks):
            twice = sorted(n for n, at in marks.items() if list(marks.values()).count(at) > 1)
            raise ValueError(f"fiducial marks {', '.join(twice)} have the same coordinates")
        return marks

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.lens.needs == "px":
            raise ValueError("unit px has no meaning for the lens of a film camera; allowed are tangent and mm")
        if isinstance(self.marks, EachMark):
            described, names = set(self.marks.__pydantic_extra__), ", ".join(self.fiducials_mm)
            unknown, bare = sorted(described - set(self.fiducials_mm)), sorted(set(self.fiducials_mm) - described)
            if unknown:
                raise ValueError(f"marks describes {', '.join(unknown)}; fiducials_mm has {names}")
            if bare:
                raise ValueError(f"marks does not describe fiducial mark {', '.join(bare)}")
        needed = MODELS[self.interior]
        if len(self.fiducials_mm) < needed:
            raise ValueError(f"{len(self.fiducials_mm)} fiducial marks; {self.interior} needs at least {needed}")
        return self

    @property
    def pixels(self) -> None:
        """Each scan has its own."""
        return None

    @property
    def states_pixels(self) -> bool:
        """Never: the marks are in millimetres."""
        return False

    @property
    def odd_in_x(self) -> frozenset[str]:
        """Name the values that change their sign when x of the image is counted the other way."""
        return self.lens.odd_in_x | {"x0"}

    def x_reversed(self) -> Self:
        """Return the camera with x of marks, principal point and lens reversed."""
        x, y = self.principal_point_mm
        return self.model_copy(
            update={
                "fiducials_mm": {name: (-mark[0] + 0.0, mark[1]) for name, mark in self.fiducials_mm.items()},
                "principal_point_mm": (-x + 0.0, y),
                "lens": self.lens.x_reversed(),
            }
        )

    @property
    def fiducial_system(self) -> FiducialSystem:
        """The fiducial marks."""
        return FiducialSystem(self.fiducials_mm, self.interior, self.mirrored, self.marks)

    def interior_orientation(self, size: tuple[int, int], fiducials: Fiducials | None) -> Interior:
        """Interior orientation of a scan from its measured marks; raises as `FiducialSystem.fit`."""
        plane_to_pixel = self.fiducial_system.fit(fiducials).transformation
        return Interior(self.camera_constant_mm, self.principal_point_mm, plane_to_pixel, size)

    def check_fiducials(self, fiducials: Fiducials, sized: bool, name: str) -> None:
        """Marks of a scan are the camera's, and enough."""
        if not sized:
            raise ValueError(
                "size = [width, height] of the scan is stated neither here nor for its camera, and its file "
                "cannot be read; give the scan, or state the size"
            )
        unknown = [n for n in fiducials if n not in self.fiducials_mm]
        if unknown:
            raise ValueError(
                f"fiducial marks {', '.join(unknown)} are not among those of camera {name!r}:"
                f" {', '.join(self.fiducials_mm)}"
            )
        needed = MODELS[self.interior]
        if len(fiducials) < needed:
            missing = [n for n in self.fiducials_mm if n not in fiducials]
            raise ValueError(
                f"{len(fiducials)} fiducial marks measured, {self.interior} needs {needed}; "
                f"missing {', '.join(missing)}"
            )


def _kind(value: Any) -> str:
    found = value.get("type", "frame") if isinstance(value, dict) else getattr(value, "type", "frame")
    return found if isinstance(found, str) else repr(found)


Camera = Annotated[Annotated[FrameEntry, Tag("frame")] | Annotated[FilmEntry, Tag("film")], Discriminator(_kind)]

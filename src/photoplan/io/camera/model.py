"""Descriptions of lenses, and what is common to those of cameras, as checked and frozen values.

Each knows the lens or the interior orientation that computes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict, field_validator, model_validator

from photoplan.cameras.fiducials import FiducialFit, fit_marks
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses import Brown, Fisheye, Lens, NoLens, OpenCV, RadialTable, Reversed
from photoplan.errors import InputError
from photoplan.io.files import check_input_name
from photoplan.io.mark_model import LARGEST, Marks, Number

Positive = Annotated[float, Strict(), Field(gt=0, le=LARGEST, allow_inf_nan=False)]
NotNegative = Annotated[float, Strict(), Field(ge=0, le=LARGEST, allow_inf_nan=False)]
Pixels = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
Name = Annotated[str, Field(min_length=1, max_length=1000)]
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
    """What the coefficients multiply: image coordinates divided by the camera constant, in millimetres or in pixels."""
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
    """How images are restored before anything is made of them."""

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
    """Whether the film was scanned through its back."""
    looks: Marks | None
    """What they look like; None: not described."""

    def fit(self, measured: Fiducials | None, model: str | None = None) -> FiducialFit:
        """Adjustment of the marks of a scan, with residuals and sigma0; `model` in place of the camera's."""
        if not measured:
            raise InputError("the fiducial marks of its scan are not measured; `photoplan fiducials` finds them")
        return fit_marks(model or self.model, self.places_mm, measured, mirrored=self.mirrored)


class CameraEntry(Entry, ABC):
    """A camera, of whatever kind: those that there are stand in `photoplan.io.camera.kinds`."""

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
        """Whether its interior orientation is computed in pixels; else in millimetres."""

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
        """Whether the interior orientation of an image with these measured marks is known."""
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

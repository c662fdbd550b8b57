"""Descriptions of cameras and lenses, as checked and frozen values.

`photoplan.io.project.cameras` turns them into the interior orientation and lens that compute.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal, Self

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

from photoplan.cameras.fiducials_fit import MODELS
from photoplan.errors import InputError
from photoplan.io.mark_model import EachMark, Marks
from photoplan.io.names import check_input_name

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
Pixels = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
Name = Annotated[str, Field(min_length=1, max_length=1000)]
Fiducials = dict[Name, Pair]


class Entry(BaseModel):
    """Base of every entry: unknown keys are errors, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class IdealLens(Entry):
    """A lens without distortion."""

    type: Literal["none"] = "none"


class BrownLens(Entry):
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


class OpenCVLens(Entry):
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


class OpenCVFisheyeLens(Entry):
    """OpenCV's fisheye lens: a polynomial k1–k4 of the angle of incidence."""

    type: Literal["opencv_fisheye"]
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0


class RadialTableLens(Entry):
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


Lens = Annotated[IdealLens | BrownLens | OpenCVLens | OpenCVFisheyeLens | RadialTableLens, Field(discriminator="type")]


def _in_mm(lens: Lens) -> bool:
    return lens.type == "radial_table" or (lens.type == "brown" and lens.unit == "mm")


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


class FrameEntry(Entry):
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
    lens: Lens = IdealLens()
    restore: Restore | None = None
    """Filter that its images are restored with, where they state no other."""

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
        if self.camera_constant_mm is None and _in_mm(self.lens):
            raise ValueError("a radial table and a lens in unit mm need camera_constant_mm instead of focal_px")
        return self

    @property
    def focal(self) -> tuple[float, float]:
        """Camera constant in pixels, in x and in y."""
        if self.focal_px is not None:
            return self.focal_px if isinstance(self.focal_px, tuple) else (self.focal_px, self.focal_px)
        assert self.camera_constant_mm is not None
        px, py = self.pixel_mm
        return self.camera_constant_mm / px, self.camera_constant_mm / py

    @property
    def pixel_mm(self) -> tuple[float, float]:
        """Side lengths of a pixel in millimetres; InputError where the camera is described in pixels alone."""
        if self.sensor_size_mm is not None:
            return self.sensor_size_mm[0] / self.size[0], self.sensor_size_mm[1] / self.size[1]
        if self.pixel_size_um is None:
            raise InputError("the camera is described in pixels; its pixel size is not known")
        pair = self.pixel_size_um if isinstance(self.pixel_size_um, tuple) else (self.pixel_size_um,) * 2
        return pair[0] / 1000, pair[1] / 1000

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row of the principal point in pixels."""
        if self.principal_point_px is not None:
            return self.principal_point_px
        col, row = (self.size[0] - 1) / 2, (self.size[1] - 1) / 2
        if self.principal_point_mm is None:
            return col, row
        px, py = self.pixel_mm
        return col + self.principal_point_mm[0] / px, row - self.principal_point_mm[1] / py


def _all_described(fiducials: Fiducials, marks: EachMark) -> None:
    described = set(marks.__pydantic_extra__)
    unknown, bare = sorted(described - set(fiducials)), sorted(set(fiducials) - described)
    if unknown:
        raise ValueError(f"marks describes {', '.join(unknown)}; fiducials_mm has {', '.join(fiducials)}")
    if bare:
        raise ValueError(f"marks does not describe fiducial mark {', '.join(bare)}")


class FilmCamera(Entry):
    """A film camera whose photographs were scanned; each image states where its fiducial marks are in the scan."""

    type: Literal["film"]
    camera_constant_mm: Positive
    fiducials_mm: Fiducials
    """Calibrated fiducial marks: name = [x, y], x right and y upwards, millimetres."""
    principal_point_mm: Pair = (0.0, 0.0)
    """Principal point of the calibration report in the system of the fiducial marks."""
    interior: Literal["similarity", "affine", "bilinear"] = "affine"
    mirrored: Annotated[bool, Strict()] = False
    """Whether the film was scanned through its back, so that left and right are exchanged."""
    size: tuple[Pixels, Pixels] | None = None
    """Width and height of the scans in pixels, where all are equal."""
    marks: Marks | None = None
    """What the fiducial marks look like: one description for all, or one for each by name."""
    lens: Lens = IdealLens()
    restore: Restore | None = None
    """Filter that its scans are restored with, where they state no other."""

    @field_validator("fiducials_mm")
    @classmethod
    def _marks(cls, marks: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        if len(set(marks.values())) != len(marks):
            twice = sorted(n for n, at in marks.items() if list(marks.values()).count(at) > 1)
            raise ValueError(f"fiducial marks {', '.join(twice)} have the same coordinates")
        return marks

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.lens.type == "brown" and self.lens.unit == "px":
            raise ValueError("unit px has no meaning for the lens of a film camera; allowed are tangent and mm")
        if isinstance(self.marks, EachMark):
            _all_described(self.fiducials_mm, self.marks)
        needed = MODELS[self.interior]
        if len(self.fiducials_mm) < needed:
            raise ValueError(f"{len(self.fiducials_mm)} fiducial marks; {self.interior} needs at least {needed}")
        return self


def _camera_type(value: Any) -> str:
    found = value.get("type", "frame") if isinstance(value, dict) else getattr(value, "type", "frame")
    return found if isinstance(found, str) else repr(found)


Camera = Annotated[
    Annotated[FrameEntry, Tag("frame")] | Annotated[FilmCamera, Tag("film")], Discriminator(_camera_type)
]

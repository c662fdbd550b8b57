"""Descriptions of what fiducial marks look like, as checked and frozen entries of a film camera.

`photoplan.project.camera_marks` turns them into the patterns that are sought in scans. Lengths are millimetres on the
film, angles degrees anticlockwise; x is right and y up about the mark's reference point.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Strict, Tag, model_validator

#: No length, angle or coefficient of a project is larger; products of several still are finite numbers.
LARGEST = 1e15
Number = Annotated[float, Strict(), Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Length = Annotated[float, Strict(), Field(gt=0, le=1000, allow_inf_nan=False)]
Zero = Annotated[float, Strict(), Field(ge=0, le=1000, allow_inf_nan=False)]
Angle = Annotated[float, Strict(), Field(gt=0, lt=90)]
Tone = Annotated[float, Strict(), Field(ge=0, le=1)]
Flag = Annotated[bool, Strict()]
Point = tuple[Number, Number]
Box = tuple[Number, Number, Number, Number]
Name = Annotated[str, Field(min_length=1, max_length=1000)]


class _MarkEntry(BaseModel):
    """Unknown keys are errors, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class _Free(_MarkEntry):
    """A mark that stands free on even ground."""

    bright: Flag = True
    """Bright on dark in a positive, else dark on bright."""
    margin: Zero | None = None
    """Ground around the mark that is compared, default by its size."""


class Cross(_Free):
    """Four arms; see `photoplan.orientation.marks.template` for every number of this and the following marks."""

    type: Literal["cross"]
    arm: Length
    width: Length
    free: Zero = 0.0
    rotation: Number = 0.0


class Dot(_Free):
    """A disc."""

    type: Literal["dot"]
    diameter: Length


class Ring(_Free):
    """A ring."""

    type: Literal["ring"]
    diameter: Length
    width: Length


class RingCross(_Free):
    """A ring with a cross."""

    type: Literal["ring_cross"]
    diameter: Length
    width: Length
    arm: Length
    cross_width: Length | None = None
    free: Zero = 0.0
    rotation: Number = 0.0


class DotCross(_Free):
    """A disc in a cross."""

    type: Literal["dot_cross"]
    diameter: Length
    arm: Length
    width: Length
    free: Zero = 0.0
    rotation: Number = 0.0


class MarkPartEntry(_MarkEntry):
    """A polygon of one tone."""

    outline: Annotated[tuple[Point, ...], Field(min_length=3, max_length=1000)]
    tone: Tone | None = None
    """0 dark to 1 bright; left out: not compared."""


class Polygon(_MarkEntry):
    """Anything, from polygons; each covers those before it."""

    type: Literal["polygon"]
    parts: Annotated[tuple[MarkPartEntry, ...], Field(min_length=1, max_length=200)]
    background: Tone | None = None
    """Tone elsewhere; left out: not compared."""
    window: Box | None = None
    rotation: Number = 0.0


class Silhouette(_MarkEntry):
    """A mark that is the outline of the camera's frame, described as at the upper side of a picture."""

    band: Length = 0.25
    inside: Length | None = None
    corner: Zero = 0.2
    mirrored: Flag = False
    rotation: Number = 0.0
    bright: Flag = False
    window: Box | None = None


class BlockSilhouette(Silhouette):
    """A stepped trapezoid."""

    type: Literal["block"]
    ledge: Length
    depth: Length
    tip: Length
    height: Length
    flanks: tuple[Angle, Angle] = (55.0, 55.0)
    slit: Zero = 0.0
    slit_length: Length | None = None


class Curve(Silhouette):
    """A step on one side and an arc on the other."""

    type: Literal["curve"]
    ledge: Length
    depth: Length
    rise: Length
    run: Length


class Notch(Silhouette):
    """Two teeth beside one edge."""

    type: Literal["notch"]
    reach: Length
    tip: Length
    shoulder: Length
    angle: Angle = 45.0


class Triangle(Silhouette):
    """A wedge between two flanks."""

    type: Literal["triangle"]
    flanks: Point
    near: Zero
    far: Length
    inside_bright: Flag = False


class Arc(Silhouette):
    """A cusp of two arcs with a cross in it."""

    type: Literal["arc"]
    arm: Length
    width: Length
    tip: Length
    depth: Length
    rise: Length
    run: Length


class Example(_MarkEntry):
    """A mark cut from a scan."""

    type: Literal["example"]
    file: Name
    """Image file, relative to the file that describes the camera."""
    reference: Point
    """Column and row of the mark's reference point in it, (0, 0) the centre of the upper-left pixel."""
    pixel_um: Length
    """Side of its pixels on the film, micrometres."""
    rotation: Literal[0, 90, 180, 270] = 0
    """How the example is turned anticlockwise to look like the mark."""
    mirrored: Flag = False
    """Whether its left and right are exchanged before that."""


Mark = Annotated[
    Cross | Dot | Ring | RingCross | DotCross | Polygon | BlockSilhouette | Curve | Notch | Triangle | Arc | Example,
    Field(discriminator="type"),
]


class EachMark(_MarkEntry):
    """A description for every mark by its name."""

    model_config = ConfigDict(frozen=True, extra="allow")
    __pydantic_extra__: dict[str, Mark] = Field(init=False)

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.__pydantic_extra__:
            raise ValueError("no mark is described; give { type = … } for all or { NAME = { type = … }, … }")
        return self


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return "all" if isinstance(value.get("type"), str) else "each"
    return "each" if isinstance(value, EachMark) else "all"


Marks = Annotated[Annotated[Mark, Tag("all")] | Annotated[EachMark, Tag("each")], Discriminator(_kind)]
"""One description for all marks of a camera, or one for each by name."""

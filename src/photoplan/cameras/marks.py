"""Fiducial marks of film cameras: their descriptions in a project, and the patterns to search for in scans.

Lengths are millimetres on the film, angles degrees anticlockwise; x is right and y up about the mark's reference point.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Strict, Tag, model_validator

from photoplan.arrays import Floats
from photoplan.cameras.fiducials import MarkPart, MarkPattern
from photoplan.errors import InputError

_Number = Annotated[float, Strict(), Field(ge=-1e15, le=1e15, allow_inf_nan=False)]
Length = Annotated[float, Strict(), Field(gt=0, le=1000, allow_inf_nan=False)]
Zero = Annotated[float, Strict(), Field(ge=0, le=1000, allow_inf_nan=False)]
Angle = Annotated[float, Strict(), Field(gt=0, lt=90)]
Tone = Annotated[float, Strict(), Field(ge=0, le=1)]
Flag = Annotated[bool, Strict()]
_Point = tuple[_Number, _Number]
_Box = tuple[_Number, _Number, _Number, _Number]
_Name = Annotated[str, Field(min_length=1, max_length=1000)]

_SIDES = 120
"""Vertices of a circle: its radius is then right to 0.02 %, its area exact."""


def disc(diameter: float, centre: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Polygon with the area of a circle, shape (n, 2)."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    radius = diameter / 2 * math.sqrt(2 * np.pi / _SIDES / math.sin(2 * np.pi / _SIDES))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) + centre


def turned(outline: Floats, degrees: float) -> Floats:
    """Points turned anticlockwise about the origin."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.asarray(outline, np.float64) @ np.array([[c, s], [-s, c]])


def box_of(outlines: Iterable[Floats], margin: float) -> tuple[float, float, float, float]:
    """Window around outlines: xmin, ymin, xmax, ymax."""
    points = np.concatenate([*outlines])
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    return float(x0), float(y0), float(x1), float(y1)


class _MarkEntry(BaseModel):
    """Unknown keys are errors, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class FreeMark(_MarkEntry):
    """A mark that stands free on even ground."""

    bright: Flag = True
    """Bright on dark in a positive, else dark on bright."""
    margin: Zero | None = None
    """Ground around the mark that is compared, default by its size."""

    @abstractmethod
    def pattern(self) -> MarkPattern:
        """What it looks like."""

    def _mark(self, name: str, parts: Sequence[tuple[Floats, float]], least: float) -> MarkPattern:
        """A pattern from parts that are 1 on ground 0."""
        window = box_of([outline for outline, _ in parts], least if self.margin is None else self.margin)
        made = tuple(MarkPart(outline, tone if self.bright else 1.0 - tone) for outline, tone in parts)
        return MarkPattern(name, made, 0.0 if self.bright else 1.0, window)


class Cross(FreeMark):
    """Four arms."""

    type: Literal["cross"]
    arm: Length
    width: Length
    free: Zero = 0.0
    rotation: _Number = 0.0

    def pattern(self) -> MarkPattern:
        """Return bars, or four arms if their middle is free."""
        if not self.free < self.arm or self.width >= 2 * self.arm:
            raise InputError(
                f"cross: arm {self.arm}, width {self.width}, free {self.free} mm; free < arm and width < 2 arm are "
                "needed"
            )
        arms = _arms(self.arm, self.width, self.free, self.rotation)
        return self._mark("cross", arms, least=max(2 * self.width, self.arm / 5))


class Dot(FreeMark):
    """A disc."""

    type: Literal["dot"]
    diameter: Length

    def pattern(self) -> MarkPattern:
        """Return a disc; the margin is half of its diameter by default."""
        return self._mark("dot", [(disc(self.diameter), 1.0)], least=self.diameter / 2)


class Ring(FreeMark):
    """A ring of an outer diameter and the width of its line."""

    type: Literal["ring"]
    diameter: Length
    width: Length

    def pattern(self) -> MarkPattern:
        """Return a disc on a disc."""
        parts = _ring("ring", self.diameter, self.width)
        return self._mark("ring", parts, least=max(2 * self.width, self.diameter / 8))


class RingCross(FreeMark):
    """A ring with a cross in it or through it."""

    type: Literal["ring_cross"]
    diameter: Length
    width: Length
    arm: Length
    cross_width: Length | None = None
    free: Zero = 0.0
    rotation: _Number = 0.0

    def pattern(self) -> MarkPattern:
        """Return the ring, and the cross on it."""
        parts = _ring("ring_cross", self.diameter, self.width)
        if not self.free < self.arm:
            raise InputError(f"ring_cross: free {self.free} mm; 0 to less than the arm of {self.arm} mm is needed")
        wide = self.width if self.cross_width is None else self.cross_width
        parts += _arms(self.arm, wide, self.free, self.rotation)
        return self._mark("ring_cross", parts, least=max(2 * self.width, self.diameter / 8))


class DotCross(FreeMark):
    """A disc in the middle of a cross."""

    type: Literal["dot_cross"]
    diameter: Length
    arm: Length
    width: Length
    free: Zero = 0.0
    rotation: _Number = 0.0

    def pattern(self) -> MarkPattern:
        """Return the cross, and the disc on it."""
        if not self.free < self.arm or self.diameter >= 2 * self.arm:
            raise InputError(
                f"dot_cross: diameter {self.diameter}, arm {self.arm}, free {self.free} mm; the arms must show outside"
            )
        parts = [*_arms(self.arm, self.width, self.free, self.rotation), (disc(self.diameter), 1.0)]
        return self._mark("dot_cross", parts, least=max(2 * self.width, self.arm / 5))


def _ring(name: str, diameter: float, width: float) -> list[tuple[Floats, float]]:
    if 2 * width >= diameter:
        raise InputError(f"{name}: width {width} mm; less than half of the diameter of {diameter} mm is needed")
    return [(disc(diameter), 1.0), (disc(diameter - 2 * width), 0.0)]


def _arms(arm: float, width: float, free: float, rotation: float) -> list[tuple[Floats, float]]:
    half = width / 2
    first = np.array([(free, -half), (arm, -half), (arm, half), (free, half)])
    if free == 0:
        first = np.array([(-arm, -half), (arm, -half), (arm, half), (-arm, half)])
    steps = range(0, 360, 90) if free else (0, 90)
    return [(turned(first, rotation + step), 1.0) for step in steps]


class MarkPartEntry(_MarkEntry):
    """A polygon of one tone."""

    outline: Annotated[tuple[_Point, ...], Field(min_length=3, max_length=1000)]
    tone: Tone | None = None
    """0 dark to 1 bright; left out: not compared."""


class Polygon(_MarkEntry):
    """Anything, from polygons; each covers those before it."""

    type: Literal["polygon"]
    parts: Annotated[tuple[MarkPartEntry, ...], Field(min_length=1, max_length=200)]
    background: Tone | None = None
    """Tone elsewhere; left out: not compared."""
    window: _Box | None = None
    rotation: _Number = 0.0

    def pattern(self) -> MarkPattern:
        """Return the polygons, turned."""
        tones = {part.tone for part in self.parts} | {self.background}
        if len(tones - {None}) < 2:
            raise InputError("polygon: all parts have one tone; a mark needs two")
        made = tuple(
            MarkPart(turned(np.array(part.outline), self.rotation), math.nan if part.tone is None else part.tone)
            for part in self.parts
        )
        if self.window is None:
            outlines = [part.outline for part in made]
            box = box_of(outlines, 0.1 * float(np.ptp(np.concatenate(outlines), axis=0).max()))
        else:
            box = box_of([turned(_corners_of(self.window), self.rotation)], 0.0)
        return MarkPattern("polygon", made, math.nan if self.background is None else self.background, box)


def _corners_of(box: tuple[float, float, float, float]) -> Floats:
    x0, y0, x1, y1 = box
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


_STEPS = 40
"""Pieces of an arc."""
_BELOW = 0.5
"""Part of the band of image that has frame below it."""
_FAR = 1000.0
"""Beyond every window, millimetres."""


class Silhouette(_MarkEntry):
    """A mark that is the outline of the camera's frame, described as at the upper side of a picture."""

    name: ClassVar[str]
    band: Length = 0.25
    """Width of the strip of image along the outline that is compared, millimetres."""
    inside: Length | None = None
    """Width of the strip of frame along the outline that is compared; None: all of the frame."""
    corner: Zero = 0.2
    """Radius about each corner that is not compared, millimetres."""
    mirrored: Flag = False
    """Left and right exchanged, before it is turned."""
    rotation: _Number = 0.0
    """Anticlockwise, degrees: 0 upper, 90 left, 180 lower, 270 right side."""
    bright: Flag = False
    """Whether the frame is brighter than the image, as in a negative."""
    window: _Box | None = None
    """xmin, ymin, xmax, ymax of what is compared, as it looks at the upper side, millimetres; default: each mark's."""

    @abstractmethod
    def pattern(self) -> MarkPattern:
        """What it looks like."""

    def _outlined(
        self,
        outline: Floats,
        window: tuple[float, float, float, float],
        *extra: MarkPart,
        corners: list[tuple[float, float]] | None = None,
        unsure: tuple[int, ...] = (),
    ) -> MarkPattern:
        """Frame above an outline from left to right, a band of image along it, corners left out, bright parts on top.

        `unsure`: numbers of the vertices after and before which the outline is not known to be straight.
        """
        frame = np.concatenate([outline, [(_FAR * 2, _FAR * 2), (-_FAR * 2, _FAR * 2)]])
        pieces = [(tuple(a), tuple(b)) for a, b in itertools.pairwise(outline)]
        # The dark reaches below the bright: where parts only touched, ground would shine through between them.
        below = _BELOW * self.band
        dark = [MarkPart(_rectangle(a, b, self.inside or below, below), 0.0) for a, b in pieces]
        if self.inside is None:
            dark.insert(0, MarkPart(frame, 0.0))
        bands = [MarkPart(_rectangle(a, b, 0.0, self.band), 1.0) for a, b in pieces]
        at = [tuple(p) for p in outline[1:-1]] if corners is None else corners
        gone = [MarkPart(disc(2 * self.corner, (float(x), float(y))), math.nan) for x, y in at if self.corner > 0]
        for k in unsure:
            a, b = outline[k], outline[k + 1]
            if abs(a[1] - b[1]) < 1e-9:
                gone.append(MarkPart(_rectangle(tuple(a), tuple(b), self.corner, self.band), math.nan))
        return self._finished([*dark, *bands, *gone, *extra], window)

    def _finished(self, parts: list[MarkPart], window: tuple[float, float, float, float]) -> MarkPattern:
        """Mirrored, turned, tones exchanged; outside all parts nothing is compared."""
        flip = np.array([-1.0 if self.mirrored else 1.0, 1.0])
        made = tuple(
            MarkPart(turned(part.outline * flip, self.rotation), 1.0 - part.tone if self.bright else part.tone)
            for part in parts
        )
        box = box_of([turned(_corners_of(self.window or window) * flip, self.rotation)], 0.0)
        return MarkPattern(self.name, made, math.nan, box)


class BlockSilhouette(Silhouette):
    """A stepped trapezoid: the inner corner of its step is the reference point."""

    name = "block"
    type: Literal["block"]
    ledge: Length
    depth: Length
    tip: Length
    height: Length
    flanks: tuple[Angle, Angle] = (55.0, 55.0)
    slit: Zero = 0.0
    slit_length: Length | None = None

    def pattern(self) -> MarkPattern:
        """Return the outline with the strips that are compared."""
        left, right = (math.tan(math.radians(a)) for a in self.flanks)
        outline = np.array(
            [
                (-self.tip - (self.depth + self.height) / left - _FAR, self.height),
                (-self.tip - (self.depth + self.height) / left, self.height),
                (-self.tip, -self.depth),
                (0.0, -self.depth),
                (0.0, 0.0),
                (self.ledge, 0.0),
                (self.ledge + self.height / right, self.height),
                (self.ledge + self.height / right + _FAR, self.height),
            ]
        )
        extra, top = [], self.height
        if self.slit > 0:
            length = self.height if self.slit_length is None else self.slit_length
            ground, top = self.slit / 2 + (self.inside or 0.0), max(self.height, length)
            extra = [
                MarkPart(_rectangle((0.0, self.corner), (0.0, length), wide, wide), tone)
                for wide, tone in ((ground, 0.0), (self.slit / 2, 1.0))
            ]
        sides = (self.height + self.depth) * 0.2
        window = (-self.tip - self.depth / left - sides, -self.depth - self.band, self.ledge + self.height / right, top)
        return self._outlined(outline, window, *extra)


class Curve(Silhouette):
    """A step on the left and a circular arc on the right: the corner of the step is the reference point."""

    name = "curve"
    type: Literal["curve"]
    ledge: Length
    depth: Length
    rise: Length
    run: Length

    def pattern(self) -> MarkPattern:
        """Return the outline with the strips that are compared."""
        bow = _arc((0.0, -self.depth), (self.run, self.rise - self.depth))
        step = [(-self.ledge, _FAR), (-self.ledge, 0.0), (0.0, 0.0)]
        outline = np.concatenate([step, bow, [(self.run + _FAR, self.rise - self.depth)]])
        top = max(self.rise - self.depth, 0.0) + self.band
        window = (-self.ledge - self.band, -self.depth - self.band, self.run, top)
        return self._outlined(outline, window, corners=[(-self.ledge, 0.0), (0.0, 0.0), (0.0, -self.depth)])


class Notch(Silhouette):
    """A tooth of frame right and a tooth of image left of one edge: the middle of this edge is the reference point."""

    name = "notch"
    type: Literal["notch"]
    reach: Length
    tip: Length
    shoulder: Length
    angle: Angle = 45.0

    def pattern(self) -> MarkPattern:
        """Return the outline with the strips that are compared."""
        slope = 1 / math.tan(math.radians(self.angle))
        flat = (self.reach - self.tip) / slope
        if not flat < self.shoulder:
            raise InputError(
                f"notch: tip {self.tip}, reach {self.reach} mm; the flanks must be longer than the tips are wide"
            )
        end = self.reach - self.shoulder * slope
        left = np.array([(-self.shoulder - _FAR, end), (-self.shoulder, end), (-flat, self.tip), (0.0, self.tip)])
        outline = np.concatenate([left, -left[::-1]])
        window = (-self.shoulder, -self.tip, self.shoulder, self.tip)
        return self._outlined(outline, window, unsure=(2, 4))


class Triangle(Silhouette):
    """A wedge between two straight flanks: its vertex is the reference point."""

    name = "triangle"
    type: Literal["triangle"]
    flanks: _Point
    near: Zero
    far: Length
    inside_bright: Flag = False

    def pattern(self) -> MarkPattern:
        """Return the outline with the strips that are compared."""
        if not self.near < self.far or not 0 < (self.flanks[1] - self.flanks[0]) % 360 < 180:
            raise InputError(
                f"triangle: flanks {self.flanks}, near {self.near}, far {self.far}; an angle under 180° and near < far"
            )
        inner, below = (1.0 if self.inside_bright else 0.0), _BELOW * self.band
        bands = []
        for degrees, left_is_outside in zip(self.flanks, (False, True), strict=True):
            a = math.radians(degrees)
            p, q = ((r * math.cos(a), r * math.sin(a)) for r in (self.near, self.far))
            sides = [(self.band, below), (0.0, self.band)]
            for (wide, over), tone in zip(sides, (inner, 1.0 - inner), strict=True):
                left, right = (over, wide) if left_is_outside else (wide, over)
                bands.append(MarkPart(_rectangle(p, q, left, right), tone))
        return self._finished(bands, box_of([part.outline for part in bands], 0.0))


class Arc(Silhouette):
    """A cusp of two arcs with a bright cross in it: the middle of the cross is the reference point."""

    name = "arc"
    type: Literal["arc"]
    arm: Length
    width: Length
    tip: Length
    depth: Length
    rise: Length
    run: Length

    def pattern(self) -> MarkPattern:
        """Return the outline with the strips that are compared."""
        right = _arc((self.tip / 2, -self.depth), (self.tip / 2 + self.run, self.rise - self.depth))
        outer = [(self.tip / 2 + self.run + _FAR, self.rise - self.depth)]
        half = np.concatenate([right, outer])
        outline = np.concatenate([half[::-1] * np.array([-1.0, 1.0]), half])
        arms = [
            MarkPart(_rectangle((-self.arm, 0.0), (self.arm, 0.0), self.width / 2, self.width / 2), 1.0),
            MarkPart(_rectangle((0.0, -self.arm), (0.0, self.arm), self.width / 2, self.width / 2), 1.0),
        ]
        half_width = self.tip / 2 + self.run / 2
        window = (-half_width, -self.depth - self.band, half_width, self.arm + self.width)
        corners = [(-self.tip / 2, -self.depth), (self.tip / 2, -self.depth)]
        return self._outlined(outline, window, *arms, corners=corners)


def _arc(start: tuple[float, float], end: tuple[float, float]) -> Floats:
    """Circular arc from a point to another one, where it is horizontal; its centre lies below the end."""
    (x0, y0), (x1, y1) = start, end
    radius = ((x1 - x0) ** 2 + (y1 - y0) ** 2) / (2 * (y1 - y0))
    first = math.atan2(y0 - (y1 - radius), x0 - x1)
    angle = np.linspace(first, math.pi / 2, _STEPS + 1)
    return np.stack([x1 + radius * np.cos(angle), y1 - radius + radius * np.sin(angle)], axis=1)


def _rectangle(a: tuple[float, ...], b: tuple[float, ...], left: float, right: float) -> Floats:
    """Along a line from a to b, so far to its left and right."""
    p, q = np.asarray(a, np.float64), np.asarray(b, np.float64)
    along = (q - p) / np.hypot(*(q - p))
    normal = np.array([-along[1], along[0]])
    return np.array([p + left * normal, q + left * normal, q - right * normal, p - right * normal])


class Example(_MarkEntry):
    """A mark cut from a scan."""

    type: Literal["example"]
    file: _Name
    """Image file, relative to the file that describes the camera."""
    reference: _Point
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


def _mark_kind(value: Any) -> str:
    if isinstance(value, dict):
        return "all" if isinstance(value.get("type"), str) else "each"
    return "each" if isinstance(value, EachMark) else "all"


Marks = Annotated[Annotated[Mark, Tag("all")] | Annotated[EachMark, Tag("each")], Discriminator(_mark_kind)]
"""One description for all marks of a camera, or one for each by name."""

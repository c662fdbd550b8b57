"""Mid-side marks that are the outline of the camera's frame: blocks, curves, notches, triangles, arcs.

All are described as they look at the upper side of a picture: the dark frame above, the image below it, x right and y
up about the reference point, millimetres. What the image shows differs from photo to photo: it is compared only in a
band along the outline, where it is taken to be brighter than the frame. Corners are worn or rounded: they are left out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.mark_pattern import MarkPart, MarkPattern
from photoplan.errors import InputError
from photoplan.orientation.marks.catalogue import disc, turned

_STEPS = 40
"""Pieces of an arc."""
_BELOW = 0.5
"""Part of the band of image that has frame below it."""
_FAR = 1000.0
"""Beyond every window, millimetres."""


@dataclass(frozen=True)
class Style:
    """What all silhouettes share."""

    band: float = 0.25
    """Width of the strip of image along the outline that is compared, millimetres."""
    inside: float | None = None
    """Width of the strip of frame along the outline that is compared; None: all of the frame."""
    corner: float = 0.2
    """Radius about each corner that is not compared, millimetres."""
    mirrored: bool = False
    """Left and right exchanged, before it is turned."""
    rotation: float = 0.0
    """Anticlockwise, degrees: 0 upper, 90 left, 180 lower, 270 right side."""
    bright: bool = False
    """Whether the frame is brighter than the image, as in a negative."""
    window: tuple[float, float, float, float] | None = None
    """xmin, ymin, xmax, ymax of what is compared, as it looks at the upper side, millimetres; default: each mark's."""

    def __post_init__(self) -> None:
        if not (self.band > 0 and self.corner >= 0 and math.isfinite(self.band + self.corner + self.rotation)):
            raise InputError(f"silhouette: band {self.band}, corner {self.corner} mm; positive lengths are needed")


def block(
    ledge: float,
    depth: float,
    tip: float,
    height: float,
    *,
    flanks: tuple[float, float] = (55.0, 55.0),
    slit: float = 0.0,
    slit_length: float | None = None,
    style: Style | None = None,
) -> MarkPattern:
    """A stepped trapezoid: the inner corner of its step is the reference point."""
    made = style or Style()
    _check("block", ledge=ledge, depth=depth, tip=tip, height=height)
    left, right = (math.tan(math.radians(a)) for a in flanks)
    outline = np.array(
        [
            (-tip - (depth + height) / left - _FAR, height),
            (-tip - (depth + height) / left, height),
            (-tip, -depth),
            (0.0, -depth),
            (0.0, 0.0),
            (ledge, 0.0),
            (ledge + height / right, height),
            (ledge + height / right + _FAR, height),
        ]
    )
    extra = []
    if slit > 0:
        length = height if slit_length is None else slit_length
        ground = slit / 2 + (made.inside or 0.0)
        extra = [
            MarkPart(_rectangle((0.0, made.corner), (0.0, length), wide, wide), tone)
            for wide, tone in ((ground, 0.0), (slit / 2, 1.0))
        ]
    top = max(height, height if slit_length is None else slit_length) if slit > 0 else height
    sides = (height + depth) * 0.2
    window = (-tip - depth / left - sides, -depth - made.band, ledge + height / right, top)
    return _silhouette("block", outline, window, made, extra)


def curve(ledge: float, depth: float, rise: float, run: float, *, style: Style | None = None) -> MarkPattern:
    """A step on the left and a circular arc on the right: the corner of the step is the reference point."""
    made = style or Style()
    _check("curve", ledge=ledge, depth=depth, rise=rise, run=run)
    bow = _arc((0.0, -depth), (run, rise - depth))
    step = [(-ledge, _FAR), (-ledge, 0.0), (0.0, 0.0)]
    outline = np.concatenate([step, bow, [(run + _FAR, rise - depth)]])
    window = (-ledge - made.band, -depth - made.band, run, max(rise - depth, 0.0) + made.band)
    return _silhouette("curve", outline, window, made, [], corners=[(-ledge, 0.0), (0.0, 0.0), (0.0, -depth)])


def notch(reach: float, tip: float, shoulder: float, *, angle: float = 45.0, style: Style | None = None) -> MarkPattern:
    """A tooth of frame right and a tooth of image left of one edge: the middle of this edge is the reference point."""
    made = style or Style()
    _check("notch", reach=reach, tip=tip, shoulder=shoulder)
    slope = 1 / math.tan(math.radians(angle))
    flat = (reach - tip) / slope
    if not flat < shoulder:
        raise InputError(f"notch: tip {tip}, reach {reach} mm; the flanks must be longer than the tips are wide")
    end = reach - shoulder * slope
    left = np.array([(-shoulder - _FAR, end), (-shoulder, end), (-flat, tip), (0.0, tip)])
    outline = np.concatenate([left, -left[::-1]])
    window = (-shoulder, -tip, shoulder, tip)
    return _silhouette("notch", outline, window, made, [], unsure=[2, 4])


def triangle(
    flanks: tuple[float, float], near: float, far: float, *, inside_bright: bool = False, style: Style | None = None
) -> MarkPattern:
    """A wedge between two straight flanks: its vertex is the reference point."""
    made = style or Style()
    _check("triangle", far=far)
    if not 0 <= near < far or not 0 < (flanks[1] - flanks[0]) % 360 < 180:
        raise InputError(f"triangle: flanks {flanks}, near {near}, far {far}; an angle under 180° and near < far")
    inner, below = (1.0 if inside_bright else 0.0), _BELOW * made.band
    bands = []
    for degrees, left_is_outside in zip(flanks, (False, True), strict=True):
        a = math.radians(degrees)
        p, q = ((r * math.cos(a), r * math.sin(a)) for r in (near, far))
        sides = [(made.band, below), (0.0, made.band)]
        for (wide, over), tone in zip(sides, (inner, 1.0 - inner), strict=True):
            left, right = (over, wide) if left_is_outside else (wide, over)
            bands.append(MarkPart(_rectangle(p, q, left, right), tone))
    points = np.concatenate([part.outline for part in bands])
    (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return _finish("triangle", bands, (x0, y0, x1, y1), made)


def arc(
    arm: float, width: float, tip: float, depth: float, rise: float, run: float, *, style: Style | None = None
) -> MarkPattern:
    """A cusp of two arcs with a bright cross in it: the middle of the cross is the reference point."""
    made = style or Style()
    _check("arc", arm=arm, width=width, tip=tip, depth=depth, rise=rise, run=run)
    right = _arc((tip / 2, -depth), (tip / 2 + run, rise - depth))
    outer = [(tip / 2 + run + _FAR, rise - depth)]
    half = np.concatenate([right, outer])
    outline = np.concatenate([half[::-1] * np.array([-1.0, 1.0]), half])
    arms = [
        MarkPart(_rectangle((-arm, 0.0), (arm, 0.0), width / 2, width / 2), 1.0),
        MarkPart(_rectangle((0.0, -arm), (0.0, arm), width / 2, width / 2), 1.0),
    ]
    window = (-tip / 2 - run / 2, -depth - made.band, tip / 2 + run / 2, max(arm + width, 0.0))
    corners = [(-tip / 2, -depth), (tip / 2, -depth)]
    return _silhouette("arc", outline, window, made, arms, corners=corners)


def _arc(start: tuple[float, float], end: tuple[float, float]) -> NDArray[np.float64]:
    """Circular arc from a point to another one, where it is horizontal; its centre lies below the end."""
    (x0, y0), (x1, y1) = start, end
    radius = ((x1 - x0) ** 2 + (y1 - y0) ** 2) / (2 * (y1 - y0))
    first = math.atan2(y0 - (y1 - radius), x0 - x1)
    angle = np.linspace(first, math.pi / 2, _STEPS + 1)
    return np.stack([x1 + radius * np.cos(angle), y1 - radius + radius * np.sin(angle)], axis=1)


def _silhouette(
    name: str,
    outline: NDArray[np.float64],
    window: tuple[float, float, float, float],
    style: Style,
    extra: list[MarkPart],
    *,
    corners: list[tuple[float, float]] | None = None,
    unsure: list[int] | None = None,
) -> MarkPattern:
    """Frame above an outline from left to right, a band of image along it, corners left out, bright parts on top.

    `unsure`: numbers of the vertices after and before which the outline is not known to be straight.
    """
    frame = np.concatenate([outline, [(_FAR * 2, _FAR * 2), (-_FAR * 2, _FAR * 2)]])
    pieces = [(tuple(a), tuple(b)) for a, b in itertools.pairwise(outline)]
    # The dark reaches below the bright: where parts only touched, ground would shine through between them.
    below = _BELOW * style.band
    dark = [MarkPart(_rectangle(a, b, style.inside or below, below), 0.0) for a, b in pieces]
    if style.inside is None:
        dark.insert(0, MarkPart(frame, 0.0))
    bands = [MarkPart(_rectangle(a, b, 0.0, style.band), 1.0) for a, b in pieces]
    at = [tuple(p) for p in outline[1:-1]] if corners is None else corners
    gone = [MarkPart(disc(2 * style.corner, (float(x), float(y))), math.nan) for x, y in at if style.corner > 0]
    for k in unsure or ():
        a, b = outline[k], outline[k + 1]
        if abs(a[1] - b[1]) < 1e-9:
            gone.append(MarkPart(_rectangle(tuple(a), tuple(b), style.corner, style.band), math.nan))
    return _finish(name, [*dark, *bands, *gone, *extra], window, style)


def _finish(name: str, parts: list[MarkPart], window: tuple[float, float, float, float], style: Style) -> MarkPattern:
    """Mirrored, turned, tones exchanged; outside all parts nothing is compared."""
    flip = np.array([-1.0 if style.mirrored else 1.0, 1.0])
    made = tuple(
        MarkPart(turned(part.outline * flip, style.rotation), 1.0 - part.tone if style.bright else part.tone)
        for part in parts
    )
    x0, y0, x1, y1 = style.window or window
    corners = turned(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) * flip, style.rotation)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return MarkPattern(name, made, math.nan, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))


def _rectangle(a: tuple[float, ...], b: tuple[float, ...], left: float, right: float) -> NDArray[np.float64]:
    """Along a line from a to b, so far to its left and right."""
    p, q = np.asarray(a, np.float64), np.asarray(b, np.float64)
    along = (q - p) / np.hypot(*(q - p))
    normal = np.array([-along[1], along[0]])
    return np.array([p + left * normal, q + left * normal, q - right * normal, p - right * normal])


def _check(name: str, **sizes: float) -> None:
    for size, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: {size} {value} mm; a positive length is needed")

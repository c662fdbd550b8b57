"""Fiducial marks and targets that stand free, from a few numbers in millimetres.

Bright on dark as in a positive, unless `bright` is false. The reference point is the centre. `rotation` turns a mark
anticlockwise, in degrees. Silhouettes of the camera's frame are in `photoplan.orientation.marks.silhouettes`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.mark_pattern import MarkPart, MarkPattern
from photoplan.errors import InputError

_SIDES = 120
"""Vertices of a circle: its radius is then right to 0.02 %, its area exact."""


def disc(diameter: float, centre: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """Polygon with the area of a circle, shape (n, 2)."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    radius = diameter / 2 * math.sqrt(2 * np.pi / _SIDES / math.sin(2 * np.pi / _SIDES))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) + centre


def turned(outline: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Points turned anticlockwise about the origin."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.asarray(outline, np.float64) @ np.array([[c, s], [-s, c]])


def mirrored(pattern: MarkPattern) -> MarkPattern:
    """A pattern with left and right exchanged."""
    parts = tuple(MarkPart(part.outline * np.array([-1.0, 1.0]), part.tone) for part in pattern.parts)
    x0, y0, x1, y1 = pattern.window
    return MarkPattern(pattern.name, parts, pattern.background, (-x1, y0, -x0, y1))


def box_of(outlines: Iterable[NDArray[np.float64]], margin: float) -> tuple[float, float, float, float]:
    """Window around outlines: xmin, ymin, xmax, ymax."""
    points = np.concatenate([*outlines])
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    return float(x0), float(y0), float(x1), float(y1)


def cross(
    arm: float,
    width: float,
    *,
    free: float = 0.0,
    rotation: float = 0.0,
    bright: bool = True,
    margin: float | None = None,
) -> MarkPattern:
    """Four arms."""
    _positive("cross", arm=arm, width=width)
    if not 0 <= free < arm or width >= 2 * arm:
        raise InputError(f"cross: arm {arm}, width {width}, free {free} mm; free < arm and width < 2 arm are needed")
    return _mark("cross", _arms(arm, width, free, rotation), bright, margin, least=max(2 * width, arm / 5))


def dot(diameter: float, *, bright: bool = True, margin: float | None = None) -> MarkPattern:
    """A disc; `margin` in millimetres, by default half of the diameter."""
    _positive("dot", diameter=diameter)
    return _mark("dot", [(disc(diameter), 1.0)], bright, margin, least=diameter / 2)


def ring(diameter: float, width: float, *, bright: bool = True, margin: float | None = None) -> MarkPattern:
    """A ring of an outer diameter and the width of its line, millimetres; `bright` and `margin` as for `cross`."""
    return _mark("ring", _ring("ring", diameter, width), bright, margin, least=max(2 * width, diameter / 8))


def ring_cross(
    diameter: float,
    width: float,
    arm: float,
    *,
    cross_width: float | None = None,
    free: float = 0.0,
    rotation: float = 0.0,
    bright: bool = True,
    margin: float | None = None,
) -> MarkPattern:
    """A ring with a cross in it or through it."""
    parts = _ring("ring_cross", diameter, width)
    wide = width if cross_width is None else cross_width
    _positive("ring_cross", arm=arm, cross_width=wide)
    if not 0 <= free < arm:
        raise InputError(f"ring_cross: free {free} mm; 0 to less than the arm of {arm} mm is needed")
    parts += _arms(arm, wide, free, rotation)
    return _mark("ring_cross", parts, bright, margin, least=max(2 * width, diameter / 8))


def dot_cross(
    diameter: float,
    arm: float,
    width: float,
    *,
    free: float = 0.0,
    rotation: float = 0.0,
    bright: bool = True,
    margin: float | None = None,
) -> MarkPattern:
    """A disc in the middle of a cross."""
    _positive("dot_cross", diameter=diameter, arm=arm, width=width)
    if not 0 <= free < arm or diameter >= 2 * arm:
        raise InputError(f"dot_cross: diameter {diameter}, arm {arm}, free {free} mm; the arms must show outside")
    parts = [*_arms(arm, width, free, rotation), (disc(diameter), 1.0)]
    return _mark("dot_cross", parts, bright, margin, least=max(2 * width, arm / 5))


def polygon(
    parts: Sequence[tuple[NDArray[np.float64], float]],
    *,
    background: float = math.nan,
    window: tuple[float, float, float, float] | None = None,
    rotation: float = 0.0,
    name: str = "polygon",
) -> MarkPattern:
    """Anything: polygons (n, 2) in millimetres about the reference point with tones from 0 dark to 1 bright."""
    made = []
    for number, (outline, tone) in enumerate(parts, 1):
        vertices = np.asarray(outline, np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 2 or len(vertices) < 3 or not np.isfinite(vertices).all():
            raise InputError(
                f"{name}: outline {number} has shape {vertices.shape}; at least 3 vertices x, y are needed"
            )
        _tone(name, tone)
        made.append(MarkPart(turned(vertices, rotation), float(tone)))
    _tone(name, background)
    tones = {part.tone for part in made} | {background}
    if len({tone for tone in tones if not math.isnan(tone)}) < 2:
        raise InputError(f"{name}: all parts have one tone; a mark needs two")
    if window is None:
        outlines = [part.outline for part in made]
        box = box_of(outlines, 0.1 * float(np.ptp(np.concatenate(outlines), axis=0).max()))
    else:
        x0, y0, x1, y1 = window
        box = box_of([turned(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), rotation)], 0.0)
    return MarkPattern(name, tuple(made), background, box)


def _ring(name: str, diameter: float, width: float) -> list[tuple[NDArray[np.float64], float]]:
    _positive(name, diameter=diameter, width=width)
    if 2 * width >= diameter:
        raise InputError(f"{name}: width {width} mm; less than half of the diameter of {diameter} mm is needed")
    return [(disc(diameter), 1.0), (disc(diameter - 2 * width), 0.0)]


def _arms(arm: float, width: float, free: float, rotation: float) -> list[tuple[NDArray[np.float64], float]]:
    half = width / 2
    first = np.array([(free, -half), (arm, -half), (arm, half), (free, half)])
    if free == 0:
        first = np.array([(-arm, -half), (arm, -half), (arm, half), (-arm, half)])
    steps = range(0, 360, 90) if free else (0, 90)
    return [(turned(first, rotation + step), 1.0) for step in steps]


def _mark(
    name: str, parts: Sequence[tuple[NDArray[np.float64], float]], bright: bool, margin: float | None, least: float
) -> MarkPattern:
    """A pattern from parts that are 1 on ground 0."""
    if margin is not None and not (math.isfinite(margin) and margin >= 0):
        raise InputError(f"{name}: margin {margin} mm; 0 or more is needed")
    outlines = [outline for outline, _ in parts]
    window = box_of(outlines, least if margin is None else margin)
    made = tuple(MarkPart(outline, tone if bright else 1.0 - tone) for outline, tone in parts)
    return MarkPattern(name, made, 0.0 if bright else 1.0, window)


def _positive(name: str, **sizes: float) -> None:
    for size, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: {size} {value} mm; a positive length is needed")


def _tone(name: str, tone: float) -> None:
    if not (math.isnan(tone) or 0 <= tone <= 1):
        raise InputError(f"{name}: tone {tone}; 0 (dark) to 1 (bright) are allowed, or none where nothing is compared")

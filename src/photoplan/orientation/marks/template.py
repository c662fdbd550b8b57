"""Fiducial marks as pictures: silhouettes, templates, and a catalogue of cameras."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from photoplan.arrays import Floats, Floats32
from photoplan.cameras.fiducials import MarkExample, MarkPart, MarkPattern
from photoplan.errors import InputError
from photoplan.kernels.raster import polygon_coverage

_LARGEST = 4096
"""Side of a template in pixels beyond which the scale must be wrong."""
_SHARP = 0.5
"""Standard deviation in pixels of the area of a pixel, about what a scanner's pixel blurs."""
_GRAIN = 0.8
"""Standard deviation in pixels by which an example is smoothed: interpolation lowers its grain between pixels, and
matching would be drawn there by a quarter of a pixel."""


@dataclass(frozen=True, eq=False)
class Template:
    """A mark in pixels."""

    values: Floats32
    """Grey values, shape (rows, columns); without meaning where the weight is 0."""
    weights: Floats32
    """How much each pixel counts, at least 0; 0: not compared. Same shape."""
    reference: tuple[float, float]
    """Column and row of the mark's reference point in `values`; (0, 0) is the centre of the first pixel."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape != self.weights.shape:
            raise InputError(f"template of shape {self.values.shape} with weights of shape {self.weights.shape}")


def coverage(outline: Floats, shape: tuple[int, int]) -> Floats:
    """Share of each pixel's area that a polygon covers, exact."""
    total = np.empty((shape[0], shape[1] + 1))
    polygon_coverage(np.asarray(outline, np.float64) + 0.5, total)
    return np.clip(np.abs(total[:, :-1]), 0.0, 1.0)


def render(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
    offset: tuple[float, float] = (0.0, 0.0),
) -> Template:
    """A mark as it appears in a scan.

    Parameters
    ----------
    pattern : MarkPattern or MarkExample
        What it looks like.
    mm_to_pixel : (2, 2)
        From millimetres (x right, y up) to columns and rows of the scan: scale, rotation, reflection, shear.
    negative : bool
        Exchange dark and bright.
    blur_px : float
        Standard deviation of the scan's blur in pixels, for drawn patterns; an example has its own.
    offset : (float, float)
        Columns and rows by which the reference point lies beside the centre of a pixel.

    Returns
    -------
    Template
        Values from 0 dark to 1 bright. Where the description states no tone, or more than half of what blurs into a
        pixel has none, the weight is 0.

    Raises
    ------
    InputError
        The matrix has no inverse, the blur is not sensible, or the mark is smaller than 3 pixels or larger than 4096.
    """
    matrix = np.array(mm_to_pixel, np.float64)
    if matrix.shape != (2, 2) or not np.isfinite(matrix).all() or np.linalg.det(matrix) == 0:
        raise InputError(f"mark {pattern.name!r}: scale {matrix.tolist()}; a 2x2 matrix with an inverse is needed")
    if not 0 <= blur_px <= 100:
        raise InputError(f"mark {pattern.name!r}: blur of {blur_px} px; 0 to 100 are allowed")
    shape, at = _frame(pattern, matrix, offset)
    if isinstance(pattern, MarkExample):
        values, weights = _resample(pattern, matrix, shape, at)
    else:
        values, weights = _draw(pattern, matrix, shape, at, blur_px)
    if negative:
        values = np.float32(1.0) - values
    return Template(values, weights, at)


def _corners(pattern: MarkPattern | MarkExample) -> Floats:
    """Corners of what is compared about the reference point, shape (4, 2), millimetres."""
    if isinstance(pattern, MarkPattern):
        x0, y0, x1, y1 = pattern.window
    else:
        rows, columns = pattern.values.shape
        x, y = pattern.reference
        x0, x1 = (-0.5 - x) * pattern.pixel_mm, (columns - 0.5 - x) * pattern.pixel_mm
        y0, y1 = (y - rows + 0.5) * pattern.pixel_mm, (y + 0.5) * pattern.pixel_mm
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _frame(
    pattern: MarkPattern | MarkExample, matrix: Floats, offset: tuple[float, float]
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Rows and columns of the template, and where the reference point is in it."""
    corners = _corners(pattern) @ matrix.T + offset
    # The window's outline may fall on a pixel's border by rounding: a thousandth of a pixel is no pixel more.
    first = np.floor(corners.min(axis=0) + 0.501).astype(np.int64)
    last = np.ceil(corners.max(axis=0) - 0.501).astype(np.int64)
    columns, rows = (last - first + 1).tolist()
    if min(rows, columns) < 3 or max(rows, columns) > _LARGEST:
        raise InputError(
            f"mark {pattern.name!r}: {columns} x {rows} px at this scale; 3 to {_LARGEST} are allowed. "
            "Check the size of the mark and of the scan's pixels"
        )
    return (rows, columns), (float(offset[0] - first[0]), float(offset[1] - first[1]))


def _draw(
    pattern: MarkPattern, matrix: Floats, shape: tuple[int, int], at: tuple[float, float], blur_px: float
) -> tuple[Floats32, Floats32]:
    """Values and weights of a drawn pattern; each part covers those before it in proportion to its share of a pixel."""
    margin = int(np.ceil(4 * blur_px)) + 1
    wide = (shape[0] + 2 * margin, shape[1] + 2 * margin)
    origin = np.add(at, margin)
    known = np.full(wide, 0.0 if np.isnan(pattern.background) else 1.0)
    tones = known * np.nan_to_num(pattern.background)
    for part in pattern.parts:
        outline = part.outline @ matrix.T + origin
        first = np.clip(np.floor(outline.min(axis=0)), 0, (wide[1], wide[0])).astype(np.int64)
        last = np.clip(np.ceil(outline.max(axis=0)) + 1, first, (wide[1], wide[0])).astype(np.int64)
        box = (slice(first[1], last[1]), slice(first[0], last[0]))
        if known[box].size == 0:
            continue
        share = coverage(outline - first, known[box].shape)
        known[box] *= 1 - share
        tones[box] *= 1 - share
        if not np.isnan(part.tone):
            known[box] += share
            tones[box] += share * part.tone
    if blur_px > 0:
        known = ndimage.gaussian_filter(known, blur_px, mode="nearest")
        tones = ndimage.gaussian_filter(tones, blur_px, mode="nearest")
    inner = (slice(margin, -margin), slice(margin, -margin))
    known, tones = known[inner], tones[inner]
    window = coverage(_corners(pattern) @ matrix.T + at, shape)
    weights = np.clip(2 * known - 1, 0.0, 1.0) * window
    values = np.divide(tones, known, out=np.zeros(shape), where=known > 0.5)
    return values.astype(np.float32), weights.astype(np.float32)


def _resample(
    example: MarkExample, matrix: Floats, shape: tuple[int, int], at: tuple[float, float]
) -> tuple[Floats32, Floats32]:
    """Values and weights of an example, cubic; smoothed first, more where the scan's pixels are larger than its own."""
    given = np.asarray(example.values, np.float64)
    valid = np.isfinite(given)
    if not valid.any() or np.ptp(given[valid]) == 0:
        raise InputError(f"example of mark {example.name!r} has no contrast; cut another one")
    low, high = given[valid].min(), given[valid].max()
    known = valid.astype(np.float64)
    tones = np.where(valid, (given - low) / (high - low), 0.0)
    larger = 1 / (example.pixel_mm * np.sqrt(abs(np.linalg.det(matrix))))
    sigma = max(_GRAIN, _SHARP * np.sqrt(max(larger**2 - 1, 0.0)))
    known = ndimage.gaussian_filter(known, sigma, mode="nearest")
    tones = ndimage.gaussian_filter(tones, sigma, mode="nearest")
    rows, columns = np.indices(shape, dtype=np.float64)
    millimetres = np.stack([columns - at[0], rows - at[1]], axis=-1) @ np.linalg.inv(matrix).T
    column = example.reference[0] + millimetres[..., 0] / example.pixel_mm
    row = example.reference[1] - millimetres[..., 1] / example.pixel_mm
    sampled = [ndimage.map_coordinates(each, [row, column], order=3, mode="mirror") for each in (known, tones)]
    height, width = given.shape
    least, right, bottom = -1e-6, width - 1 + 1e-6, height - 1 + 1e-6
    inside = (column >= least) & (column <= right) & (row >= least) & (row <= bottom)
    weights = np.where(inside, np.clip(2 * sampled[0] - 1, 0.0, 1.0), 0.0)
    values = np.divide(sampled[1], sampled[0], out=np.zeros(shape), where=sampled[0] > 0.5)
    return values.astype(np.float32), weights.astype(np.float32)


def draw(
    pattern: MarkPattern | MarkExample,
    mm_to_pixel: Floats | Sequence[Sequence[float]],
    *,
    negative: bool = False,
    blur_px: float = 0.7,
) -> Template:
    """What `render` draws, or drew for the same pattern, matrix, tone and blur; see there."""
    matrix = np.asarray(mm_to_pixel, float)
    return _drawn(pattern, matrix.shape, tuple(matrix.ravel().tolist()), negative, float(blur_px))


@lru_cache(maxsize=48)
def _drawn(
    pattern: MarkPattern | MarkExample, shape: tuple[int, int], matrix: tuple[float, ...], negative: bool, blur: float
) -> Template:
    return render(pattern, np.array(matrix).reshape(shape), negative=negative, blur_px=blur)


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


def mirrored(pattern: MarkPattern) -> MarkPattern:
    """A pattern with left and right exchanged."""
    parts = tuple(MarkPart(part.outline * np.array([-1.0, 1.0]), part.tone) for part in pattern.parts)
    x0, y0, x1, y1 = pattern.window
    return MarkPattern(pattern.name, parts, pattern.background, (-x1, y0, -x0, y1))


def box_of(outlines: Iterable[Floats], margin: float) -> tuple[float, float, float, float]:
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
    parts: Sequence[tuple[Floats, float]],
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


def _ring(name: str, diameter: float, width: float) -> list[tuple[Floats, float]]:
    _positive(name, diameter=diameter, width=width)
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


def _mark(
    name: str, parts: Sequence[tuple[Floats, float]], bright: bool, margin: float | None, least: float
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


def _arc(start: tuple[float, float], end: tuple[float, float]) -> Floats:
    """Circular arc from a point to another one, where it is horizontal; its centre lies below the end."""
    (x0, y0), (x1, y1) = start, end
    radius = ((x1 - x0) ** 2 + (y1 - y0) ** 2) / (2 * (y1 - y0))
    first = math.atan2(y0 - (y1 - radius), x0 - x1)
    angle = np.linspace(first, math.pi / 2, _STEPS + 1)
    return np.stack([x1 + radius * np.cos(angle), y1 - radius + radius * np.sin(angle)], axis=1)


def _silhouette(
    name: str,
    outline: Floats,
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


def _rectangle(a: tuple[float, ...], b: tuple[float, ...], left: float, right: float) -> Floats:
    """Along a line from a to b, so far to its left and right."""
    p, q = np.asarray(a, np.float64), np.asarray(b, np.float64)
    along = (q - p) / np.hypot(*(q - p))
    normal = np.array([-along[1], along[0]])
    return np.array([p + left * normal, q + left * normal, q - right * normal, p - right * normal])


def _check(name: str, **sizes: float) -> None:
    for size, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: {size} {value} mm; a positive length is needed")

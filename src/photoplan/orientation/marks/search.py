"""Coarse search for the marks of a scan: where they may lie, what correlates there, what fits together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.cameras.mark_pattern import MarkExample, MarkPattern
from photoplan.geometry.grid import Window
from photoplan.orientation.marks.layout import FLOOR, MarkLayout, MarkPlacement, ScanTurn, combine
from photoplan.orientation.marks.locate import correlation_surface
from photoplan.orientation.marks.template import Template, draw

SIDE = 20
"""Pixels that the smaller side of the smallest mark has in the coarse search, about."""
CANDIDATES = 12
"""Candidates of a mark and tone."""
SLACK_MM = 2.0
"""How far a mark may lie beyond where the scan's outline lets it."""
STEP = 0.04
"""Relative step of the scales that are tried."""
WIDEST = 1.36
"""How much larger than the marks' extent a scan's shorter side may be when its scale is not known."""
USUAL = 1.13
"""How much larger it mostly is."""
SURE = 0.45
"""Correlation per mark beyond chance, with all marks found, at which no other scale is tried."""


class Scan(Protocol):
    """Grey values of a scan, by windows."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        ...

    def grey(self, window: Window, factor: int = 1) -> NDArray[np.float32]:
        """Means of blocks of `factor` × `factor` pixels of a window whose sides it divides; NaN: no valid pixel."""
        ...


@dataclass(frozen=True, eq=False)
class MarkSearch:
    """What is sought in which scan."""

    scan: Scan
    layout: MarkLayout
    turns: tuple[ScanTurn, ...]
    """Turns of the film that come into question."""
    negatives: tuple[bool, ...]
    """Tones that come into question."""
    scale_tolerance: float = STEP
    """Part of the scale by which the true one may differ from those that are tried."""
    _surfaces: dict[tuple[int, int, Window], NDArray[np.float64]] = field(default_factory=dict, repr=False)
    _templates: list[tuple[int, float, Template]] = field(default_factory=list, repr=False)


def pixel_sizes(layout: MarkLayout, size: tuple[int, int]) -> tuple[float, ...]:
    """Sides of a pixel in millimetres that are worth trying for a scan of unknown resolution, the likely ones first.

    All marks lie in the scan, and its shorter side is not much longer than their extent.
    """
    short = min(np.ptp(layout.mm, axis=0))
    short = float(short) if short > 0.5 * layout.extent else layout.extent
    count = math.ceil(math.log(WIDEST) / STEP)
    wider = [1.01 * WIDEST ** (k / count) for k in range(count + 1)]
    return tuple(short * w / min(size) for w in sorted(wider, key=lambda w: abs(math.log(w / USUAL))))


def search_placements(search: MarkSearch, pixels_mm: Sequence[float]) -> list[MarkPlacement]:
    """The best placement for every turn and tone, best first."""
    best: dict[tuple[ScanTurn, bool], MarkPlacement] = {}
    for pixel_mm in pixels_mm:
        search._surfaces.clear()
        search._templates.clear()
        factor = _factor(search.layout, pixel_mm)
        for turn in search.turns:
            surfaces = [_surface(search, k, turn, pixel_mm, factor) for k in range(len(search.layout.names))]
            for negative in search.negatives:
                peaks = [_peaks(s, negative, factor) for s in surfaces]
                found = combine(
                    search.layout, peaks, turn, negative, 1 / pixel_mm, search.scale_tolerance, 2.0 * factor
                )
                key = turn, negative
                if found is not None and (key not in best or found.score > best[key].score):
                    best[key] = found
        if any(p.score >= SURE * len(p.found) and len(p.found) == len(search.layout.names) for p in best.values()):
            break
    return sorted(best.values(), key=lambda p: -p.score)


@dataclass(frozen=True, eq=False)
class _Surface:
    values: NDArray[np.float64]
    origin: tuple[float, float]
    """Column and row in the scan of values[0, 0]."""
    apart: int
    """Two candidates are not nearer than this, coarse pixels."""


def _factor(layout: MarkLayout, pixel_mm: float) -> int:
    """Pixels of the scan in a coarse one."""
    side = min(_side(pattern) for pattern in layout.patterns)
    return max(1, round(side / SIDE / pixel_mm))


def _side(pattern: MarkPattern | MarkExample) -> float:
    """Shorter side of what is compared, millimetres."""
    if isinstance(pattern, MarkExample):
        return min(pattern.values.shape) * pattern.pixel_mm
    x0, y0, x1, y1 = pattern.window
    return min(x1 - x0, y1 - y0)


def _surface(search: MarkSearch, k: int, turn: ScanTurn, pixel_mm: float, factor: int) -> _Surface | None:
    """Correlation of mark k with all places where it may lie; None: nowhere."""
    index, template = _template(search, search.layout.patterns[k], turn, pixel_mm * factor)
    region = _region(search, k, turn, pixel_mm, factor)
    if region is None:
        return None
    a, b = template.values.shape
    rx, ry = (math.ceil(v) for v in template.reference)
    # The template may reach beyond the scan, where nothing is compared.
    x0, y0 = region.col - rx, region.row - ry
    key = index, factor, Window(x0 + 10**6, y0 + 10**6, region.width + b, region.height + a)
    if key not in search._surfaces:
        grey = _padded(search.scan, x0, y0, region.width + b, region.height + a, factor)
        search._surfaces[key] = correlation_surface(grey, template)[0]
    ox, oy = x0 + template.reference[0], y0 + template.reference[1]
    half = (factor - 1) / 2
    return _Surface(search._surfaces[key], (factor * ox + half, factor * oy + half), max(2, round(0.5 * min(a, b))))


def _template(
    search: MarkSearch, pattern: MarkPattern | MarkExample, turn: ScanTurn, coarse_mm: float
) -> tuple[int, Template]:
    """Number and template of a pattern; turns that leave it as it is share one."""
    made = draw(pattern, turn.matrix / coarse_mm, blur_px=0.7)
    for number, (owner, size, other) in enumerate(search._templates):
        same = owner == id(pattern) and size == coarse_mm and other.values.shape == made.values.shape
        if same and np.allclose(other.values, made.values, atol=0.02) and np.allclose(other.weights, made.weights):
            return number, other
    search._templates.append((id(pattern), coarse_mm, made))
    return len(search._templates) - 1, made


def _region(search: MarkSearch, k: int, turn: ScanTurn, pixel_mm: float, factor: int) -> Window | None:
    """Coarse pixels where mark k may lie if all marks lie in the scan, turned by a few degrees; None: nowhere."""
    places = search.layout.mm @ turn.matrix.T / pixel_mm
    low, high = places.min(axis=0), places.max(axis=0)
    tolerance = (SLACK_MM + 0.035 * search.layout.extent) / pixel_mm
    size = np.array(search.scan.size, float)
    slack = size - (high - low)
    if (slack < -tolerance).any():
        return None
    first = np.clip(places[k] - low - tolerance + np.minimum(slack, 0), 0, size - 1)
    last = np.clip(places[k] - low + np.maximum(slack, 0) + tolerance, 0, size - 1)
    (c0, r0), (c1, r1) = np.floor(first / factor).astype(int), np.ceil(last / factor).astype(int)
    return Window(int(c0), int(r0), int(c1 - c0 + 1), int(r1 - r0 + 1))


def _padded(scan: Scan, col: int, row: int, width: int, height: int, factor: int) -> NDArray[np.float32]:
    """Coarse pixels of a window that may leave the scan, where they are NaN."""
    most = Window(0, 0, scan.size[0] // factor, scan.size[1] // factor)
    c0, r0 = max(col, 0), max(row, 0)
    c1, r1 = min(col + width, most.width), min(row + height, most.height)
    grey = np.full((height, width), np.nan, np.float32)
    if c1 > c0 and r1 > r0:
        window = Window(c0 * factor, r0 * factor, (c1 - c0) * factor, (r1 - r0) * factor)
        grey[r0 - row : r1 - row, c0 - col : c1 - col] = scan.grey(window, factor)
    return grey


def _peaks(surface: _Surface | None, negative: bool, factor: int) -> NDArray[np.float64]:
    """Highest local maxima (minima of a negative): column, row in the scan, correlation; shape (k, 3)."""
    if surface is None:
        return np.empty((0, 3))
    values = np.nan_to_num(-surface.values if negative else surface.values, nan=-1.0)
    top = (ndimage.maximum_filter(values, 2 * surface.apart + 1, mode="constant", cval=-1.0) == values) & (
        values > FLOOR
    )
    rows, columns = np.nonzero(top)
    order = np.argsort(-values[rows, columns], kind="stable")[:CANDIDATES]
    rows, columns = rows[order], columns[order]
    x, y = columns * factor + surface.origin[0], rows * factor + surface.origin[1]
    return np.column_stack([x, y, values[rows, columns]])

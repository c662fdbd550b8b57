"""MTF from edges: search, groups, measurement."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, cos, floor, hypot, nan, radians
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, PhotoplanError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import Window
from photoplan.io.files import whole_number
from photoplan.io.product import check_output
from photoplan.io.quality_files import read_mtf_table
from photoplan.io.raster import RasterReader
from photoplan.io.tables import write_table
from photoplan.products.mtf.result import EdgeGroup, ImageMtf, LabComparison, MeasuredEdge, MtfReport, rejected_words
from photoplan.project.steps import linearisation_of
from photoplan.quality.curves import Linearisation, clipped_levels
from photoplan.quality.edges.find import EdgePicture, EdgeRegion, EdgeRules, StraightEdge, examine, find_lines, range_of
from photoplan.quality.edges.groups import (
    CombinedValue,
    Enhancement,
    combine,
    enhancement_of,
    field_cell,
    fit_gaussian,
    mean_curve,
    quantiles,
    sigma_of_interval,
)
from photoplan.quality.edges.response import EdgeMeasurement, EdgeSettings, EdgeSpread, measure_edge, spread_of_edge
from photoplan.requests.quality import MtfRequest

#: Said where nobody states how 8 bits are encoded.
ENCODED = (
    "linearisation: linear (by default: grey values are taken as light). Images of 8 bits are usually encoded by a "
    "curve such as sRGB, and that alone moves MTF50 by about 12 %; say `linearisation` srgb, a table, or linear"
)


def check_files(request: MtfRequest) -> None:
    """Refuse images, inputs and outputs that cannot be meant together."""
    if not request.images:
        raise UsageError("no image is given; give one or more images")
    twice = sorted(str(path) for path in set(request.images) if request.images.count(path) > 1)
    if twice:
        raise UsageError(f"image {twice[0]} is given twice")
    if request.csv is not None:
        check_output(request.csv, request.files_read(), overwrite=request.overwrite)


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Names of files; whole paths where two files have one name."""
    names = [path.name for path in paths]
    return [str(path) if names.count(path.name) > 1 else path.name for path in paths]


#: Edges that show all phases of a pixel from which on others do not count in a mean.
ENOUGH = 3
#: Shares of light that means are given for: Z, A, B and the next.
SHARES = 4

Lab = tuple[NDArray[np.float64], NDArray[np.float64]]


def group_edges(
    edges: Sequence[MeasuredEdge], size: tuple[int, int] | None, grid: int, lab: Lab | None
) -> list[EdgeGroup]:
    """Means of every channel: all edges, each direction, and both for every cell of the field that has edges."""
    groups: list[EdgeGroup] = []
    for channel in sorted({edge.channel for edge in edges}):
        own = [edge for edge in edges if edge.channel == channel]
        groups.append(_group(own, None, None, lab))
        groups += [_group(part, way, None, lab) for way in ("x", "y") if (part := _in(own, way))]
        if grid < 2 or size is None:
            continue
        cells: dict[tuple[int, int], list[MeasuredEdge]] = {}
        for edge in own:
            cells.setdefault(field_cell(edge.col, edge.row, size, grid), []).append(edge)
        for cell, members in sorted(cells.items()):
            where = (cell, _bounds(cell, size, grid))
            groups.append(_group(members, None, where, None))
            groups += [_group(part, way, where, None) for way in ("x", "y") if (part := _in(members, way))]
    return groups


def _in(edges: Sequence[MeasuredEdge], direction: str) -> list[MeasuredEdge]:
    return [edge for edge in edges if edge.direction == direction]


def _group(
    edges: Sequence[MeasuredEdge],
    direction: str | None,
    where: tuple[tuple[int, int], tuple[float, float, float, float]] | None,
    lab: Lab | None,
) -> EdgeGroup:
    dense = [edge.measured for edge in edges if edge.measured.sampling == "super-sampled"]
    own = dense if len(dense) >= ENOUGH else [edge.measured for edge in edges]
    curve = mean_curve([m.mtf for m in own])
    beside = None
    if lab is not None:
        beside = LabComparison(lab[0], lab[1], np.array([curve.at(float(f)) for f in lab[0]]))
    spreads = [found for m in own if (found := spread_of_edge(m)) is not None]
    low, middle, high = quantiles([m.mtf50 for m in own], (0.1, 0.5, 0.9))
    return EdgeGroup(
        channel=edges[0].channel,
        band=edges[0].band,
        direction=direction,
        flight=edges[0].flight if direction is not None else None,
        cell=None if where is None else where[0],
        bounds=None if where is None else where[1],
        mtf50=_mean([(m.mtf50, m.mtf50_interval) for m in own], own),
        mtf10=_mean([(m.mtf10, m.mtf10_interval) for m in own], own),
        fwhm=_mean([(m.fwhm, m.fwhm_interval) for m in own], own),
        overshoot=combine([m.overshoot for m in own], [m.overshoot_sigma for m in own], least=0.0),
        undershoot=combine([m.undershoot for m in own], [m.undershoot_sigma for m in own], least=0.0),
        mtf50_range=(low, middle, high),
        curve=curve,
        gaussian=fit_gaussian(curve),
        spread=tuple(_coefficient(spreads, k) for k in range(SHARES)) if direction is not None and spreads else (),
        laboratory=beside,
    )


def _mean(figures: Sequence[tuple[float, tuple[float, float]]], edges: Sequence[EdgeMeasurement]) -> CombinedValue:
    """Mean of figures that are known by intervals."""
    sigmas = [sigma_of_interval(i, m.confidence, m.freedom) for (_, i), m in zip(figures, edges, strict=True)]
    freedom = float(np.mean([m.freedom for m in edges]))
    return combine([value for value, _ in figures], sigmas, freedom=freedom, least=0.0)


def _coefficient(spreads: Sequence[EdgeSpread], place: int) -> CombinedValue:
    """Mean share of light so many pixels away; edges that are not seen so far do not count."""
    values, sigmas = [], []
    for found in spreads:
        spread = found.spread
        seen = place <= spread.half
        values.append(float(spread.side()[place]) if seen else nan)
        both = spread.sigma
        sigmas.append(float(both[spread.half + place]) if seen and both is not None else nan)
    return combine(values, sigmas, least=0.0)


def _bounds(cell: tuple[int, int], size: tuple[int, int], cells: int) -> tuple[float, float, float, float]:
    width, height = size[0] / cells, size[1] / cells
    row, col = cell
    return (
        round(col * width - 0.5, 1),
        round(row * height - 0.5, 1),
        round((col + 1) * width - 0.5, 1),
        round((row + 1) * height - 0.5, 1),
    )


#: Channel 0.
LUMINANCE = 0
#: Weights of red, green and blue light in the luminance (ITU-R BT.709).
_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
#: Weights of red, green and blue in the luminance of JPEG (ITU-R BT.601).
_LUMA = (0.299, 0.587, 0.114)
_CLIPS = tuple(float(2**bits - 1) for bits in (8, 10, 11, 12, 13, 14, 15, 16))
"""Values with which sensors of so many bits end."""
_OFTEN = 20
"""Pixels that must have such a value."""
_SAMPLES = 24
"""Windows in which the range of values is looked for."""


@dataclass(frozen=True, eq=False)
class LightImage:
    """An image behind windows of light.

    Channel 0 is the luminance of the first three bands, or the only band; channel n is band n.
    """

    reader: RasterReader
    linearisation: Linearisation
    span: dict[int, float]
    """Range of the values of each channel that was asked for."""
    extremes: dict[int, tuple[float, float]]
    """Smallest and largest grey value that was seen in each band, as stored."""

    @classmethod
    def open(cls, path: Path, linearisation: Linearisation) -> LightImage:
        """Open a file; its pixels are not read yet."""
        return cls(RasterReader(path), linearisation, {}, {})

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.reader.size

    def channel_name(self, channel: int) -> str:
        """Return the name of a channel in messages."""
        if channel == LUMINANCE:
            return "luminance" if self.reader.bands >= 3 else "band 1"
        return f"band {channel}"

    def channels(self, band: str | None) -> tuple[int, ...]:
        """Channels that an option asks for: None: luminance or the first band, a number, or all."""
        bands = self.reader.bands
        if band is None:
            return (LUMINANCE,) if bands >= 3 or bands == 1 else (1,)
        if band == "all":
            return (LUMINANCE, *range(1, bands + 1)) if bands >= 3 else tuple(range(1, bands + 1))
        if not 1 <= (whole_number(band) or 0) <= bands:
            raise UsageError(f"{self.reader.path}: `band` {band}; the file has bands 1 to {bands}, or say all")
        return (int(band),)

    def picture(self, window: Window, channel: int) -> EdgePicture:
        """Light of a channel in a window, with the range of values of the whole image."""
        # First the samples of the whole image: they tell whether an end of a window is one of the image.
        span = self._span(channel)
        grey, valid, saturated = self._light(window, channel)
        return EdgePicture(grey, valid, saturated, span)

    def stored(self, window: Window, channel: int) -> NDArray[np.float64]:
        """Grey values of a channel in a window as stored; of colours the luminance that compression works on."""
        pixels, _ = self.reader.read(window)
        if self.reader.bands < 3:
            return pixels[max(channel, 1) - 1].astype(np.float64)
        return np.tensordot(_LUMA, pixels[:3].astype(np.float64), 1)

    def _light(
        self, window: Window, channel: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None, NDArray[np.bool_] | None]:
        pixels, valid = self.reader.read(window)
        single = channel != LUMINANCE or self.reader.bands < 3
        bands = [max(channel, 1)] if single else [1, 2, 3]
        light = np.zeros(pixels.shape[1:], np.float32)
        saturated = np.zeros(pixels.shape[1:], bool)
        for weight, band in zip([1.0] if single else _WEIGHTS, bands):
            stored = pixels[band - 1]
            light += np.float32(weight) * self._linear(stored, valid, band)
            low, high = self._ends(stored if valid is None else stored[valid], band)
            saturated |= (stored >= high) | (stored <= low)
        return light, valid, saturated if saturated.any() else None

    def _linear(self, stored: NDArray[np.generic], valid: NDArray[np.bool_] | None, band: int) -> NDArray[np.float32]:
        """Light of a band, full scale 1 but for tables; integers by a table of the values that occur."""
        known = stored if valid is None else stored[valid]
        result = np.zeros(stored.shape, np.float32)
        if known.size == 0:
            return result
        scale = 1.0 if self.linearisation.kind == "table" else self.linearisation.full_scale(stored.dtype)
        low = known.min()
        if stored.dtype.kind == "f":
            light = self.linearisation.to_linear(known, band)
        else:
            grey = np.arange(int(low), int(known.max()) + 1).astype(stored.dtype)
            light = self.linearisation.to_linear(grey, band)[known.astype(np.int64) - int(low)]
        if valid is None:
            return np.asarray(light / scale, np.float32)
        result[valid] = light / scale
        return result

    def _ends(self, known: NDArray[Any], band: int) -> tuple[float, float]:
        """Stored values at which a sensor or a file clips, by the valid pixels of a window.

        Those of the type, of the bits that the file states, or the largest value of the window if it is what a sensor
        of fewer bits ends with; else values at which the pixels pile up, unless the image holds values beyond them.
        """
        kind = self.reader.dtype
        if kind.kind == "f":
            known = known[np.isfinite(known)]
            low, high = -np.inf, np.inf
        else:
            limits, bits = np.iinfo(kind), self.reader.info.bits
            low = float(limits.min)
            high = float(2**bits - 1) if kind.kind == "u" and 0 < bits < 8 * kind.itemsize else float(limits.max)
        if known.size == 0:
            return low, high
        largest = float(known.max())
        if (largest in _CLIPS or (kind.kind == "f" and largest == 1.0)) and int((known == largest).sum()) >= _OFTEN:
            high = min(high, largest)
        between = known[(known > low) & (known < high)]
        if between.size == 0:
            return low, high
        seen = (float(between.min()), float(between.max()))
        before = self.extremes.get(band, seen)
        self.extremes[band] = min(seen[0], before[0]), max(seen[1], before[1])
        smallest, largest = self.extremes[band]
        first, last = clipped_levels(between)
        return (max(low, first) if first <= smallest else low), (min(high, last) if last >= largest else high)

    def _span(self, channel: int) -> float:
        """Range of the values of the whole image, from windows spread over it; asked once."""
        if channel not in self.span:
            width, height = self.size
            side = min(256, width), min(256, height)
            n = max(1, round(_SAMPLES**0.5))
            parts = []
            for i in range(n):
                for j in range(n):
                    at = (round(j * (width - side[0]) / max(n - 1, 1)), round(i * (height - side[1]) / max(n - 1, 1)))
                    grey, valid, _ = self._light(Window(*at, *side), channel)
                    parts.append((grey if valid is None else grey[valid]).ravel()[::7])
            self.span[channel] = range_of(np.concatenate(parts)[None])
        return self.span[channel]


#: Side of a tile, pixels: its arrays take some 200 MB.
TILE = 2048
#: Longest line that is examined as one, pixels: bounds the window that is read for it, and how far lenses bend it.
LONGEST = 512.0
#: Longest part that is measured as one: no lens, print or roof is straight to a tenth of a pixel for longer.
PART = 256.0
#: Cells of the field, in each direction, among which edges are chosen in turn.
_CELLS = 6
#: Edges of a cell that are kept while the search goes on.
_KEPT = 300
_ACROSS = 1.5
_ALONG = 6.0
_TURNED = cos(radians(2.0))


@dataclass
class FoundEdges:
    """Edges that can be measured, and how many others were rejected for what."""

    regions: list[EdgeRegion] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)


def tiles_of(area: Window) -> list[Window]:
    """Tiles that cover an area."""
    columns, rows = (max(1, -(-side // TILE)) for side in (area.width, area.height))
    across = [area.col + area.width * k // columns for k in range(columns + 1)]
    down = [area.row + area.height * k // rows for k in range(rows + 1)]
    return [
        Window(across[j], down[i], across[j + 1] - across[j], down[i + 1] - down[i])
        for i in range(rows)
        for j in range(columns)
    ]


def search_edges(
    image: LightImage,
    channel: int,
    area: Window,
    rules: EdgeRules,
    advance: Callable[[int, int], None] = lambda tiles, pixels: None,
) -> FoundEdges:
    """Edges in a part of an image; pixels outside that part are not used."""
    found, open_lines = FoundEdges(), []
    margin = max(rules.halves) + 4
    for tile in tiles_of(area):
        col, row = max(area.col, tile.col - margin), max(area.row, tile.row - margin)
        right, bottom = (min(a, t + margin) for a, t in zip(area.stop, tile.stop))
        read = Window(col, row, right - col, bottom - row)
        picture = image.picture(read, channel)
        lines, reasons = find_lines(picture.grey, picture.valid, rules.least_length)
        found.rejected += reasons
        for line in lines:
            inside = _clipped(line, (tile.col - col, tile.row - row, tile.stop[0] - col, tile.stop[1] - row))
            if inside is None:
                continue
            # A line that leaves the tile goes on in the next one.
            if inside.length < line.length - 0.5:
                open_lines.append(inside.moved(col, row))
                continue
            for part in _pieces(line):
                region, reason = examine(picture, part, rules)
                if region is None:
                    found.rejected[reason] += 1
                else:
                    found.regions.append(_placed(region, col, row))
        found.regions = _best_of_cells(found.regions, image.size)
        advance(1, tile.size)
    for line in join_lines(open_lines):
        for part in _pieces(line):
            _examine_alone(image, channel, area, part, rules, found)
    numbered = [replace(region, of=k) for k, region in enumerate(sorted(found.regions, key=lambda r: -r.merit), 1)]
    parts = [part for region in numbered for part in parted(region, ceil(region.line.length / PART))]
    found.regions = sorted(parts, key=lambda region: -region.merit)
    return found


def _examine_alone(
    image: LightImage, channel: int, area: Window, line: StraightEdge, rules: EdgeRules, found: FoundEdges
) -> None:
    """Examine a line in a window of its own."""
    if line.length < rules.least_length:
        return
    reach = max(rules.halves) + 4
    xs, ys = zip(*line.ends)
    around = Window(
        max(0, floor(min(xs)) - reach),
        max(0, floor(min(ys)) - reach),
        floor(max(xs) - min(xs)) + 2 * reach + 2,
        floor(max(ys) - min(ys)) + 2 * reach + 2,
    )
    window = area & around
    if window.size == 0:
        return
    region, reason = examine(image.picture(window, channel), line.moved(-window.col, -window.row), rules)
    if region is None:
        found.rejected[reason] += 1
    else:
        found.regions.append(_placed(region, window.col, window.row))


def parted(region: EdgeRegion, count: int) -> list[EdgeRegion]:
    """An edge in parts of equal length, each an edge of its own."""
    if count < 2:
        return [region]
    step = region.line.length / count
    parts = []
    for k in range(count):
        shift = (k + 0.5) * step - region.line.length / 2
        gaps = tuple((a - shift, b - shift) for a, b in region.gaps if b - shift > -step / 2 and a - shift < step / 2)
        parts.append(replace(region, line=region.line.part(k * step, (k + 1) * step), gaps=gaps))
    return parts


def _placed(region: EdgeRegion, dx: float, dy: float) -> EdgeRegion:
    return replace(region, line=region.line.moved(dx, dy))


def _clipped(line: StraightEdge, box: tuple[int, int, int, int]) -> StraightEdge | None:
    """The part of a line inside a box of pixels (left, top, right, bottom); None: it is outside."""
    start, end = 0.0, line.length
    (x0, y0), _ = line.ends
    for at, step, low, high in ((x0, line.tx, box[0], box[2]), (y0, line.ty, box[1], box[3])):
        if abs(step) < 1e-12:
            if not low - 0.5 <= at < high - 0.5:
                return None
            continue
        a, b = sorted(((low - 0.5 - at) / step, (high - 0.5 - at) / step))
        start, end = max(start, a), min(end, b)
    return line.part(start, end) if end > start else None


def join_lines(lines: Iterable[StraightEdge]) -> list[StraightEdge]:
    """Lines of which one goes on where another ends become one, the longest first."""
    waiting = sorted(lines, key=lambda line: -line.length)
    joined: list[StraightEdge] = []
    while waiting:
        line = waiting.pop(0)
        while True:
            at = next((k for k, other in enumerate(waiting) if _goes_on(line, other)), None)
            if at is None:
                break
            other = waiting.pop(at)
            ends = sorted([*line.ends, *other.ends], key=lambda p: p[0] * line.tx + p[1] * line.ty)
            line = StraightEdge.between(ends[0], ends[-1], max(line.strength, other.strength))
        joined.append(line)
    return joined


def _goes_on(line: StraightEdge, other: StraightEdge) -> bool:
    """Return whether another line begins at the end of this one, or the reverse, in the same direction."""
    reach = (line.length + other.length) / 2 + _ALONG
    if hypot(line.x - other.x, line.y - other.y) > reach:
        return False
    # A short piece knows its direction less well.
    if line.tx * other.tx + line.ty * other.ty < (_TURNED if min(line.length, other.length) > 12 else 0.97):
        return False
    ends = [(a, b) for a, b in ((line.ends[1], other.ends[0]), (other.ends[1], line.ends[0]))]
    return any(
        hypot(a[0] - b[0], a[1] - b[1]) <= _ALONG and abs((b[1] - a[1]) * line.tx - (b[0] - a[0]) * line.ty) <= _ACROSS
        for a, b in ends
    )


def _pieces(line: StraightEdge) -> list[StraightEdge]:
    """A line in parts that are not too long."""
    count = max(1, -(-int(line.length) // int(LONGEST)))
    step = line.length / count
    return [line.part(k * step, (k + 1) * step) for k in range(count)]


def _cell(region: EdgeRegion, size: tuple[int, int]) -> tuple[int, int]:
    return (
        min(max(int(_CELLS * region.line.x / size[0]), 0), _CELLS - 1),
        min(max(int(_CELLS * region.line.y / size[1]), 0), _CELLS - 1),
    )


def _best_of_cells(regions: Sequence[EdgeRegion], size: tuple[int, int]) -> list[EdgeRegion]:
    """The best of each cell of the field: bounds what is kept."""
    if len(regions) <= _KEPT:
        return list(regions)
    taken: Counter[tuple[int, int]] = Counter()
    kept = []
    for region in sorted(regions, key=lambda r: -r.merit):
        cell = _cell(region, size)
        taken[cell] += 1
        if taken[cell] <= _KEPT:
            kept.append(region)
    return kept


def select_spread(regions: Sequence[EdgeRegion], size: tuple[int, int], most: int) -> list[EdgeRegion]:
    """The best edges, spread over the field and over both directions: each cell gives its next best in turn."""
    queues: dict[tuple[int, int, bool], list[EdgeRegion]] = {}
    for region in sorted(regions, key=lambda r: -r.merit):
        queues.setdefault((*_cell(region, size), abs(region.line.tx) > abs(region.line.ty)), []).append(region)
    chosen: list[EdgeRegion] = []
    turn = 0
    while len(chosen) < most and any(len(queue) > turn for queue in queues.values()):
        row = sorted((q[turn] for q in queues.values() if len(q) > turn), key=lambda r: -r.merit)
        chosen += row[: most - len(chosen)]
        turn += 1
    return chosen


Advance = Callable[[int, int], None]

#: Share of the pixels of an edge that may be saturated.
MOST_SATURATED = 0.01
#: A bent edge is not parted into pieces shorter than this, pixels.
_SHORT = 40.0


@dataclass(frozen=True, eq=False)
class Measuring:
    """Settings of the measurement of an image."""

    rois: tuple[tuple[int, int, int, int], ...]
    """Column, row, width, height; none: the whole image is searched."""
    band: str | None
    rules: EdgeRules
    most_edges: int
    grid: int
    flight: Literal["x", "y"] | None
    lab: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    """Cycles per pixel, and modulation."""

    def areas(self, image: LightImage) -> list[Window]:
        """Windows that are searched."""
        width, height = image.size
        if not self.rois:
            return [Window(0, 0, width, height)]
        for roi in self.rois:
            col, row, w, h = roi
            if min(w, h) < 1 or col < 0 or row < 0 or col + w > width or row + h > height:
                raise UsageError(
                    f"`roi` {col} {row} {w} {h} (column, row, width, height): leaves {image.reader.path} of {width} × "
                    f"{height} pixels"
                )
        return [Window(*roi) for roi in self.rois]

    def steps(self, image: LightImage) -> int:
        """Steps of the progress."""
        return sum(len(tiles_of(area)) for area in self.areas(image)) + self.most_edges


def measure_image(name: str, path: Path, image: LightImage, how: Measuring, advance: Advance) -> ImageMtf:
    """Find and measure the edges of an image."""
    channels = image.channels(how.band)
    chosen, count, rejected = _regions(image, channels[0], how, advance)
    edges, refusals = _measure_all(image, channels, chosen, how, advance)
    if refusals:
        rejected["refused"] += sum(refusals.values())
    first = [edge for edge in edges if edge.channel == channels[0]]
    if not first:
        raise InputError(_nothing(image, rejected, how, refusals))
    notes = [f"{n} edge{'s were' if n > 1 else ' was'} refused: {why}" for why, n in refusals.most_common(3)]
    few = [edge for edge in first if edge.measured.sampling != "super-sampled"]
    if few:
        aligned = sum(edge.aligned for edge in few)
        notes.append(
            f"{len(few)} of {len(first)} edges show few positions within a pixel: {aligned} parallel to rows or "
            f"columns, {len(few) - aligned} diagonal or short. They count only in means of directions and parts of the "
            f"field with fewer than {ENOUGH} other edges"
        )
    enhancement = enhancement_of([edge.measured for edge in first])
    if enhancement.enhanced:
        notes.append(enhancement.warning)
    return ImageMtf(
        name=name,
        file=path,
        size=image.size,
        linearisation=image.linearisation.describe(),
        edges=tuple(edges),
        groups=tuple(group_edges(edges, image.size, 0 if how.rois else how.grid, how.lab)),
        enhancement=enhancement,
        found=count,
        grid=how.grid,
        rejected=dict(rejected),
        notes=tuple(notes),
    )


def _measure_all(
    image: LightImage, channels: Sequence[int], chosen: Sequence[EdgeRegion], how: Measuring, advance: Advance
) -> tuple[list[MeasuredEdge], Counter[str]]:
    """Edges measured in all channels, and why others were refused; bent ones are tried again in halves."""
    edges: list[MeasuredEdge] = []
    refusals: Counter[str] = Counter()
    waiting = list(reversed(chosen))
    number, left = 0, how.most_edges
    while waiting:
        region = waiting.pop()
        number += 1
        for channel in channels:
            try:
                edges.append(_measured(image, channel, number, region, how))
            except InputError as error:
                if str(error).startswith(str(image.reader.path)):
                    raise
                if _bent(error) and channel == channels[0] and region.line.length > 2 * _SHORT:
                    waiting += reversed(parted(region, 2))
                    break
                if how.rois and channel == channels[0]:
                    raise type(error)(f"{_place(image, region, channel)}: {error}") from None
                # Without its figures.
                refusals[re.split(r"[:;,(]", str(error), maxsplit=1)[0].strip()] += 1
                if channel == channels[0]:
                    break
        if left > 1:
            advance(1, 0)
            left -= 1
    advance(left, 0)
    return edges, refusals


def _regions(
    image: LightImage, channel: int, how: Measuring, advance: Advance
) -> tuple[list[EdgeRegion], int, Counter[str]]:
    """Edges to measure, how many there were to choose from, and what was rejected."""
    if not how.rois:
        found = search_edges(image, channel, how.areas(image)[0], how.rules, advance)
        chosen = select_spread(found.regions, image.size, how.most_edges)
        if not chosen:
            raise InputError(_nothing(image, found.rejected, how, Counter()))
        return chosen, len(found.regions), found.rejected
    chosen = []
    rejected: Counter[str] = Counter()
    for roi, area in zip(how.rois, how.areas(image)):
        in_roi = search_edges(image, channel, area, how.rules, advance)
        if not in_roi.regions:
            raise InputError(f"{image.reader.path}: `roi` {' '.join(map(str, roi))}: {_why(in_roi)}")
        chosen.append(in_roi.regions[0])
        rejected += in_roi.rejected
    return chosen, len(chosen), rejected


def _why(found: FoundEdges) -> str:
    words = rejected_words(dict(found.rejected))
    return f"no edge in it can be measured ({words or 'it holds no straight brightness step'}); choose another window"


def _nothing(image: LightImage, rejected: Counter[str], how: Measuring, refusals: Counter[str]) -> str:
    """Return the message if no edge can be measured."""
    words = rejected_words(dict(rejected))
    reason = f"rejected: {words}" if words else "the image holds no straight brightness step long enough"
    if refusals:
        reason += f"; most often because {refusals.most_common(1)[0][0]}"
    return (
        f"{image.reader.path}: no edge found that can be measured; {reason}. An edge must be straight for "
        f"{how.rules.least_length:g} px, with even sides, contrast over noise above {how.rules.least_snr:g}, and not "
        "saturated; give an image with roofs, markings or a chart"
    )


def _place(image: LightImage, region: EdgeRegion, channel: int) -> str:
    at = f"edge at column {region.line.x:.0f}, row {region.line.y:.0f}"
    return f"{image.reader.path}: {at}, {image.channel_name(channel)}"


def _measured(image: LightImage, channel: int, number: int, region: EdgeRegion, how: Measuring) -> MeasuredEdge:
    window = region.window(image.size)
    picture = image.picture(Window(*window), channel)
    mask = region.mask(window)
    if picture.valid is not None:
        mask &= picture.valid
    if picture.saturated is not None:
        # What saturates here may be too rare in a tile to be seen there.
        share = float(picture.saturated[mask].mean()) if mask.any() else 0.0
        if share > MOST_SATURATED:
            raise InputError(
                f"saturated edge: {100 * share:.1f} % of its pixels have the largest or smallest grey value; allowed "
                f"are {100 * MOST_SATURATED:g} %"
            )
        mask &= ~picture.saturated
    light = picture.grey.astype(float)
    settings = EdgeSettings(
        reach=float(region.half),
        least_snr=min(how.rules.least_snr, 5.0),
        least_length=min(how.rules.least_length, 12.0),
        most_structure=how.rules.evenness,
    )
    try:
        measured = measure_edge(light, mask, origin=window[:2], settings=settings)
    except InputError as error:
        if not _bent(error):
            raise
        measured = measure_edge(light, mask, origin=window[:2], settings=replace(settings, curve=2))
    flight = None if how.flight is None else "along" if measured.direction == how.flight else "across"
    name = image.channel_name(channel)
    return MeasuredEdge(
        number=number,
        line=region.of,
        ends=region.line.ends,
        half=region.half,
        aligned=region.aligned,
        channel=channel,
        band=name,
        flight=flight,
        measured=measured,
    )


def _bent(error: InputError) -> bool:
    return str(error).startswith("bent")


def measure_edges(request: MtfRequest, events: Events = SILENT) -> MtfReport:
    """Measure the edges of all images; one that fails does not stop the others."""
    check_files(request)
    linearisation = linearisation_of(request.linearisation or "linear")
    lab = None if request.lab is None else read_mtf_table(request.lab)
    measuring = Measuring(
        rois=request.rois,
        band=request.band,
        rules=EdgeRules.within(
            request.half_width,
            least_length=request.least_length or (20.0 if not request.rois else 12.0),
            least_snr=request.least_snr,
        ),
        most_edges=request.most_edges,
        grid=request.grid,
        flight=request.flight,
        lab=None if lab is None else (lab.per_pixel(request.pixel_um), lab.modulation),
    )
    names = dict(zip(request.images, unique_names(request.images)))
    opened, failed = _opened(request, linearisation, names)
    if request.linearisation is None and any(image.reader.dtype == "uint8" for image in opened.values()):
        events.talk(f"note: {ENCODED}")
    results: list[ImageMtf] = []
    events.begin("edges", sum(measuring.steps(image) for image in opened.values()), "tiles")
    left = 0

    def advance(steps: int, pixels: int = 0) -> None:
        nonlocal left
        left -= steps
        events.done(steps, pixels)

    for path, image in opened.items():
        left = measuring.steps(image)
        try:
            results.append(measure_image(names[path], path, image, measuring, advance))
        except (ResourceError, UsageError):
            raise
        except PhotoplanError as error:
            failed[names[path]] = str(error)
            events.done(left)
    done = bool(results)
    made = MtfReport(
        tuple(results),
        failed,
        *_together(results, measuring),
        linearisation.describe(),
        request.pixel_um,
        request.flight,
        request.csv if done else None,
    )
    if made.csv is not None:
        write_table(made.csv, *made.csv_rows)
    return made


def _together(results: Sequence[ImageMtf], measuring: Measuring) -> tuple[tuple[EdgeGroup, ...], Enhancement | None]:
    """Means and edge enhancement by the edges of all images."""
    edges = [edge for image in results for edge in image.edges]
    if not edges:
        return (), None
    if len(results) == 1:
        return results[0].groups, results[0].enhancement
    sizes = {image.size for image in results}
    grid = 0 if measuring.rois else measuring.grid
    groups = group_edges(edges, sizes.pop() if len(sizes) == 1 else None, grid, measuring.lab)
    first = [edge.measured for edge in edges if edge.channel == groups[0].channel]
    return tuple(groups), enhancement_of(first)


def _opened(
    request: MtfRequest, linearisation: Linearisation, names: dict[Path, str]
) -> tuple[dict[Path, LightImage], dict[str, str]]:
    """Images that can be used, and why the others cannot."""
    opened: dict[Path, LightImage] = {}
    failed: dict[str, str] = {}
    for path in request.images:
        try:
            opened[path] = LightImage.open(path, linearisation)
        except ResourceError:
            raise
        except PhotoplanError as error:
            failed[names[path]] = str(error)
    return opened, failed

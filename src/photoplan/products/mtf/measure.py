"""The edges of one image: sought or given, measured in every channel, and summed up."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.products.mtf.groups import ENOUGH, group_edges
from photoplan.products.mtf.image import LightImage
from photoplan.products.mtf.result import ImageMtf, MeasuredEdge, rejected_words
from photoplan.products.mtf.search import FoundEdges, parted, search_edges, select_spread, tiles_of
from photoplan.quality.edges.enhancement import enhancement_of
from photoplan.quality.edges.find import EdgeRegion, EdgeRules
from photoplan.quality.edges.response import EdgeSettings, measure_edge

Advance = Callable[[int, int], None]

#: Share of the pixels of an edge that may be saturated.
MOST_SATURATED = 0.01
#: A bent edge is not parted into pieces shorter than this, pixels.
_SHORT = 40.0


@dataclass(frozen=True, eq=False)
class Measuring:
    """How the images are measured."""

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
    """What is said where no edge can be measured."""
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

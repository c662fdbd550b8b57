"""Report of a restoration as one HTML document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.report.filter_plots import MOST_DRAWN, KernelPicture
from photoplan.report.page import Cell, figure, headline, page, section, table, text
from photoplan.report.restore_plots import AxisPicture, EndsPicture, FieldMap, RestorePlots

#: Images that get pictures, and parts of the field that are listed.
_PICTURED = 30
_LISTED = 300
PART_HEAD = ("part", "edges", "method", "along", "Z", "A", "B", "A/Z", "singular values", "least transfer", "MTF50",
             "expected", "noise ×")  # fmt: skip
#: Marks a direction without edges enough.
STANDS_FOR = " †"
BAND_HEAD = ("band", "below", "above", "clipped")
CHROMATIC_HEAD = ("band", "kind", "shift x px", "shift y px", "corners px", "residual px", "used", "left out")


@dataclass(frozen=True, eq=False)
class PartFacts:
    """Sharpness and filter of a band in a part of the field."""

    name: str
    axes: tuple[AxisPicture, ...]
    rule: str
    """Why the filter is as it is."""


@dataclass(frozen=True, eq=False)
class FilterFacts:
    """Where the filter comes from and what it is."""

    figures: tuple[tuple[str, str, str], ...]
    """Value, name, remark."""
    origin: str
    notes: tuple[str, ...]
    """What a reader must know: edge enhancement, parts without edges."""
    parts: tuple[PartFacts, ...]
    """Those that are drawn."""
    rows: tuple[tuple[str, ...], ...]
    """Rows of the table of parts."""
    facts: tuple[tuple[str, str], ...]
    """Of a filter that was not measured: name, value."""
    title: str
    kernels: tuple[KernelPicture, ...]
    maps: tuple[tuple[str, tuple[FieldMap, ...]], ...]
    """Of each band: its name, and what is known over the field."""


@dataclass(frozen=True, eq=False)
class RestoredFacts:
    """What the report shows of an image."""

    name: str
    figures: tuple[tuple[str, str, str], ...]
    bands: tuple[tuple[str, ...], ...]
    """Rows of the table of clipped pixels."""
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    """Details; (height, width) or (height, width, 3)."""
    place: str
    """Where they are."""
    ends: EndsPicture | None
    """None: no pixel is valid."""
    notes: tuple[str, ...] = ()
    chromatic: tuple[tuple[str, ...], ...] = ()
    """Rows of the table of bands."""


def restore_report(
    title: str, used: FilterFacts, images: Sequence[RestoredFacts], failed: dict[str, str], plots: RestorePlots
) -> str:
    """The report as one HTML document."""
    parts = [section("The filter", _filter(used, plots))]
    parts += [section(facts.name, _image(facts, plots if k < _PICTURED else None)) for k, facts in enumerate(images)]
    if failed:
        rows = [[Cell(name), Cell(reason)] for name, reason in failed.items()]
        parts.append(section("Images without result", [table(("image", "reason"), rows)]))
    return page(f"Restoration: {title}", "Images restored by a filter: where it comes from and what it did", parts)


def _filter(used: FilterFacts, plots: RestorePlots) -> list[str]:
    parts = [headline(used.figures), f"<p>{text(used.origin)}</p>"]
    parts += [f"<p><b>Mind:</b> {text(note)}.</p>" for note in used.notes]
    rules = list(dict.fromkeys(part.rule for part in used.parts))
    for rule in rules:
        names = [part.name for part in used.parts if part.rule == rule]
        where = f"{'; '.join(names[:4])}{' …' if len(names) > 4 else ''}: " if len(rules) > 1 else ""
        parts.append(f"<p>Rule: {text(where + rule)}.</p>")
    for part in used.parts[:MOST_DRAWN]:
        caption = (
            "Left: the share of an object pixel's light that falls on the pixels beside it (Kölbl's Z, A, B; rows / "
            "columns). Right: modulation transfer, and the curve that is expected after restoration, |MTF × response "
            "of the filter|. An exact inverse restores objects of whole pixels, which lifts the curve above 1."
        )
        parts.append(figure(plots.sharpness(part.axes), f"Sharpness, {part.name}", caption))
    if used.rows:
        parts.append(table(PART_HEAD, [_cells(row, 1) for row in used.rows[:_LISTED]]))
        if any(STANDS_FOR in row[3] for row in used.rows[:_LISTED]):
            parts.append(f"<p>{STANDS_FOR.strip()} too few edges; the other direction stands for this one.</p>")
        if len(used.rows) > _LISTED:
            parts.append(f"<p>{len(used.rows) - _LISTED} more rows; the filter file has them all.</p>")
    if used.facts:
        parts.append(table(("entry of the filter", "value"), [_cells(row, 2) for row in used.facts]))
    caption = "Weights, sections through the middle, and by what factor the filter changes the amplitude of waves."
    parts.append(figure(plots.filters(used.title, used.kernels), "Restoration filter", caption))
    for name, maps in used.maps:
        caption = "In each part of the field. A dash: too few edges; whole field or other direction stand for it."
        parts.append(figure(plots.field(maps), f"Over the field, {name}", caption))
    return parts


def _image(facts: RestoredFacts, plots: RestorePlots | None) -> list[str]:
    parts = [headline(facts.figures)]
    parts += [f"<p>{text(note)}</p>" for note in facts.notes]
    if plots is not None:
        caption = f"{facts.place}, where contrast is largest. Both have the same scale of grey values."
        parts.append(figure(plots.details(facts.before, facts.after), f"A detail of {facts.name}", caption))
        if facts.ends is not None:
            caption = "Grey values near the ends, all bands. The last class holds what was clipped."
            parts.append(figure(plots.ends(facts.ends), "Ends of the histogram", caption))
    parts.append(table(BAND_HEAD, [_cells(row, 1) for row in facts.bands]))
    if facts.chromatic:
        parts.append("<p>Lateral chromatic aberration, corrected before the filter:</p>")
        parts.append(table(CHROMATIC_HEAD, [_cells(row, 2) for row in facts.chromatic]))
    return parts


def _cells(row: Sequence[str], words: int) -> list[Cell]:
    return [Cell(value, number >= words) for number, value in enumerate(row)]

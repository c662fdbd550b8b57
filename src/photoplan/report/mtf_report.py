"""Report of MTF measurements as one HTML document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.report.mtf_plots import CellFacts, CurveFacts, EdgeFacts, MtfPlots, ProfileFacts
from photoplan.report.page import Cell, figure, headline, page, section, table, text

Array = NDArray[np.float64]

#: Images that get plots.
_PLOTTED = 30
#: Edges in a table.
_LISTED = 300


@dataclass(frozen=True, eq=False)
class MtfImageFacts:
    """What the report shows of an image."""

    name: str
    size: tuple[int, int]
    linearisation: str
    figures: tuple[tuple[str, str, str], ...]
    """Value, name, remark."""
    small: NDArray[np.uint8]
    edges: tuple[EdgeFacts, ...]
    groups: tuple[tuple[str, ...], ...]
    """Rows of the table of means."""
    rows: tuple[tuple[str, ...], ...]
    """Rows of the table of edges."""
    profiles: tuple[ProfileFacts, ...]
    means: tuple[CurveFacts, ...]
    channels: tuple[CurveFacts, ...]
    """Means of the channels, if there are several."""
    gaussian: tuple[Array, Array, str]
    lab: tuple[Array, Array] | None
    lab_rows: tuple[tuple[str, ...], ...]
    field: tuple[CellFacts, ...]
    rejected: str
    notes: tuple[str, ...]


GROUP_HEAD = ("edges of", "MTF50 cy/px", "95 % interval", "MTF10", "FWHM px", "Gaussian px", "rms", "edges")
EDGE_HEAD = ("no.", "channel", "column", "row", "direction", "angle °", "length", "contrast/noise", "MTF50",
             "95 % interval", "FWHM px", "over %", "under %")  # fmt: skip


def mtf_report(title: str, images: Sequence[MtfImageFacts], failed: dict[str, str], plots: MtfPlots) -> str:
    """The report as one HTML document."""
    parts = [_image(facts, plots if k < _PLOTTED else None) for k, facts in enumerate(images)]
    if failed:
        rows = [[Cell(name), Cell(reason)] for name, reason in failed.items()]
        parts.append(section("Images without result", [table(("image", "reason"), rows)]))
    return page(f"Sharpness: {title}", "Spread function and modulation transfer from edges", parts)


def _image(facts: MtfImageFacts, plots: MtfPlots | None) -> str:
    parts = [headline(facts.figures)]
    parts.append(f"<p>Linearisation: {text(facts.linearisation)}. Rejected: {text(facts.rejected or 'no edge')}.</p>")
    parts += [f"<p>{text(note)}</p>" for note in facts.notes]
    if plots is not None:
        parts += _plots(facts, plots)
    parts.append(table(GROUP_HEAD, [_row(row, 1) for row in facts.groups]))
    if facts.lab_rows:
        head = ("cycles per pixel", "laboratory", "measured", "difference")
        parts.append(table(head, [_row(row, 0) for row in facts.lab_rows]))
    parts.append(table(EDGE_HEAD, [_row(row, 2) for row in facts.rows[:_LISTED]]))
    return section(facts.name, parts)


def _row(row: Sequence[str], words: int) -> list[Cell]:
    return [Cell(value, k >= words) for k, value in enumerate(row)]


def _plots(facts: MtfImageFacts, plots: MtfPlots) -> list[str]:
    parts = [
        figure(
            plots.overview(facts.small, facts.size, facts.edges),
            f"Edges in {facts.name}",
            "Measured edges, coloured by the frequency at which their modulation has fallen to a half.",
        ),
        figure(
            plots.curves(facts.means, facts.gaussian, facts.lab),
            "Modulation transfer",
            "Means of the edges with two standard deviations, single edges in grey. x: brightness changes along the "
            "rows; y: along the columns. Beyond the Nyquist frequency the image holds aliasing, not detail.",
        ),
        figure(
            plots.profiles(facts.profiles),
            "Spread functions",
            "The edge with the smallest interval in each direction. Points: means of the pixels; band: 95 % interval.",
        ),
    ]
    if facts.channels:
        caption = "Means of each channel over all directions, with two standard deviations."
        parts.insert(2, figure(plots.curves(facts.channels, facts.gaussian, None), "Channels", caption))
    if facts.field:
        caption = "MTF50 by position in the image, half of its 95 % interval, and the number of edges."
        parts.append(figure(plots.field(facts.field), "Sharpness over the field", caption))
    return parts

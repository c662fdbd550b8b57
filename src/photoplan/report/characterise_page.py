"""Report of a camera's characterisation: figures, plots and tables of every analysis, and what could not be known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from photoplan.report.characterise_charts import Chart, ChartDrawer, Picture
from photoplan.report.page import Cell, figure, headline, page, section, table, text

#: Rows of a table that are shown; all of them are in CSV.
_ROWS = 25


@dataclass(frozen=True)
class SeriesFacts:
    """What the head of the report says."""

    name: str
    file: str
    frames: str
    size: str
    saturation: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class AnalysisPart:
    """What the report shows of an analysis."""

    title: str
    state: str
    """``done``, ``missing`` or ``failed``."""
    reason: str
    figures: tuple[tuple[str, str, str, str, str, str], ...]
    """What, of which plane and condition, value, sigma, unit, remark."""
    refused: tuple[str, ...]
    tables: tuple[tuple[str, tuple[str, ...], tuple[tuple[str | float | int, ...], ...]], ...]
    """Caption, head and rows."""
    plots: tuple[Chart | Picture, ...]
    notes: tuple[str, ...]


def characterise_page(facts: SeriesFacts, parts: Sequence[AnalysisPart], drawer: ChartDrawer) -> str:
    """The report as one HTML document."""
    done = [part for part in parts if part.state == "done"]
    refused = sum(len(part.refused) for part in done)
    head = headline(
        [
            (
                str(len(done)),
                "analysis" if len(done) == 1 else "analyses",
                ", ".join(part.title.lower() for part in done),
            ),
            (str(sum(len(part.figures) for part in done)), "figures", f"{refused} refused, with the reason"),
            (facts.saturation, "saturation DN", " · ".join(filter(None, [facts.frames, facts.size]))),
        ]
    )
    remarks = [f"<p>{text(note)}</p>" for note in facts.notes]
    others = [[part.title, part.state, part.reason] for part in parts if part.state != "done"]
    sections = [_section(part, drawer) for part in done]
    if others:
        sections.append(section("Not done", [table(("analysis", "state", "why"), others)]))
    parts_of_page = [head, *remarks, *sections]
    return page(f"Camera characterisation: {facts.name}", f"From the image series {facts.file}", parts_of_page)


def _section(part: AnalysisPart, drawer: ChartDrawer) -> str:
    found: list[str] = []
    if part.figures:
        rows = [
            [Cell(what), Cell(where), Cell(value, True), Cell(sigma and f"± {sigma}", True), Cell(unit), Cell(remark)]
            for what, where, value, sigma, unit, remark in part.figures
        ]
        found.append(table(("figure", "of", "value", "standard deviation", "unit", "remark"), rows))
    found += [f"<p><b>Not known.</b> {text(line)}</p>" for line in part.refused]
    found += [f"<p>{text(note)}</p>" for note in part.notes]
    found += [figure(drawer.draw(plot), plot.title, plot.caption) for plot in part.plots]
    for caption, head, rows_of in part.tables:
        shown = [k for k in range(len(head)) if any(row[k] != "" for row in rows_of)]
        cells = [[_cell(row[k]) for k in shown] for row in rows_of[:_ROWS]]
        cut = f". The first {_ROWS} of {len(rows_of)} lines; all are in the CSV tables."
        more = cut if len(rows_of) > _ROWS else ""
        if cells:
            found += [f"<p>{text(caption + more)}</p>", table([head[k] for k in shown], cells)]
    return section(part.title, found)


def _cell(value: str | float | int) -> Cell:
    if isinstance(value, str):
        return Cell(value)
    return Cell(f"{value:.5g}" if value == value else "–", True)

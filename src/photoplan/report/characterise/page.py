"""Report of a camera's characterisation: figures, plots and tables of every analysis, and what could not be known."""

from __future__ import annotations

from typing import Any

from photoplan.products.characterise.result import Figure, Outcome
from photoplan.products.characterise.run import CharacteriseReport
from photoplan.report.characterise.drawing import ChartDrawer
from photoplan.report.page import Cell, figure, headline, page, section, table, text

#: Rows of a table that are shown; all of them are in CSV.
_ROWS = 25


def characterise_page(made: CharacteriseReport, mpl: Any) -> str:
    """The report as one HTML document."""
    drawer, series = ChartDrawer(mpl), made.series
    done = [(run.analysis.title, run.outcome) for run in made.runs if run.outcome is not None]
    kinds = dict.fromkeys(frame.kind for frame in series.frames)
    frames = ", ".join(f"{len(series.of(kind))} {kind}" for kind in kinds) or f"{len(series.reduced)} reduced figures"
    size = [] if series.size is None else [f"{series.size[0]} × {series.size[1]} px, {series.dtype}"]
    refused = sum(len(outcome.refused) for _, outcome in done)
    head = headline(
        [
            (
                str(len(done)),
                "analysis" if len(done) == 1 else "analyses",
                ", ".join(title.lower() for title, _ in done),
            ),
            (str(sum(len(outcome.figures) for _, outcome in done)), "figures", f"{refused} refused, with the reason"),
            (
                ", ".join(dict.fromkeys(f"{level:.4g}" for level in made.levels)),
                "saturation DN",
                " · ".join([frames, *size]),
            ),
        ]
    )
    remarks = [f"<p>{text(note)}</p>" for note in made.notes]
    sections = [_section(title, outcome, drawer) for title, outcome in done]
    others = [[run.analysis.title, run.state, run.missing or run.failed or ""] for run in made.runs if not run.outcome]
    if others:
        sections.append(section("Not done", [table(("analysis", "state", "why"), others)]))
    title = f"Camera characterisation: {series.camera.name or series.path.stem}"
    return page(title, f"From the image series {series.path.name}", [head, *remarks, *sections])


def _section(title: str, outcome: Outcome, drawer: ChartDrawer) -> str:
    found: list[str] = []
    if outcome.figures:
        found.append(
            table(
                ("figure", "of", "value", "standard deviation", "unit", "remark"),
                [_figure_row(f) for f in outcome.figures],
            )
        )
    found += [f"<p><b>Not known.</b> {text(f'{what}: {why}')}</p>" for what, why in outcome.refused.items()]
    found += [f"<p>{text(note)}</p>" for note in outcome.notes]
    found += [figure(drawer.draw(plot), plot.title, plot.caption) for plot in outcome.plots]
    for name, each in outcome.tables.items():
        shown = [k for k in range(len(each.head)) if any(row[k] != "" for row in each.rows)]
        rows = [[_cell(row[k]) for k in shown] for row in each.rows[:_ROWS]]
        cut = f". The first {_ROWS} of {len(each.rows)} lines; all are in the CSV tables."
        more = cut if len(each.rows) > _ROWS else ""
        if rows:
            found += [f"<p>{text((each.caption or name) + more)}</p>", table([each.head[k] for k in shown], rows)]
    return section(title, found)


def _figure_row(found: Figure) -> list[Cell]:
    value, sigma, unit = found.texts
    where = " ".join(filter(None, [found.plane, found.at]))
    of_sigma = Cell(sigma and f"± {sigma}", True)
    return [Cell(found.label), Cell(where), Cell(value, True), of_sigma, Cell(unit), Cell(found.remark)]


def _cell(value: str | float | int) -> Cell:
    if isinstance(value, str):
        return Cell(value)
    return Cell(f"{value:.5g}" if value == value else "–", True)

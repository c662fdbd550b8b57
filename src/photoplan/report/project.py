"""Page of a project's quality report, and pictures of an error budget."""

from __future__ import annotations

import numpy as np

from photoplan.products.budget import PLACES, Budget, SourceTables
from photoplan.products.report import MOST_ROWS, ProjectReport
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    figure_of,
    findings_section,
    headline,
    page,
    png,
    section,
    shortened,
    styled,
    table,
    text,
)


def project_page(made: ProjectReport) -> str:
    """Return the report as one document."""
    old = sum(bool(each.old) for each in made.records)
    head = headline(
        [
            (
                str(len(made.records)),
                "run record" if len(made.records) == 1 else "run records",
                f"{old} of them old" if old else "all of the project as it is",
            ),
            (str(len(made.warnings)), "warning" if len(made.warnings) == 1 else "warnings", ""),
            (str(len(made.missing)), "gap" if len(made.missing) == 1 else "gaps", ", ".join(made.missing)),
        ]
    )
    rows = [
        *(("warning", each) for each in made.warnings),
        *(("missing", f"{what}: {why}") for what, why in made.missing.items()),
        *(("note", each) for each in made.notes),
    ]
    parts = [table(("kind", "message"), rows)] if rows else [f"<p>{text('None.')}</p>"]
    sources = [(each.name, each.path.name, each.when) for each in made.records]
    return page(
        f"Quality report: {made.title}",
        f"From {made.project.name} and the records of its runs",
        [
            head,
            section("Warnings, gaps and notes", parts),
            *(findings_section(each, MOST_ROWS) for each in made.sections),
            section("Source files", [table(("result", "run record", "finished"), sources)]) if sources else "",
        ],
    )


#: Contributions that are nowhere larger than this part of the total are not drawn.
_LEAST = 0.05
_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, SOFT)


@styled
def draw_picture(found: Budget | SourceTables) -> bytes | None:
    """Draw bars for each place, and the map of the total over the typical image; nothing for tables."""
    if isinstance(found, SourceTables):
        return None
    budget = found.typical
    fig = figure_of(8.6, 3.6)
    bars, area = fig.subplots(1, 2, width_ratios=(1.25, 1))
    places = np.arange(len(PLACES))
    drawn = {n: v for n, v in budget.parts.items() if (v > _LEAST * budget.total).any()}
    wide = 0.8 / (len(drawn) + 1)
    for k, (name, values) in enumerate(drawn.items()):
        bars.bar(places - 0.4 + (k + 0.5) * wide, values, wide * 0.9, label=name,
                 color=_COLOURS[k % len(_COLOURS)], hatch="//" * (k // len(_COLOURS)))  # fmt: skip
    bars.bar(places + 0.4 - 0.5 * wide, budget.total, wide * 0.9, label="total", color=INK)
    bars.set(xticks=places, xticklabels=PLACES, ylabel="standard deviation of position, m")
    bars.set_title(f"{shortened(budget.image, 30)}: contributions")
    bars.grid(axis="x", visible=False)
    bars.legend(fontsize=8, loc="upper left")
    shown = area.imshow(budget.map, cmap="cividis", extent=(0, 1, 1, 0), interpolation="bilinear")
    lines = area.contour(np.linspace(0, 1, budget.map.shape[1]), np.linspace(0, 1, budget.map.shape[0]),
                         budget.map, 5, colors="white", linewidths=0.7)  # fmt: skip
    area.clabel(lines, fmt="%.3g", fontsize=7)
    area.set(xticks=[], yticks=[], xlabel="over the image")
    area.set_title("total, m")
    fig.colorbar(shown, ax=area, shrink=0.9)
    return png(fig)

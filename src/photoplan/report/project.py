"""Page of a project's quality report: warnings and gaps first, then the sections in the order of the chain."""

from __future__ import annotations

from photoplan.products.report import MOST_ROWS, ProjectReport
from photoplan.report.findings import findings_section
from photoplan.report.page import headline, page, section, table, text


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

"""`photoplan characterise`: know a camera from image series."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import NEW_FOLDER, PATH, ending
from photoplan.cli.output import end_with_failures, say, show, show_json

if TYPE_CHECKING:
    from photoplan.products.characterise.run import AnalysisRun, CharacteriseReport


@click.command("characterise")
@click.argument("series", type=PATH, metavar="SERIES")
@click.option("--only", multiple=True, metavar="NAME", help="Run this analysis; may be repeated [all possible].")
@click.option("--report", type=PATH, metavar="FILE", help="Write an HTML report with plots.")
@click.option("--csv", type=NEW_FOLDER, metavar="FOLDER", help="Write the figures as tables.")
@ending("Say which analyses would run and what is missing for the others.")
def command(series: Path, as_json: bool, quiet: bool, **options: Any) -> None:
    """Know a camera from image series: noise, gain, linearity, dark signal, defects, light fall-off …

    SERIES is a TOML file that says which images are what (dark frames, flat frames, scenes …) and how they were
    exposed. Every analysis that they allow is made; the others are listed with what is missing.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.series import read_series
    from photoplan.io.store import recording
    from photoplan.products.characterise.run import CharacteriseRequest, characterise
    from photoplan.report.characterise import characterise_page
    from photoplan.report.page import open_report

    place = options.pop("report")
    inputs, request = read_series(series).inputs, CharacteriseRequest(series, **options)
    page = open_report(place, inputs, overwrite=options["overwrite"])
    with recording("characterise", request, [series, *inputs]) as record:
        with Telling(quiet) as events:
            report = characterise(request, events)
        written = report.written
        if page is not None and not options["dry_run"]:
            written = (page.write(characterise_page(report)), *written)
        record((*report.written, *written[: len(written) - len(report.written)]), report)
    if as_json:
        show_json(report, written=written)
    else:
        _print(report, written)
    _talk(report, options["dry_run"], quiet)
    end_with_failures(report.failed, sum(run.outcome is not None for run in report.runs), "analyses failed")


def _print(report: CharacteriseReport, written: tuple[Path, ...]) -> None:
    """Figures, refusals and paths on stdout."""
    for run in report.runs:
        if run.state == "possible":
            show(f"{run.analysis.name}: possible")
        if run.outcome is not None:
            show(run.analysis.title)
            for figure in run.outcome.figures:
                show(f"  {figure}")
            for what, why in run.outcome.refused.items():
                show(f"  not known: {what}: {why}")
    for path in written:
        show(path)


def _talk(report: CharacteriseReport, dry_run: bool, quiet: bool) -> None:
    """What was not done, and remarks, on stderr."""
    for note in report.notes:
        say(note)
    for run in report.runs:
        if run.missing is None or not quiet:
            for note in _notes(run):
                say(note)
    if quiet:
        return
    states = [run.state for run in report.runs]
    done = states.count("possible" if dry_run else "done")
    say(
        f"{len(report.series.frames)} frames, {len(report.series.reduced)} reduced figures: {done} analyses "
        f"{'possible' if dry_run else 'done'}, {states.count('missing')} lack data"
    )


def _notes(run: AnalysisRun) -> list[str]:
    if run.missing is not None:
        return [f"{run.analysis.name}: missing: {run.missing}"]
    return [] if run.outcome is None else [f"{run.analysis.name}: {note}" for note in run.outcome.notes]

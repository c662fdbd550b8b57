"""The part of `photoplan mtf` that measures test patterns: options, and what is printed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from photoplan.cli.mtf_output import say_files, say_images
from photoplan.cli.output import end_with_failures, talking

#: Options that speak of edges only, and those that speak of patterns only.
_OF_EDGES = {"lab", "flight", "grid", "most_edges", "least_length", "least_snr", "half_width"}
_OF_PATTERNS = {"sectors", "group", "levels", "coltman"}


def pattern_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of test patterns."""
    options = [
        click.option("--pattern", type=click.Choice(["bars", "star", "usaf"]), help="Measure a test pattern."),
        click.option("--sectors", type=click.IntRange(4, 360), metavar="N", help="Bright sectors of a star [counted]."),
        click.option("--group", type=click.IntRange(-6, 12), metavar="N", help="Largest group of a USAF target in it."),
        click.option(
            "--levels",
            type=float,
            nargs=2,
            metavar="LOW HIGH",
            help="Grey values of wide dark and bright areas beside bars or a star [found].",
        ),
        click.option("--coltman", is_flag=True, help="Bars: MTF by Coltman's series, too."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def edge_options(options: dict[str, Any]) -> dict[str, Any]:
    """Options of a call that measures edges; those of patterns are refused.

    Raises
    ------
    click.UsageError
        An option goes with ``--pattern``, which is not given.
    """
    _refuse(_OF_PATTERNS, "goes with --pattern")
    return {name: value for name, value in options.items() if name not in {"pattern", *_OF_PATTERNS}}


def run_patterns(images: tuple[Path, ...], as_json: bool, quiet: bool, options: dict[str, Any]) -> None:
    """Measure the patterns of images and print what was found.

    Raises
    ------
    click.UsageError
        An option is for edges.
    """
    from photoplan.products.mtf.patterns import PatternRequest, measure_patterns
    from photoplan.report.mtf.patterns import pattern_page
    from photoplan.report.page import open_report

    _refuse(_OF_EDGES, f"is for edges, not for --pattern {options['pattern']}")

    talk = talking(quiet)
    inputs = [*images, options["linearisation"]]
    page = open_report(options.pop("report"), inputs, overwrite=options["overwrite"], table=options["csv"])
    kept = {name: value for name, value in options.items() if name not in _OF_EDGES}
    report = measure_patterns(PatternRequest(images, **kept), talk)
    written = page.write(pattern_page(report, page.mpl)) if page is not None and report.images else None
    say_images(report, written, as_json, talk)
    if not as_json:
        say_files(report, written)
    end_with_failures(report.failed, len(report.images))


def _refuse(names: set[str], why: str) -> None:
    """Refuse options that were typed and do not belong here."""
    context = click.get_current_context()
    for parameter in context.command.params:
        typed = context.get_parameter_source(str(parameter.name)) is click.core.ParameterSource.COMMANDLINE
        if parameter.name in names and typed:
            raise click.UsageError(f"{parameter.opts[0]} {why}")

"""`photoplan mtf`: spread function and MTF of images from edges, and from test patterns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.output import end_with_failures, say, show, show_json, talking


class _MeasuredImage(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def notes(self) -> tuple[str, ...]: ...


class _Report(Protocol):
    @property
    def images(self) -> Sequence[_MeasuredImage]: ...
    @property
    def csv(self) -> Path | None: ...


def say_images(report: _Report, page: Path | None, as_json: bool) -> None:
    """The figures of every image on stdout, or all as JSON; notes on stderr."""
    if as_json:
        show_json(report, report=page)
    for image in report.images:
        if not as_json:
            show(image)
        for note in image.notes:
            say(f"{image.name}: {note}")


def say_files(report: _Report, page: Path | None) -> None:
    """The files that were written."""
    for path in (report.csv, page):
        if path is not None:
            show(path)


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
    """Options of a call that measures edges; those of patterns are refused."""
    _refuse(_OF_PATTERNS, "goes with --pattern")
    return {name: value for name, value in options.items() if name not in {"pattern", *_OF_PATTERNS}}


def run_patterns(images: tuple[Path, ...], as_json: bool, quiet: bool, options: dict[str, Any]) -> None:
    """Measure the patterns of images and print what was found."""
    from photoplan.io.store import recording
    from photoplan.products.mtf.patterns import PatternRequest, measure_patterns
    from photoplan.report.mtf import pattern_page
    from photoplan.report.page import open_report

    _refuse(_OF_EDGES, f"is for edges, not for --pattern {options['pattern']}")

    talk = talking(quiet)
    inputs = [*images, options["linearisation"]]
    page = open_report(options.pop("report"), inputs, overwrite=options["overwrite"], table=options["csv"])
    kept = {name: value for name, value in options.items() if name not in _OF_EDGES}
    request = PatternRequest(images, **kept)
    with recording("mtf", request, inputs) as record:
        report = measure_patterns(request, talk)
        written = page.write(pattern_page(report)) if page is not None and report.images else None
        record([report.csv, written], report)
    say_images(report, written, as_json)
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


@click.command("mtf")
@click.argument("images", nargs=-1, required=True, type=PATH, metavar="IMAGE…")
@click.option("--roi", "rois", type=int, nargs=4, multiple=True, metavar="COL ROW WIDTH HEIGHT",
              help="Window with one edge; may be repeated [edges are sought in the whole image].")  # fmt: skip
@pattern_options
@click.option("--linearisation", metavar="linear|srgb|TABLE", help="How grey values become light [linear].")
@click.option("--band", metavar="N|all", help="Band, or luminance and every band [luminance, or the only band].")
@click.option("--pixel-size", "pixel_um", type=float, metavar="UM", help="On the sensor, for cycles/mm.")
@click.option("--lab", type=PATH, metavar="FILE", help="MTF values of a laboratory to compare.")
@click.option("--flight", type=click.Choice(["x", "y"]), help="Flight direction along rows (x) or columns (y).")
@click.option("--grid", type=int, default=3, show_default=True, metavar="N", help="Cells of the field, each way.")
@click.option("--most-edges", type=int, default=60, show_default=True, metavar="N", help="Measured in an image.")
@click.option("--least-length", type=click.FloatRange(8.0, 10_000.0), metavar="PX",
              help="Of an edge [20, with --roi 12].")  # fmt: skip
@click.option("--half-width", type=int, default=20, show_default=True, metavar="PX",
              help="Largest distance from the edge that is used.")  # fmt: skip
@click.option("--least-snr", type=click.FloatRange(3.0, 1e6), default=8.0, show_default=True, metavar="R",
              help="Contrast of an edge over its noise.")  # fmt: skip
@click.option("--report", type=PATH, metavar="FILE.html", help="Report with plots.")
@click.option("--csv", type=PATH, metavar="FILE", help="A row for each edge.")
@ending()
def command(images: tuple[Path, ...], as_json: bool, quiet: bool, **options: Any) -> None:
    """Measure sharpness: edges are found, or given by --roi, and their spread function and MTF measured.

    With --pattern a test pattern is measured instead: bars (a window for each frequency group), a Siemens star, or a
    USAF-1951 target.

    An image that fails does not stop the others; they are listed at the end (exit code 4). No figure is given for an
    edge that is saturated, noisy, or has texture beside it.
    """
    if options["pattern"] is not None:
        run_patterns(images, as_json, quiet, options)
        return
    from photoplan.cli.telling import Telling
    from photoplan.io.store import recording
    from photoplan.products.mtf.edges import MtfRequest, measure_mtf
    from photoplan.products.mtf.result import group_lines
    from photoplan.report.mtf import mtf_page
    from photoplan.report.page import open_report

    inputs = [*images, options["linearisation"], options["lab"]]
    page = open_report(options.pop("report"), inputs, overwrite=options["overwrite"], table=options["csv"])
    request = MtfRequest(images, **edge_options(options))
    with recording("mtf", request, inputs) as record:
        with Telling(quiet) as events:
            report = measure_mtf(request, events)
        written = page.write(mtf_page(report)) if page is not None and report.images else None
        record([report.csv, written], report)
    say_images(report, written, as_json)
    if len(report.images) > 1:
        if not as_json:
            show(f"all {len(report.images)} images\n{group_lines(report.groups)}")
        if report.enhancement is not None and report.enhancement.enhanced:
            say(f"all images: {report.enhancement.warning}")
    if not as_json:
        say_files(report, written)
    end_with_failures(report.failed, len(report.images))

"""`photoplan mtf`: spread function and MTF of images from edges, and from test patterns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.mtf_output import say_files, say_images
from photoplan.cli.mtf_patterns import edge_options, pattern_options, run_patterns
from photoplan.cli.options import json_option
from photoplan.cli.output import end_with_failures, show, talking


@click.command("mtf")
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="IMAGE…")
@click.option("--roi", "rois", type=int, nargs=4, multiple=True, metavar="COL ROW WIDTH HEIGHT",
              help="Window with one edge; may be repeated [edges are sought in the whole image].")  # fmt: skip
@pattern_options
@click.option("--linearisation", metavar="linear|srgb|TABLE", help="How grey values become light [linear].")
@click.option("--band", metavar="N|all", help="Band, or luminance and every band [luminance, or the only band].")
@click.option("--pixel-size", "pixel_um", type=float, metavar="UM", help="On the sensor, for cycles/mm.")
@click.option("--lab", type=click.Path(path_type=Path), metavar="FILE", help="MTF values of a laboratory to compare.")
@click.option("--flight", type=click.Choice(["x", "y"]), help="Flight direction along rows (x) or columns (y).")
@click.option("--grid", type=int, default=3, show_default=True, metavar="N", help="Cells of the field, each way.")
@click.option("--most-edges", type=int, default=60, show_default=True, metavar="N", help="Measured in an image.")
@click.option("--least-length", type=click.FloatRange(8.0, 10_000.0), metavar="PX",
              help="Of an edge [20, with --roi 12].")  # fmt: skip
@click.option("--half-width", type=int, default=20, show_default=True, metavar="PX",
              help="Largest distance from the edge that is used.")  # fmt: skip
@click.option("--least-snr", type=click.FloatRange(3.0, 1e6), default=8.0, show_default=True, metavar="R",
              help="Contrast of an edge over its noise.")  # fmt: skip
@click.option("--report", type=click.Path(path_type=Path), metavar="FILE.html", help="Report with plots.")
@click.option("--csv", type=click.Path(path_type=Path), metavar="FILE", help="A row for each edge.")
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@json_option
@click.option("-q", "--quiet", is_flag=True, help="No talk on stderr.")
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
    from photoplan.products.mtf.result import group_lines
    from photoplan.products.mtf.run import MtfRequest, measure_mtf
    from photoplan.report.mtf.page import mtf_page
    from photoplan.report.page import open_report

    talk = talking(quiet)
    inputs = [*images, options["linearisation"], options["lab"]]
    page = open_report(options.pop("report"), inputs, overwrite=options["overwrite"], table=options["csv"])
    request = MtfRequest(images, **edge_options(options))
    with Telling(quiet) as events:
        report = measure_mtf(request, events)
    written = page.write(mtf_page(report, page.mpl)) if page is not None and report.images else None
    say_images(report, written, as_json, talk)
    if len(report.images) > 1:
        if not as_json:
            show(f"all {len(report.images)} images\n{group_lines(report.groups)}")
        if report.enhancement is not None and report.enhancement.enhanced:
            talk(f"all images: {report.enhancement.warning}")
    if not as_json:
        say_files(report, written)
    end_with_failures(report.failed, len(report.images))

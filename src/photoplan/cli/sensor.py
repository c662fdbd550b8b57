"""`photoplan sensor`: figures of a sensor from its description."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.output import say, show, show_json


@click.command("sensor")
@click.argument("file", type=PATH, metavar="FILE")
@click.option("--report", type=PATH, metavar="HTML", help="Figures and plots as a page.")
@click.option("--csv", type=PATH, metavar="CSV", help="Figures as a table.")
@ending("Print the figures, write nothing.")
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Resolution, bandwidth, charge transfer and noise of the sensor that FILE (TOML) describes."""
    from photoplan.io.store import recording
    from photoplan.products.sensor import SensorRequest, describe_sensor
    from photoplan.report.page import open_report
    from photoplan.report.sensor import sensor_page

    overwrite, table = options["overwrite"], options["csv"]
    page = open_report(options.pop("report"), [options["file"]], overwrite=overwrite, table=table)
    request = SensorRequest(**options)
    with recording("sensor", request, [request.file]) as record:
        found = describe_sensor(request)
        report = None if page is None or options["dry_run"] else page.write(sensor_page(found))
        written = [path for path in (report, found.csv) if path is not None]
        record(reversed(written), found)
    if as_json:
        show_json(found, written=written)
    else:
        show(found)
        for path in written:
            show(path)
    differing = [f for f in found.figures if f.stated is not None and abs(f.value - f.stated) > 0.01 * abs(f.stated)]
    if not quiet:
        for figure in differing:
            say(f"{figure.name}: {figure.value:.4g} by {figure.source}; {figure.stated:g} is stated")

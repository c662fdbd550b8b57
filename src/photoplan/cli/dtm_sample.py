"""`photoplan dtm sample`: heights at points."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.output import say, show, show_json


@click.command("sample")
@click.argument("model", type=PATH)
@click.argument("points", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, metavar="CSV", help="What to write.")
@click.option("--x", metavar="NAME", help="Column of X, by name or number [x, east, easting].")
@click.option("--y", metavar="NAME", help="Column of Y [y, north, northing].")
@click.option("--delimiter", help="Comma, semicolon, tab or space [the one that splits the first line].")
@click.option("--decimal-comma", is_flag=True, help="Numbers are written 1,5.")
@click.option("--no-header", is_flag=True, help="The first line is a point; columns are numbers, X and Y 1 and 2.")
@click.option("--names", nargs=2, default=("height", "sigma"), metavar="HEIGHT SIGMA", help="Names of the new columns.")
@click.option("--digits", type=click.IntRange(0, 9), default=4, show_default=True, help="Decimals of the heights.")
@click.option("--points-crs", metavar="CRS", help="CRS of the points [the model's].")
@click.option("--crs", help="CRS of a terrain file that does not state it.")
@ending()
def command(
    x: str | None,
    y: str | None,
    delimiter: str | None,
    decimal_comma: bool,
    no_header: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Height of MODEL and its standard deviation at each of POINTS, a CSV file: its columns, `height` and `sigma`.

    Both are empty where there is no model; a raster has no sigma.
    """
    from photoplan.geometry.crs import crs_label
    from photoplan.geometry.heights import height_label
    from photoplan.io.run_record import recording
    from photoplan.io.tables import Dialect
    from photoplan.io.terrain.points import PointTableFormat
    from photoplan.products.dtm.sample import SampleRequest, dtm_sample

    spelled = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "space": " "}
    dialect = Dialect(delimiter=spelled.get(delimiter or "", delimiter), decimal_comma=decimal_comma)
    form = PointTableFormat(x, y, dialect, not no_header)
    request = SampleRequest(form=form, **options)
    with recording("sample", request, [request.model, request.points]) as record:
        found = dtm_sample(request)
        record([found.path], found)
    if as_json:
        show_json(found)
        return
    show(found.path)
    if not quiet:
        sigma = f", sigma {found.sigma:.3f} m" if found.sigma == found.sigma else ""
        heights = f" · {found.low:.3f} to {found.high:.3f} m{sigma}" if found.outside < found.points else ""
        say(
            f"{found.points} points, {found.outside} without a model{heights} · {crs_label(found.crs)} · "
            f"heights {height_label(found.height_system)}"
        )

"""`photoplan dtm refine`: a finer model inside polygons."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, POSITIVE, ending
from photoplan.cli.output import say, show, show_json


@click.command("refine")
@click.argument("coarse", type=PATH)
@click.argument("fine", type=PATH)
@click.option("--polygons", type=PATH, required=True, metavar="FILE", help="Where the fine model counts.")
@click.option("--transition", type=click.FloatRange(0), required=True, metavar="M",
              help="Width of the band inside the polygons in which the two are joined.")  # fmt: skip
@click.option("--width", type=POSITIVE, metavar="M",
              help="Largest grid width inside the polygons [the fine model's finest].")  # fmt: skip
@click.option("--crs", metavar="EPSG", help="CRS of rasters that state none.")
@click.option("--height-system", metavar="same", help="Declare that both models have the same height system.")
@click.option("-o", "--output", type=PATH, required=True, metavar="MODEL", help="The new model, a .gpkg.")
@ending()
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Write the terrain COARSE with the terrain FINE inside polygons, joined without a step.

    Both are terrain models or rasters of heights. Each mesh is divided by a whole number. Inside a band along the
    polygons' border the difference of the two is blended in; outside nothing changes.
    """
    from photoplan.io.run_record import recording
    from photoplan.products.dtm.refine import RefineRequest, dtm_refine

    request = RefineRequest(**options)
    with recording("refine", request, [request.coarse, request.fine, request.polygons]) as record:
        found = dtm_refine(request)
        record([found.path], found)
    if as_json:
        show_json(found)
        return
    show(found.path)
    if not quiet:
        change = f", largest change of a post {found.largest:.3f} m" if found.largest == found.largest else ""
        say(f"{found.changed} of {found.units} units are new{change}; {found.lines} lines")

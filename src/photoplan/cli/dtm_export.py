"""`photoplan dtm export`: a terrain model for other programs."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, POSITIVE, bounds_option, ending
from photoplan.cli.output import say, show, show_json


@click.command("export")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="What to write, by its suffix.")
@click.option("--resolution", type=POSITIVE, metavar="R", help="Of a raster [finest width].")
@bounds_option
@click.option("--sigma", type=PATH, metavar="TIF", help="Write the standard deviations too.")
@click.option("--crs", help="CRS of a terrain file that does not state it.")
@ending(workers=True)
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Write MODEL as a raster (.tif), a triangulation (.obj, .ply, .xml = LandXML) or points (.xyz, .csv).

    Triangulations hold walls as vertical triangles (LandXML cannot); points are the posts and the lines' vertices.
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.dtm.export import ExportRequest, dtm_export

    request = ExportRequest(**options)
    with Telling(quiet) as events:
        found = dtm_export(request, events)
    if as_json:
        show_json(found)
        return
    for path in found.paths:
        show(path)
    if not quiet:
        say(" · ".join(f"{k.replace('_', ' ')} {v:.6g}" for k, v in found.figures.items()))

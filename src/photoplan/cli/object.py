"""`photoplan object`: single objects, each from above and without what is around it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import LISTED, PATH, PROJECT, choosing_options, executing, product_options, weights


@click.command("object")
@click.argument("project", type=PROJECT)
@click.argument("polygons", type=PATH)
@product_options
@choosing_options
@click.option("--objects", metavar="NAME,…", **LISTED,
              help="Objects of the file, or patterns; may be repeated [all].")  # fmt: skip
@click.option("--below", is_flag=True, help="Also what lies below each object: NAME_below.tif.")
@click.option("--layer", help="Layer of the file, or type of CityJSON's objects.")
@click.option("--crs", metavar="CRS", help="Of a file that states none.")
@click.option("--height-system", metavar="NAME", help="Of its heights; same: that of the terrain.")
@click.option("--offset", type=float, nargs=3, default=None, metavar="X Y Z", help="Added to all coordinates, metres.")
@click.option("--sigma", type=float, nargs=2, default=None, metavar="XY Z", help="Its standard deviations, metres.")
@executing
def command(project: Path, polygons: Path, score: tuple[str, ...], prefer: tuple[str, ...], **options: Any) -> None:
    """Make a product of each object in POLYGONS alone: NAME_object.tif, its pixels and no others.

    POLYGONS holds polygons with heights (GeoPackage, GeoJSON, Shapefile, DXF), CityJSON, or a mesh. Each pixel is taken
    from the best image that sees it. The same command continues a run that was interrupted.
    """
    from photoplan.cli import running
    from photoplan.io.project.file import load_project
    from photoplan.io.project.model import Objects
    from photoplan.products.orthophoto.mosaic import plan_objects
    from photoplan.products.orthophoto.plan import Choice

    names = ("layer", "crs", "height_system", "offset", "sigma")
    stated = {name: value for name in names if (value := options.pop(name)) is not None}
    plan = partial(plan_objects, polygons=Objects(file=str(polygons.absolute()), **stated))
    choice = Choice(weights=weights(score), prefer=prefer)
    how = running.How.from_options(options)
    with running.telling(how) as events:
        running.make_products(load_project(project), plan, {**options, "choice": choice}, how, events)

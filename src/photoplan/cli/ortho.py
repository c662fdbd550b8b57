"""`photoplan ortho`: orthophotos of a project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PROJECT, executing, product_options


@click.command("ortho")
@click.argument("project", type=PROJECT)
@product_options
@click.option("--true/--ground", "true", default=None, help="Show objects where they stand, or the ground [ground].")
@click.option("--method", help="indirect, or direct: pixels of the image are carried to the ground [indirect].")
@click.option("--fill", type=int, metavar="PX", help="Fill gaps of the direct method from pixels this near [0].")
@click.option("--stack", metavar="NAME", help="Show all orthophotos as bands of one raster, NAME.vrt.")
@executing
def command(project: Path, **options: Any) -> None:
    """Make an orthophoto of each image: NAME_ortho.tif (a cloud-optimised GeoTIFF) and its run record.

    The same command continues a run that was interrupted.
    """
    from photoplan.cli import running
    from photoplan.io.project.file import load_project
    from photoplan.products.orthophoto.plan import plan_orthophotos

    how = running.How.from_options(options)
    with running.telling(how) as events:
        running.make_products(load_project(project), plan_orthophotos, options, how, events)

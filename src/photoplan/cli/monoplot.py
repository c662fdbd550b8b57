"""`photoplan monoplot`: ground points from one image and the terrain."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, PROJECT, ending
from photoplan.cli.output import say, show, show_json


@click.command("monoplot")
@click.argument("project", type=PROJECT)
@click.argument("image")
@click.argument("points", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, metavar="CSV", help="Ground points.")
@click.option("--vectors", type=PATH, metavar="GPKG", help="Points or lines in space as well.")
@click.option("--gis-axes", is_flag=True, help="Vectors drawn in a GIS: (0, 0) is the image's corner, y points up.")
@click.option("--sigma-image", type=float, default=0.5, show_default=True, help="Of image coordinates, pixels.")
@click.option("--sigma-terrain", type=float, help="Of terrain heights, metres [the model's own].")
@click.option("--sigma-position", type=float, nargs=3, default=(0, 0, 0), help="Of the projection centre, metres [0].")
@click.option("--sigma-angles", type=float, nargs=3, default=(0, 0, 0), help="Of ω φ κ, in the project's unit [0].")
@ending()
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Ground points of image points, with standard deviations.

    POINTS is a table with columns x, y (pixels; the middle of the upper-left one is 0, 0), or a vector file with
    points or lines in pixels. Points whose ray meets no terrain keep their row, with the reason.
    """
    from photoplan.products.monoplot import MonoplotRequest, monoplot_file

    found = monoplot_file(MonoplotRequest(**options))
    if as_json:
        show_json(found)
        return
    show(found.output)
    if found.vectors is not None:
        show(found.vectors)
    show(f"{found.met} of {found.points} points on the ground")
    for reason, count in found.reasons.items():
        show(f"  {count} without: {reason}")
    if found.grazing or found.through_holes:
        show(f"  {found.grazing} under less than 5° to the terrain, {found.through_holes} through holes")
    if found.median_sigma is not None:
        X, Y, Z = found.median_sigma
        show(f"median standard deviation X {X:.3f} Y {Y:.3f} Z {Z:.3f} m")
    if not quiet:
        say(f"height system: {found.height_system}")
    for note in found.notes:
        say(note)

"""`photoplan budget`: what limits the accuracy of products."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, PROJECT, ending, images_option
from photoplan.cli.output import say, show, show_json


@click.command("budget")
@click.argument("project", required=False, type=PROJECT)
@images_option()
@click.option("--camera-constant", type=float, metavar="MM", help="Camera constant of a vertical image, no project.")
@click.option("--height", type=float, metavar="M", help="Its flying height above ground.")
@click.option("--format", type=float, nargs=2, default=(230.0, 230.0), metavar="MM MM", help="Its sides [230 230].")
@click.option("--pixel", type=float, default=15.0, metavar="UM", help="Side of its pixels, µm [15].")
@click.option("--sigma-terrain", type=float, metavar="M", help="Standard deviation of heights [the project's].")
@click.option("--sigma-center", type=float, nargs=3, default=None, metavar="X Y Z", help="Of centres, metres.")
@click.option("--sigma-angles", type=float, nargs=3, default=None, metavar="A B C", help="Of angles.")
@click.option("--angle-unit", type=click.Choice(["deg", "gon", "rad"]), default="gon", help="Without a project [gon].")
@click.option("--kernel", default="bicubic", help="Resampling kernel [bicubic].")
@click.option("--tolerance", type=float, default=0.02, metavar="PX", help="Largest residual of the anchors [0.02].")
@click.option("--tables", is_flag=True, help="Print the tables and examples of Ecker 1991 instead.")
@click.option("--picture", type=PATH, metavar="PNG", help="Contributions, and a map of the total.")
@ending()
def command(tables: bool, picture: Path | None, overwrite: bool, as_json: bool, quiet: bool, **options: Any) -> None:
    """Standard deviations of position on level ground, cause by cause, in the middle, at the edge and in the corner.

    For the images of PROJECT, or for a vertical image by numbers: --camera-constant and --height.
    """
    from photoplan.products.budget import BudgetRequest, make_budget, source_tables

    tell = show_json if as_json else show
    if tables:
        tell(source_tables())
        return
    options["images"] = options["images"] or None
    request = BudgetRequest(**options)
    if picture is not None:
        from photoplan.io.product import check_output
        from photoplan.report.drawing import load_matplotlib

        check_output(picture, [request.project] if request.project else [], overwrite=overwrite)
        load_matplotlib("a picture of a budget", "leave `picture` out")
    found = make_budget(request)
    if picture is not None:
        from photoplan.io.store import write_atomically
        from photoplan.report.budget import draw_picture

        write_atomically(picture, draw_picture(found.typical))
    tell(found)
    for note in found.notes:
        say(f"note: {note}")

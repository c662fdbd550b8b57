"""`photoplan seams`: where the images of a mosaic are best joined."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, PROJECT, ending, images_option
from photoplan.cli.output import can_draw, say, show, show_json, talking


@click.command("seams")
@click.argument("project", type=PROJECT)
@images_option()
@click.option("--resolution", type=float, metavar="R", help="Seams run along pixels of R metres [256 across an image].")
@click.option("--keep", type=PATH, metavar="FILE", help="Regions with their images that stay as they are.")
@click.option("-o", "--output", type=PATH, metavar="FILE", help="[products/seams.gpkg by the project]")
@click.option("--no-picture", is_flag=True, help="Do not draw the regions.")
@ending("Look at the images and stop.", workers=True, executor=True, memory=True)
def command(as_json: bool, quiet: bool, no_picture: bool, **options: Any) -> None:
    """Find seams between the images of PROJECT where they are least seen.

    They run where two images show the same, around what stands out of the ground. The regions are a GeoPackage with a
    column `image`, which `photoplan mosaic --seams` takes and QGIS edits.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.naming import together
    from photoplan.products.seams.run import SeamsRequest, make_seams
    from photoplan.project.scene import refuse_unusable
    from photoplan.report.maps import draw_regions

    request = SeamsRequest(**options)
    picture = None
    with together():
        with Telling(quiet) as events:
            found = make_seams(request, events)
        if found.path is not None and found.shapes and can_draw(not no_picture, talking(quiet)):
            picture = draw_regions(found.path.with_suffix(".png"), found.shapes, "Images of the mosaic")
    if as_json:
        show_json(found, picture=picture)
    elif found.path is None or found.differences is None or found.shapes is None:
        grid = found.survey.grid
        show(f"{len(found.survey.names)} images on {grid.width} × {grid.height} pixels of {grid.resolution:g} m")
    else:
        show(found.path)
        if picture is not None:
            show(picture)
        halfway, best = found.differences
        along = "no seams"
        if best is not None and halfway is not None:
            along = f"fine detail of the two images along seams differs by {best:.2f} grey values"
            along += f", halfway between them by {halfway:.2f}"
        joined = f"{len(found.shapes)} of {len(found.survey.names)} images joined"
        show(f"{joined} at {found.survey.grid.resolution:g} m · {along}")
    for note in found.notes:
        say(note)
    refuse_unusable(found.unusable, len(found.survey.names) + len(found.survey.blind))

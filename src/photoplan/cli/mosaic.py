"""`photoplan mosaic`: one orthophoto of many images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, PROJECT, choosing_options, executing, product_options, weights


@click.command("mosaic")
@click.argument("project", type=PROJECT)
@product_options
@click.option("--name", default="mosaic", show_default=True, help="Of the product's files.")
@choosing_options
@click.option("--seams", type=PATH, metavar="FILE",
              help="Regions with their images, that come before the score: an edited NAME_seams.gpkg.")  # fmt: skip
@click.option("--feather", type=float, default=0.0, metavar="W",
              help="Images pass into each other along seams, over W metres, where both see [0].")  # fmt: skip
@click.option("--blend", type=click.Choice(["mean", "multiband"]), default="mean", show_default=True,
              help="All detail passes over the width, or fine detail at the seam and coarse over W.")  # fmt: skip
@click.option("--sheets", metavar="SIZE|FILE",
              help="Cut into squares of SIZE metres or polygons, with STAC items; NAME.vrt shows all.")  # fmt: skip
@executing
def command(project: Path, name: str, score: tuple[str, ...], prefer: tuple[str, ...], seams: Path | None,
            feather: float, blend: Any, sheets: str | None, **options: Any) -> None:  # fmt: skip
    """Make one orthophoto of all images: each pixel from the best of those that see it.

    What no image sees is left empty and told in square metres. The same command continues a run that was interrupted.
    """
    from photoplan.cli import running
    from photoplan.io.project.file import load_project
    from photoplan.products.orthophoto.mosaic import plan_mosaic
    from photoplan.products.orthophoto.plan import Choice

    choice = Choice(
        name=name,
        weights=weights(score),
        prefer=prefer,
        seams=None if seams is None else str(seams.absolute()),
        feather=feather,
        blend=blend,
        sheets=None if sheets is None else _sheets(sheets),
    )
    how = running.How.from_options(options)
    with running.telling(how) as events:
        running.make_products(load_project(project), plan_mosaic, {**options, "choice": choice}, how, events)


def _sheets(given: str) -> float | str:
    """A size, or the path of a file."""
    try:
        return float(given)
    except ValueError:
        return str(Path(given).absolute())

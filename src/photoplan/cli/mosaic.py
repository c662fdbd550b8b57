"""`photoplan mosaic`: one orthophoto of many images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, executing, listed, product_options

_PENALTIES = ("slant", "coarseness", "border", "occlusion")


@click.command("mosaic")
@click.argument("project", type=PATH)
@product_options
@click.option("--name", default="mosaic", show_default=True, help="Of the product's files.")
@click.option("--score", metavar="NAME=WEIGHT,…", multiple=True, callback=lambda c, p, values: listed(values),
              help=f"Weights of {', '.join(_PENALTIES)} [1, 1, 1, 0.5].")  # fmt: skip
@click.option("--prefer", metavar="NAME,…", multiple=True, callback=lambda c, p, values: listed(values),
              help="Images that come first wherever they see the ground.")  # fmt: skip
@click.option("--sources", is_flag=True, help="Also which image painted each pixel: NAME_sources.tif, NAME_seams.gpkg.")
@click.option("--seams", type=PATH, metavar="FILE",
              help="Regions with their images, that come before the score: an edited NAME_seams.gpkg.")  # fmt: skip
@executing
def command(project: Path, name: str, score: tuple[str, ...], prefer: tuple[str, ...], seams: Path | None,
            **options: Any) -> None:  # fmt: skip
    """Make one orthophoto of all images: each pixel from the best of those that see it.

    What no image sees is left empty and told in square metres. The same command continues a run that was interrupted.
    """
    from photoplan.cli import running
    from photoplan.io.project.file import load_project
    from photoplan.products.orthophoto.mosaic import plan_mosaic
    from photoplan.products.orthophoto.settings import Choice

    choice = Choice(name, _weights(score), prefer, None if seams is None else str(seams.resolve()))
    how = running.How.from_options(options)
    with running.telling(how) as events:
        running.planned(load_project(project), plan_mosaic, {**options, "choice": choice}, how, events)()


def _weights(given: tuple[str, ...]) -> Any:
    """Weights of the score from NAME=WEIGHT."""
    from photoplan.plan.choice import Weights

    values: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            name = ""
        if name not in _PENALTIES:
            raise click.BadParameter(f"{text!r}; write NAME=WEIGHT with {', '.join(_PENALTIES)}", param_hint="--score")
    return Weights(**values)

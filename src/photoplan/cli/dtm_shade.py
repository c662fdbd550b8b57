"""`photoplan dtm shade`: hillshade of a terrain model."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import PATH, POSITIVE, bounds_option, ending, several
from photoplan.cli.output import say, show, show_json

if TYPE_CHECKING:
    from photoplan.products.dtm.shading import ShadingFacts


#: Model, grid, output and run of every picture of a terrain.
picture_options = several(
    click.argument("model", type=PATH),
    click.option("--resolution", type=POSITIVE, metavar="R", help="Pixel in metres [the model's mesh width]."),
    bounds_option,
    click.option("--crs", help="CRS of a model that does not state it."),
    click.option("-o", "--output", type=PATH, required=True, metavar="TIF", help="The GeoTIFF."),
    click.option("--preview", type=PATH, metavar="PNG", help="A small picture to look at, too."),
    ending(workers=True),
)


#: Where the light comes from.
light_options = several(
    click.option("--azimuth", type=float, default=315.0, show_default=True, help="Sun, degrees from north."),
    click.option("--altitude", type=float, default=45.0, show_default=True, help="Sun above horizon, degrees."),
    click.option("--exaggeration", type=float, default=1.0, show_default=True, help="Factor of heights."),
    click.option("--multidirectional", is_flag=True, help="Four suns instead of one."),
)


def take_light(options: dict[str, Any]) -> Any:
    """The light, taken out of the options of a verb."""
    from photoplan.terrain.shading import Lighting

    names = ("azimuth", "altitude", "exaggeration", "multidirectional")
    return Lighting(**{name: options.pop(name) for name in names})


def take_request(options: dict[str, Any]) -> Any:
    """The request, taken out of the options of a verb."""
    from photoplan.products.dtm.shading import PictureRequest

    names = ("model", "output", "resolution", "bounds", "crs", "preview", "overwrite", "workers")
    return PictureRequest(**{name: options.pop(name) for name in names})


def report_picture(make: Callable[[Any], ShadingFacts], as_json: bool, quiet: bool) -> None:
    """Make a picture, and print what came of it."""
    from photoplan.cli.telling import Telling

    with Telling(quiet) as events:
        facts = make(events)
    if as_json:
        show_json(facts)
        return
    show(facts.path)
    if facts.preview is not None:
        show(facts.preview)
    if not quiet:
        grid, settings = facts.grid, ", ".join(f"{k} {v}" for k, v in facts.settings.items() if k != "ramp_colours")
        say(
            f"{facts.kind}: {grid.width} × {grid.height} pixels of {grid.resolution:g} m, {facts.valid_share:.1%} with "
            f"terrain; {settings}"
        )


@click.command("shade")
@picture_options
@light_options
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Hillshade: grey values 1 to 255, 0 where MODEL has no terrain.

    Slopes are those of the model's surface at each pixel, so breaklines stay sharp.
    """
    from photoplan.products.dtm.shading import make_picture, shade_picture

    picture, request = shade_picture(take_light(options)), take_request(options)
    report_picture(lambda events: make_picture(request, picture, events), as_json, quiet)

"""`photoplan balance`: even colours between the images of a project."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import NEW_FOLDER, PATH, PROJECT, ending, images_option
from photoplan.cli.output import can_draw, say, show, show_json, talking

if TYPE_CHECKING:
    from photoplan.products.balance import BalanceReport

#: Pairs that are listed; all are in the table.
_LISTED = 12


@click.command("balance")
@click.argument("project", type=PROJECT)
@images_option()
@click.option("--reference-image", metavar="NAME", help="This image stays as it is [mean and contrast of all stay].")
@click.option("--reference", type=PATH, metavar="FILE", help="A raster on the map whose colours the images get.")
@click.option(
    "--degree", type=int, default=2, show_default=True, help="Degree of the trend over an image; 0 = tables alone."
)
@click.option("--factor", is_flag=True, help="One factor for each image and band instead of tables, from means.")
@click.option("--resolution", type=float, metavar="R", help="Pixels that are compared, metres [by the images' size].")
@click.option("-o", "--output", type=NEW_FOLDER, metavar="FOLDER", help="[balance by the project]")
@click.option("--no-picture", is_flag=True, help="Do not draw balance.png.")
@ending("Look at the images and stop.", workers=True, executor=True, memory=True)
def command(as_json: bool, quiet: bool, no_picture: bool, **options: Any) -> None:
    """Find tables by which the images of PROJECT agree in colour where they overlap.

    Each image gets a file with a table for every band, and an entry `balance` in PROJECT: `ortho` and `mosaic` apply it
    from then on.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.store import together
    from photoplan.products.balance import BalanceRequest, balance_project
    from photoplan.project.scene import refuse_unusable
    from photoplan.report.balance import draw_balance
    from photoplan.report.page import open_picture

    request = BalanceRequest(**options)
    wanted = can_draw(not no_picture and not request.dry_run, talking(quiet))
    place = request.folder / "balance.png" if wanted else None
    drawing = open_picture(place, [request.project], overwrite=request.overwrite)
    with together():
        with Telling(quiet) as events:
            found = balance_project(request, events)
        picture = None if drawing is None else drawing.write(draw_balance(found))
    if as_json:
        show_json(found, picture=picture)
    elif found.pairs is None:
        grid = found.survey.grid
        pixels = f"{grid.width} × {grid.height} pixels of {grid.resolution:g} m"
        show(f"{len(found.survey.names)} images, compared on {pixels}")
    else:
        show(request.table)
        if picture is not None:
            show(picture)
        _print(found)
    for note in found.notes:
        say(note)
    refuse_unusable(found.unusable, len(found.survey.names) + len(found.survey.blind))


def _print(found: BalanceReport) -> None:
    pairs, made = found.pairs, found.balanced
    assert pairs is not None and made is not None
    before, after = found.rms()
    resolution = found.survey.grid.resolution
    show(f"{len(made.images)} images, {len(pairs.images)} overlaps at {resolution:g} m: rms differences, grey values")
    show(f"{'':32}  {'before':>24}  {'after':>24}")
    show(f"{'mean of the overlaps':32}  {_values(before):>24}  {_values(after):>24}")
    worst = (-pairs.after.mean(axis=1)).argsort()[:_LISTED]
    for k in worst.tolist():
        both = " – ".join(found.named(i)[-15:] for i in pairs.images[k])
        show(f"{both:32}  {_values(pairs.before[k]):>24}  {_values(pairs.after[k]):>24}")
    if len(pairs.images) > _LISTED:
        show(f"and {len(pairs.images) - _LISTED} more, better ones")
    if made.modes:
        parts = ", ".join(f"{mode.name} {100 * mode.sigma:.1f} %" for mode in made.modes)
        show(f"standard deviations over the block, from its middle to its edge: {parts}")
        held = [mode.name for mode in made.modes if mode.held]
        if held:
            show(f"overlaps do not determine {', '.join(held)}: held at what the exposures of the images suggest")
    if made.shoulder:
        show("bright and dark ends of the tables are bent to stay inside the range")
    show(f"{len(found.files)} balance files are entered in the project; `ortho` and `mosaic` apply them")


def _values(values: Any) -> str:
    return " ".join(f"{value:6.1f}" for value in values)

"""`photoplan tie`: tie points between the images of a project."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import PATH, PROJECT, ending, images_option
from photoplan.cli.output import can_draw, say, show, show_json, talking

if TYPE_CHECKING:
    from photoplan.products.tie import TieReport


@click.command("tie")
@click.argument("project", type=PROJECT)
@images_option()
@click.option("--pairs", default="auto", show_default=True, metavar="auto|all|FILE", help="Which images are compared.")
@click.option("--scale", type=float, help="Look for features in images reduced to this, e.g. 0.5 [by their size].")
@click.option("--features", type=int, default=4000, show_default=True, help="Features per image.")
@click.option(
    "--levels",
    type=click.IntRange(1, 4),
    default=4,
    show_default=True,
    help="Kinds of features tried where images stay unconnected: coarser, then more; 1: as stated only.",
)
@click.option("--per-image", type=int, default=500, show_default=True, help="Tie points that an image is to have.")
@click.option("--no-refine", is_flag=True, help="Features as they are, without least-squares matching.")
@click.option("--ignore-orientation", is_flag=True, help="Work as if no image had a position.")
@click.option("-o", "--output", type=PATH, metavar="CSV", help="[tie_points.csv by the project]")
@click.option("--no-picture", is_flag=True, help="Do not write a picture beside the output.")
@ending("Open the images, choose pairs and stop.", workers=True)
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Find points that several images of PROJECT have in common.

    They are written as a table (point, image, column, row, standard deviations), which becomes an entry of
    [observations] in PROJECT. Images that hang together with no other are named.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.store import together
    from photoplan.products.tie import TieRequest, find_ties
    from photoplan.report.page import open_picture
    from photoplan.report.tie import draw_ties

    options["refine"] = not options.pop("no_refine")
    options["use_orientation"] = not options.pop("ignore_orientation")
    wanted = can_draw(not options.pop("no_picture") and not options["dry_run"], talking(quiet))
    request = TieRequest(**options)
    place = request.table.with_suffix(".png") if wanted else None
    drawing = open_picture(place, [request.project], overwrite=request.overwrite)
    with together():
        with Telling(quiet) as events:
            found = find_ties(request, events)
        picture = None
        if drawing is not None and found.found is not None:
            picture = drawing.write(draw_ties(found.sources, found.found))
    if as_json:
        show_json(found, picture=picture)
    elif found.output is None:
        show(f"{len(found.images)} images, {found.pairs or 'not yet known number of'} pairs: {found.chosen}")
    else:
        show(found.output)
        if picture is not None:
            show(picture)
        _print(found)
    _talk(found)


def _scales(found: TieReport) -> list[str]:
    kinds = dict.fromkeys((t.scale, t.features) for t in found.tried)
    return [f"1/{1 / scale:.0f}" + (f" ({count})" if k else "") for k, (scale, count) in enumerate(kinds)]


def _print(found: TieReport) -> None:
    rows = [
        ("images", f"{len(found.images)}, features at scale " + ", ".join(_scales(found))),
        ("pairs", f"{found.pairs} tried ({found.chosen}), {found.verified} verified"),
        ("tracks", f"{found.tracks} found, {found.ambiguous} ambiguous ones dropped"),
        ("tie points", f"{found.points}, standard deviation {found.sigma:.2g} px (median)"),
        ("  in images", ", ".join(f"{rays}: {count}" for rays, count in found.rays.items())),
    ]
    if found.refined is not None and found.loops is not None:
        r, loops = found.refined, found.loops
        origin = f"from {loops.count} loops" if loops.measured else "assumed, too few loops"
        rows += [
            (
                "refinement",
                f"correlation {r.correlation:.2f} (median), sigma of the fit × {loops.factor:.2f} ({origin})",
            ),
            ("  left out", f"{r.unsettled} not found, {r.unlike} unlike, {r.uncertain} uncertain"),
        ]
    for what, text in rows:
        show(f"{what:12} {text}")
    width = max(map(len, found.per_image))
    show(f"{'image':{width}}  points")
    for name, count in found.per_image.items():
        show(f"{name:{width}}  {count:6}")


def _talk(found: TieReport) -> None:
    for note in found.notes:
        say(note)
    if len(found.parts) > 1:
        say(f"no overlap: {len(found.unconnected)} of {len(found.images)} images do not hang together with the others:")
        for part in found.parts[1:]:
            say(f"  {', '.join(part)}")
        say(found.advice)

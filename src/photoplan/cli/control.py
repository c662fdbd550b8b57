"""`photoplan control`: control points from an orthophoto and heights."""

from __future__ import annotations

import math
from typing import Any

import click

from photoplan.cli.options import PATH, PROJECT, ending, images_option
from photoplan.cli.output import say, show, show_json


@click.command("control")
@click.argument("project", type=PROJECT)
@click.option("--ortho", type=PATH, multiple=True, required=True, metavar="FILE", help="Orthophoto; may be repeated.")
@click.option("--height-sigma", type=float, required=True, metavar="M", help="Standard deviation of the heights.")
@click.option("--ortho-sigma", type=float, metavar="M", help="Standard deviation of X and of Y in it [one pixel].")
@click.option("--heights", type=PATH, metavar="FILE", help="[the project's terrain]")
@click.option("--height-system", metavar="NAME", help="Of --heights, where the file states none.")
@images_option()
@click.option("--grid", type=int, default=8, show_default=True, help="Patches along each side of an image.")
@click.option("--search", type=float, default=30.0, show_default=True, metavar="M", help="How far points may be off.")
@click.option("--radius", type=int, default=15, show_default=True, help="Of a patch, pixels of the coarser picture.")
@click.option("--correlation", type=float, default=0.7, show_default=True, help="Least correlation of a patch.")
@click.option("-o", "--output", type=PATH, metavar="CSV", help="[control.csv by the project]")
@ending("Choose the patches and stop.", workers=True)
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Propose control for the approximately oriented images of PROJECT.

    Patches of an orthophoto are found in the photos. Their places with heights become ground points, written with the
    image points beside them (NAME_points.csv); both become entries of [observations] in PROJECT. Points that do not
    agree on one correction of an image's orientation are left out.
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.control.run import ControlRequest, propose_control

    request = ControlRequest(**options)
    with Telling(quiet) as events:
        found = propose_control(request, events)
    if as_json:
        show_json(found)
        return
    if found.output is None:
        show(f"{found.patches} patches at {found.resolution:g} m")
        return
    show(found.output)
    show(found.image_points)
    plane, height, image = found.sigma
    show(
        f"{found.points} control points of {found.patches} patches at {found.resolution:g} m; standard deviations "
        f"{plane:.2g} m, height {height:.2g} m, image {image:.2g} px (medians)"
    )
    width = max(5, *(len(i.name) for i in found.images))
    show(f"{'image':{width}}  tried found  kept  shift px          residual px")
    for i in found.images:
        x, y, rms = (f"{v:.{digits}f}" if math.isfinite(v) else "–" for v, digits in zip((*i.shift, i.rms), (1, 1, 2)))
        show(f"{i.name:{width}} {i.tried:6} {i.matched:5} {len(i.points):5}  {x:>7} {y:>7}  {rms:>10}")
    for i in found.images:
        if not len(i.points):
            reasons = ", ".join(f"{count} {reason}" for reason, count in i.reasons.items())
            say(f"{i.name}: no control ({reasons})")

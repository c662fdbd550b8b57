"""`photoplan view pick`: pixels to ground, ground to pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.view_options import camera_options, take_request


@click.command("pick")
@camera_options
@click.option("--matrix", type=PATH, help="Take the camera of this coordinate matrix.")
@click.option("--pixel", "pixels", type=float, nargs=2, multiple=True, metavar="COLUMN ROW", help="May be repeated.")
@click.option("--ground", "points", type=float, nargs=2, multiple=True, metavar="X Y", help="May be repeated.")
@click.option(
    "--points", "file", type=PATH, metavar="TABLE", help="Ground points: columns x, y and optionally z, name."
)
@click.option("-o", "--output", type=PATH, metavar="CSV", help="Write them as a table, too.")
@ending()
def command(matrix: Path | None, **options: Any) -> None:
    """The ground of pixels of a view, and the pixels of ground points, with what is seen there.

    (0, 0) is the centre of the upper-left pixel.
    """
    from photoplan.cli.output import show, show_json
    from photoplan.products.view.measure import PickRequest, pick

    as_json, _ = options.pop("as_json"), options.pop("quiet")
    own = {name: options.pop(name) for name in ("pixels", "points", "file", "output", "overwrite")}
    found = pick(PickRequest(take_request(options, matrix=matrix), **own))
    if as_json:
        show_json({"picked": found, "output": own["output"]})
        return
    if own["output"] is not None:
        show(own["output"])
        return
    for each in found:
        show(f"{each.name}: {_told(each)}")


def _told(each: Any) -> str:
    """One line of a pixel or point."""
    if each.E != each.E:
        return f"{each.x:.3f} {each.y:.3f} = sky: sky"
    if each.H != each.H:
        return f"{each.E:.3f} {each.N:.3f}: not seen (the terrain has no height there)"
    where = f"{each.E:.3f} {each.N:.3f} {each.H:.3f}"
    if each.x != each.x:
        return f"behind the camera = {where}: not seen"
    state = each.surface if each.seen else f"not seen ({each.surface})"
    return f"{each.x:.3f} {each.y:.3f} = {where}: {state}, {each.distance:.2f} m away, pixel {each.pixel_m:.3g} m"

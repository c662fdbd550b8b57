"""`photoplan view area`: what of the map a view shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, POSITIVE, ending
from photoplan.cli.view_options import camera_options, take_request


@click.command("area")
@camera_options
@click.option("--matrix", type=PATH, help="Take the camera of this coordinate matrix.")
@click.option("--resolution", type=POSITIVE, help="Pixel of the map, metres [a thousandth].")
@click.option("-o", "--output", type=PATH, required=True, metavar="FILE", help="GeoTIFF, or GeoPackage of a polygon.")
@ending(workers=True)
def command(matrix: Path | None, **options: Any) -> None:
    """The visible area: where on the map lies what the picture shows. 1 seen, 0 not seen, 255 no terrain."""
    from photoplan.cli.output import say, show, show_json
    from photoplan.cli.telling import Telling
    from photoplan.products.view.measure import AreaRequest, visible_area

    as_json, quiet = options.pop("as_json"), options.pop("quiet")
    own = {name: options.pop(name) for name in ("output", "resolution", "workers", "overwrite")}
    with Telling(quiet) as events:
        found = visible_area(AreaRequest(take_request(options, matrix=matrix), **own), events)
    if as_json:
        show_json(found)
        return
    show(found.output)
    if not quiet:
        share = found.seen / found.looked_at if found.looked_at else 0.0
        areas = f"{found.seen / 1e6:.6g} of {found.looked_at / 1e6:.6g} km² are seen ({share:.1%})"
        say(f"{areas}; pixel {found.resolution:g} m")

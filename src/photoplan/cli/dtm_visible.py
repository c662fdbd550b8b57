"""`photoplan dtm visible`: what can be seen from points."""

from __future__ import annotations

import math
from typing import Any

import click

from photoplan.cli.options import BYTES, PATH, POSITIVE, ending
from photoplan.cli.output import say, show, show_json


@click.command("visible")
@click.argument("model", type=PATH)
@click.option("--from", "points", type=float, nargs=2, multiple=True, metavar="X Y", help="Observer; may be repeated.")
@click.option("--observers", "file", type=PATH, help="Table (x, y, h, name) or point file.")
@click.option("--height-observer", type=float, default=1.7, show_default=True, help="Eye above ground, metres.")
@click.option("--height-target", type=float, default=0.0, show_default=True, help="Target above ground, metres.")
@click.option("--radius", type=float, default=math.inf, help="Look no further than this, metres [all].")
@click.option("--refraction", type=float, default=0.13, show_default=True, help="Coefficient of refraction k.")
@click.option("--curvature/--no-curvature", default=True, help="Whether the earth is round [yes].")
@click.option("--minimum-height", is_flag=True, help="Write the height above ground from which a place is seen.")
@click.option("--resolution", type=POSITIVE, help="Pixel of the map, metres [mesh width].")
@click.option("-o", "--output", type=PATH, required=True, metavar="TIF", help="The map.")
@click.option("--memory", type=BYTES, default="2GB", show_default=True, metavar="SIZE", help="Stay under this.")
@click.option("--crs", help="CRS of a model that does not state it.")
@ending(workers=True)
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Map of what can be seen: 1 visible, 0 hidden, 255 no terrain; for several observers first how many see it.

    Places without terrain block nothing.
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.dtm.visible import VisibleRequest, dtm_visible

    with Telling(quiet) as events:
        found = dtm_visible(VisibleRequest(**options), events)
    if as_json:
        show_json(found)
        return
    show(found.path)
    for row in found.rows:
        share = row.visible / row.looked_at if row.looked_at else 0.0
        show(
            f"observer {row.name}: eye at {row.eye:.2f} m, sees {row.visible:.6g} m² of {row.looked_at:.6g} m² "
            f"({share:.1%}); {row.missing:.6g} m² without heights"
        )
    if not quiet:
        k = options["refraction"]
        bend = f"R = {found.earth_radius / 1000:.0f} km, k = {k:g}" if options["curvature"] else "flat earth"
        far = f"; horizon of a smooth earth {found.horizon:.0f} m" if math.isfinite(found.horizon) else ""
        say(f"bands: {', '.join(found.bands)}; pixel {found.resolution:g} m; {bend}{far}")

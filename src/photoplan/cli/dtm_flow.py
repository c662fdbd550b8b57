"""`photoplan dtm flow`: catchments and flow lengths."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import BYTES, PATH, POSITIVE, ending
from photoplan.cli.output import say, show, show_json


@click.command("flow")
@click.argument("model", type=PATH)
@click.option("--resolution", type=POSITIVE, help="Side of a cell, metres [mesh width].")
@click.option("--outlets", type=PATH, help="Points (table x, y, name, or vector file).")
@click.option("--snap", type=float, default=0.0, help="Move outlets to the largest flow within this, metres [0].")
@click.option("--catchments", type=PATH, metavar="GPKG", help="Write the catchments as polygons.")
@click.option("--method", type=click.Choice(["d8", "dinf"]), default="d8", help="How upstream areas are summed [d8].")
@click.option("-o", "--output", type=PATH, required=True, metavar="TIF", help="The raster.")
@click.option("--memory", type=BYTES, default="2GB", show_default=True, metavar="SIZE", help="Stay under this.")
@click.option("--crs", help="CRS of a model that does not state it.")
@ending(workers=True)
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Upstream area, flow length, direction and catchment of every cell, in six bands of one raster.

    Pits are filled first; how much that was is printed.
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.dtm.flow import BANDS, FlowRequest, dtm_flow

    with Telling(quiet) as events:
        found = dtm_flow(FlowRequest(**options), events)
    if as_json:
        show_json(found)
        return
    show(found.path)
    if found.catchments is not None:
        show(found.catchments)
    show(
        f"area {found.area:.8g} m², leaves by its edge {found.outflow:.8g} m²; "
        f"pits filled on {found.pits:.6g} m² with {found.pit_volume:.6g} m³"
    )
    for row in found.rows:
        show(
            f"outlet {row.name} at {row.X:.10g} {row.Y:.10g}: {row.area:.8g} m² upstream, "
            f"longest way {row.longest:.6g} m"
        )
    if not quiet:
        say(f"bands: {', '.join(BANDS)}; cells {found.resolution:g} m")

"""`photoplan dtm volume`: cut and fill."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, POSITIVE, ending
from photoplan.cli.output import say, show, show_json


@click.command("volume")
@click.argument("a", metavar="A", type=PATH)
@click.argument("b", metavar="B", type=PATH)
@click.option("--polygon", "polygons", type=PATH, help="Polygons: one line of figures for each.")
@click.option("--resolution", type=POSITIVE, help="Cells of the integration, metres [auto].")
@click.option("--tolerance", type=float, default=1e-3, show_default=True, help="Where cells are halved: part of it.")
@click.option("--difference", type=PATH, metavar="TIF", help="Write B − A as a raster.")
@click.option("--sigma-a", type=float, help="Standard deviation of A's heights, metres [the model's own].")
@click.option("--sigma-b", type=float, help="The same of B.")
@click.option("--correlation", type=float, help="Correlation length of height errors, metres [the mesh width].")
@click.option("--bias", type=float, default=0.0, help="Standard deviation of a common height error, metres [0].")
@click.option("--height-system", metavar="same", help="Declare that both models have the same height system.")
@click.option("--crs", help="CRS of files that do not state it.")
@ending(workers=True)
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Cut, fill and net volume from terrain A to terrain B, with their exactness.

    Cut is where A lies above B. Where one of the models has no height nothing is counted; that area is printed.
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.dtm.volume import VolumeRequest, dtm_volume

    with Telling(quiet) as events:
        found = dtm_volume(VolumeRequest(**options), events)
    if as_json:
        show_json(found)
        return
    width = max(7, *(len(row.name) for row in found.rows))
    show(f"{'polygon':<{width}}  {'cut m³':>14} {'fill m³':>14} {'net m³':>14} {'area m²':>13} {'no model m²':>13}")
    for row in found.rows:
        v = row.volume
        show(f"{row.name:<{width}}  {v.cut:>14.2f} {v.fill:>14.2f} {v.net:>14.2f} {v.area:>13.1f} {v.missing:>13.1f}")
        show(f"{'':<{width}}  {v.error_cut:>13.2g}i {v.error_fill:>13.2g}i {v.error_net:>13.2g}i  cells {v.cell:g} m")
        if row.sigma is not None:
            s = row.sigma
            show(f"{'':<{width}}  {s.cut:>13.2f}σ {s.fill:>13.2f}σ {s.net:>13.2f}σ")
    show("i: change with the last halving of the cells; σ: standard deviation from that of the heights")
    if found.difference is not None:
        show(found.difference)
    if not quiet:
        say(f"height system: {found.height_system}")
    for note in found.notes:
        say(note)

"""`photoplan view skyline`: the border between ground and sky."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.view_options import camera_options, take_request


@click.command("skyline")
@camera_options
@click.option("--matrix", type=PATH, help="Take the camera of this coordinate matrix.")
@click.option("-o", "--output", type=PATH, required=True, metavar="FILE", help="CSV, or GeoPackage of points.")
@ending()
def command(matrix: Path | None, output: Path, overwrite: bool, **options: Any) -> None:
    """The skyline: in every column the highest ground that is seen, with its place in the picture and on the map."""
    from photoplan.cli.output import show, show_json
    from photoplan.products.view.skyline import SkylineRequest, skyline

    as_json, quiet = options.pop("as_json"), options.pop("quiet")
    found = skyline(SkylineRequest(take_request(options, matrix=matrix), output, overwrite))
    if as_json:
        show_json(found)
        return
    show(output)
    if not quiet and len(found.points):
        away = found.points[:, 5]
        show(f"{len(found.points)} of {found.columns} columns, {away.min():.0f} to {away.max():.0f} m away")
    elif not quiet:
        show(f"none of {found.columns} columns shows ground with sky above it")

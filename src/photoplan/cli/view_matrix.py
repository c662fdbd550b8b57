"""`photoplan view matrix`: the ground of every pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH
from photoplan.cli.view_options import camera_options, run_view, running_options, take_request


@click.command("matrix")
@camera_options
@click.option("-o", "--output", type=PATH, required=True, metavar="TIF", help="The matrix.")
@running_options
def command(output: Path, **options: Any) -> None:
    """The ground of every pixel of a view: E, N, H, distance, angle of incidence, size of the pixel, surface, normal.

    A GeoTIFF of nine bands; `photoplan view --matrix` paints it with other content.
    """
    run_view(take_request(options, output=output, kind="matrix"), options)

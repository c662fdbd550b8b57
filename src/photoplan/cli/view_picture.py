"""`photoplan view picture`: a picture of what is seen from a point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH
from photoplan.cli.view_look import look_options, take_look
from photoplan.cli.view_options import camera_options, run_view, running_options, take_request


@click.command("picture")
@camera_options
@click.option(
    "--matrix", type=PATH, help="Coordinate matrix of this view: content is changed, nothing looked for again."
)
@look_options
@click.option("--photo", metavar="FILE[@HOW]",
              help="A photograph with the pixels of the picture: over it, with an opacity (@0.3; 0.5), in @squares "
              "with it, or @beside it.")  # fmt: skip
@click.option("--svg", type=PATH, help="Lines and labels as a layer over the picture, too.")
@click.option("-o", "--output", type=PATH, metavar="PICTURE", help="PNG, JPEG or GeoTIFF; not needed with --dry-run.")
@running_options
def command(output: Path | None, **options: Any) -> None:
    """A picture of SOURCE, a project or terrain model, from a standpoint or with an image's own camera.

    The same command continues a run that was interrupted.
    """
    from photoplan.errors import UsageError

    if output is None and not options["dry_run"]:
        raise UsageError("no `output`; give the name of the picture, or `dry_run`")
    look = take_look(options, options.pop("photo"))
    own = {name: options.pop(name) for name in ("matrix", "svg")}
    run_view(take_request(options, output=output, **own, **look), options)

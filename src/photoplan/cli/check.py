"""`photoplan check`: validate a project and say what to expect."""

from __future__ import annotations

from pathlib import Path

import click

from photoplan.cli.options import PROJECT, ending, images_option
from photoplan.cli.output import show, show_json


@click.command("check")
@click.argument("project", type=PROJECT)
@images_option()
@ending(overwrite=False)
def command(project: Path, images: tuple[str, ...], as_json: bool, quiet: bool) -> None:
    """Open every input of PROJECT and print, image by image, what it promises.

    Ends with exit code 3 if orientations are implausible or another reading fits better, which is named, and with 4 if
    files of some images cannot be used.
    """
    from photoplan.errors import GeometryError
    from photoplan.io.project.file import load_project
    from photoplan.products.check import check_project
    from photoplan.project.scene import refuse_unusable

    found = check_project(load_project(project), images or None)
    if as_json:
        show_json(found)
    else:
        show(found)
    if found.implausible or found.alternative is not None:
        faults = f"{len(found.implausible)} of {len(found.images)} images are implausible"
        if not found.implausible:
            faults = "another reading of the orientation fits better"
        first = f": {found.implausible[0]}" if found.implausible else ""
        raise GeometryError(f"{project}: {faults}{first}\n{found.remedy}")
    refuse_unusable(found.unusable, len(found.images) + len(found.left_out) + len(found.unusable))

"""`photoplan fiducials`: find the fiducial marks of film scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import NEW_FOLDER, PATH, ending, images_option
from photoplan.cli.output import end_with_failures, say, show, show_json

_ANSWER = {"auto": None, "yes": True, "no": False}


@click.command("fiducials")
@click.argument("scans", nargs=-1, required=True, type=PATH, metavar="IMAGE…")
@click.option("--camera", type=PATH, metavar="FILE", help="Describes the camera and its marks.")
@click.option("--camera-name", metavar="NAME", help="Which camera of the file, where it describes several.")
@images_option("all film", "select")
@click.option("--scan-resolution", metavar="DPI|UM", help="Such as 1200dpi or 21um [what the files state, else found].")
@click.option("--rotation", type=click.Choice(["auto", "0", "90", "180", "270"]), default="auto", show_default=True,
              help="By which the picture was turned before scanning, counter-clockwise.")  # fmt: skip
@click.option("--mirrored", type=click.Choice(list(_ANSWER)), default="auto", show_default=True,
              help="Whether left and right are exchanged in the scan.")  # fmt: skip
@click.option("--negative", type=click.Choice(list(_ANSWER)), default="auto", show_default=True,
              help="Whether dark and bright are exchanged against the description.")  # fmt: skip
@click.option("--band", type=click.IntRange(1), metavar="N", help="Band to use [luminance of the first three].")
@click.option("--least-correlation", type=click.FloatRange(0.3, 0.99), metavar="R", help="Less is no mark [0.6].")
@click.option("--pictures", type=NEW_FOLDER, metavar="FOLDER", help="Receives a picture of the marks.")
@ending("Of a project: do not write the marks into it.")
def command(scans: tuple[Path, ...], as_json: bool, quiet: bool, **options: Any) -> None:
    """Find the fiducial marks of scanned film photos, without approximate values.

    IMAGE… are scans, with --camera FILE; or one project file, whose film images are measured and which receives the
    marks. An image that fails does not stop the others; they are listed at the end (exit code 4).
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.files import unique_stems
    from photoplan.io.store import together
    from photoplan.plain import plain
    from photoplan.products.film import FiducialsRequest, locate_fiducials, scans_of
    from photoplan.report.fiducials import marks_picture, unfound_picture
    from photoplan.report.page import open_picture

    folder, overwrite = options.pop("pictures"), options.pop("overwrite")
    request = FiducialsRequest(scans, **_values(options))
    pictures = {}
    if folder is not None:
        files = scans_of(request)
        for name, stem in unique_stems(files).items():
            place = folder / f"{stem}.fiducials.png"
            pictures[name] = open_picture(place, [*scans, *files.values()], overwrite=overwrite)
    with together():
        with Telling(quiet) as events:
            report = locate_fiducials(request, events)
        drawn = {}
        for image in report.images:
            picture = pictures.get(image.name)
            drawn[image.name] = None if picture is None else picture.write(marks_picture(image))
        for lost in report.unfound:
            picture = pictures.get(lost.name)
            if picture is not None:
                say(f"{lost.name}: where its marks were sought: {picture.write(unfound_picture(lost))}")
    if as_json:
        images = [{**plain(image), "picture": drawn[image.name]} for image in report.images]
        show_json(report, images=images)
    for image in report.images:
        if not as_json:
            show(image)
            if drawn[image.name] is not None:
                show(drawn[image.name])
        for note in image.found.notes:
            say(f"{image.name}: {note}")
    if report.written is not None and not quiet:
        say(f"{report.written}: fiducial marks of {len(report.images)} images written")
    end_with_failures(report.failed, len(report.images))


def _values(options: dict[str, Any]) -> dict[str, Any]:
    """Options as the request names them."""
    options["rotation"] = None if options["rotation"] == "auto" else int(options["rotation"])
    options["mirrored"] = _ANSWER[options["mirrored"]]
    options["negative"] = _ANSWER[options["negative"]]
    if options["least_correlation"] is None:
        del options["least_correlation"]
    return options

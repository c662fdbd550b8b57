"""`photoplan convert`: orientations from one file format to another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import DIRECTIONS, PATH, beyond_area_option, ending, reading_options, table_format
from photoplan.cli.output import say, show, show_json


@click.command("convert")
@click.argument("orientation", type=PATH)
@click.option("--to", "target", metavar="FORMAT", help="Format to write: csv, toml, patb, bingo, rpc (of a project) …")
@click.option("--camera", type=PATH, help="Cameras (TOML, YAML, JSON) [the orientation's].")
@reading_options
@click.option(
    "--camera-axes",
    type=click.Choice(["up-back", "down-forward"]),
    default="up-back",
    show_default=True,
    help="The file's camera axes y and z; down-forward as in computer vision.",
)
@click.option(
    "--image-turned",
    "turned",
    type=click.Choice(["0", "90", "180", "270"]),
    default="0",
    show_default=True,
    help="Degrees by which images are turned against the file's camera axes, counter-clockwise.",
)
@click.option("--crs", metavar="CRS", help="CRS to write; declares that of a file that states none.")
@click.option("--matrix", type=click.Choice(DIRECTIONS), help="What written rotation matrices do (patb, inpho).")
@click.option("--drop-lens", is_flag=True, help="Write cameras without a lens that the format does not know.")
@click.option("-o", "--output", type=PATH, help="File, or folder of several [beside the input].")
@click.option("--list-readings", is_flag=True, help="Only list the readings of the file that fit measured points.")
@click.option("--image-points", type=PATH, help="Measured image points, for --list-readings.")
@click.option("--control", type=PATH, help="Their ground points, for --list-readings.")
@beyond_area_option
@ending("Say what would be written and what would be lost, and stop.")
def command(
    orientation: Path,
    target: str | None,
    list_readings: bool,
    image_points: Path | None,
    control: Path | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Write ORIENTATION, an orientation file or a project, in another format.

    What the other format cannot hold is said on stderr. A lens that it does not know is refused unless --drop-lens.
    """
    from photoplan.products.convert import ConvertRequest

    form = table_format(options)
    options["turned"] = int(options["turned"])
    request = ConvertRequest(orientation, target or "csv", form=form, **options)
    if list_readings:
        if image_points is None or control is None:
            raise click.UsageError("--list-readings needs --image-points FILE and --control FILE")
        _list(request, image_points, control, as_json, quiet)
        return
    if target is None:
        raise click.UsageError("say the format to write with --to FORMAT")
    if target == "rpc":
        _polynomials(request, as_json, quiet)
        return
    if image_points is not None or control is not None:
        raise click.UsageError("--image-points and --control go with --list-readings")
    _convert(request, as_json, quiet)


def _convert(request: Any, as_json: bool, quiet: bool) -> None:
    from photoplan.io.store import recording
    from photoplan.products.convert import convert_orientation

    with recording("convert", request, [request.orientation, request.camera]) as record:
        done = convert_orientation(request)
        record(() if request.dry_run else done.files, done)
    if as_json:
        show_json(done)
    else:
        for file in done.files:
            show(file)
    if not quiet:
        say(f"  {done.images} images, from {done.source_format} to {done.target_format}{_nothing(request)}")
        for loss in done.lost:
            say(f"  {done.target_format} holds {loss.text}")
    for note in done.notes:
        say(f"  {note}")


def _nothing(request: Any) -> str:
    return "; nothing is written" if request.dry_run else ""


def _polynomials(request: Any, as_json: bool, quiet: bool) -> None:
    from photoplan.products.budget import PolynomialsRequest, write_polynomials

    done = write_polynomials(
        PolynomialsRequest(request.orientation, request.output, request.overwrite, request.dry_run)
    )
    if as_json:
        show_json(done)
    else:
        for file in done.files:
            show(file)
    if not quiet:
        for image in done.images:
            low, high = image.heights
            say(f"  {image.image}: off by at most {image.worst:.2g} px for heights from {low:.0f} to {high:.0f} m")
        if request.dry_run:
            say("  nothing is written")


def _list(request: Any, image_points: Path, control: Path, as_json: bool, quiet: bool) -> None:
    from photoplan.products.convert import list_readings

    found = list_readings(request, image_points, control)
    if as_json:
        show_json(found)
    else:
        for fits, readings in (("fits", found.fitting), ("", found.others)):
            for r in readings:
                show(f"{r.median:10.2f} px  {fits:4}  {found.options(r.reading)}")
    if not quiet:
        say(f"  medians of {found.points} points in {found.images} images")
    for note in found.notes:
        say(f"  {note}")

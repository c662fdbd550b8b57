"""`photoplan surface`: heights and grey values of a surface from all images at once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import (
    LISTED,
    NEW_FOLDER,
    PATH,
    PROJECT,
    bounds_option,
    dry_run_option,
    executing,
    images_option,
)


@click.command("surface")
@click.argument("project", type=PROJECT)
@click.option("--resolution", type=float, required=True, metavar="R", help="Distance of the heights, metres.")
@click.option(
    "--target",
    default="map",
    metavar="WHAT",
    help="Heights over it: map, wall:X,Y,Z,AZIMUTH[,TILT], vault:X,Y,Z,AZIMUTH,RADIUS[,TILT], "
    "column:X,Y,Z,AZIMUTH,RADIUS, or image:NAME[,DISTANCE] [map].",
)
@bounds_option
@images_option()
@click.option(
    "--start",
    default="terrain",
    metavar="WHAT",
    help="terrain (the project's), a height, or a file [terrain; 0].",
)
@click.option("--reach", type=float, metavar="M", help="How far the start may be wrong [a tenth of the flying height].")
@click.option(
    "--search/--no-search",
    default=None,
    help="Whether heights are searched within the reach first: strong relief [from a reach of 24 px of parallax on].",
)
@click.option("--bands", metavar="N,…", **LISTED, help="Bands whose mean is a grey value [all; of three luminance].")
@click.option(
    "--points", type=PATH, multiple=True, metavar="FILE", help="Also as points, .las, .laz or .ply; may be repeated."
)
@click.option("--residuals", is_flag=True, help="Also the residuals of every image: NAME_residuals.tif.")
@click.option("--report", type=PATH, metavar="HTML", help="Accuracy by classes, images and levels, with plots.")
@click.option("--name", default="surface", metavar="NAME", help="Of the files [surface].")
@click.option("-o", "--output", type=NEW_FOLDER, help="Folder of the files [PROJECT's folder/products].")
@click.option(
    "--force", is_flag=True, help="Continue although orientations have a FAULT, or the images contradict the surface."
)
@dry_run_option("Print the plan, and stop.")
@executing
def command(project: Path, **options: Any) -> None:
    """Heights and grey values from all images at once, each with its standard deviation.

    NAME.tif has the heights, NAME_sigma.tif their standard deviations, NAME_count.tif the images that see them,
    NAME_fit.tif the residuals around them, NAME_grey.tif the grey values of the surface, NAME_grey_sigma.tif their
    standard deviations. The heights serve as [terrain] of a project. The same command
    continues a run that was interrupted.
    """
    from photoplan.cli import running
    from photoplan.cli.output import can_draw, show, show_json
    from photoplan.cli.telling import Telling
    from photoplan.io.project.file import load_project
    from photoplan.io.store import together
    from photoplan.products.surface.plan import SurfaceSettings, plan_surface
    from photoplan.products.surface.run import make_surface
    from photoplan.project.scene import Attempts, refuse_unusable
    from photoplan.report.maps import draw_surface
    from photoplan.report.page import open_report
    from photoplan.report.surface import surface_page

    how = running.How.from_options(options)
    options["bands"] = _bands(options["bands"])
    folder, dry_run, images, force = (options.pop(name) for name in ("output", "dry_run", "images", "force"))
    report = None if dry_run else open_report(options.pop("report"), [], overwrite=how.overwrite, project=project)
    options.pop("report", None)
    stated = load_project(project)

    attempts = Attempts(stated, images or None)
    with Telling(how.quiet) as events:
        for attempt in attempts:
            with attempt as usable:
                plan = plan_surface(usable, SurfaceSettings(**options), images or None, force=force, events=events)
                for line in plan.blind:
                    events.talk(f"  note: left out: {line}")
                if dry_run:
                    show_json(plan.json_fields()) if how.as_json else show(plan)
                    continue
                events.talk(str(plan))
                with together():
                    result = make_surface(plan, folder or stated.folder / "products", how.run(events))
                    told = None if report is None else report.write(surface_page(plan, result))
                    picture = None
                    if can_draw(how.quicklook, events.talk):
                        picture = draw_surface(result.path, result.path.with_suffix(".png"), plan.axes)
                if how.as_json:
                    show_json(result, report=told)
                else:
                    for path in filter(None, (result.path, *result.others, told)):
                        show(path)
                _tell(result, plan, picture, events)
    refuse_unusable(attempts.left_out, len(stated.select(images or None)))


def _bands(words: Sequence[str] | None) -> tuple[int, ...]:
    """Bands from words."""
    from photoplan.errors import UsageError

    try:
        return tuple(int(word) for word in words or ())
    except ValueError:
        raise UsageError(f"bands {', '.join(words or ())}: numbers from 1 on are needed") from None


def _tell(result: Any, plan: Any, picture: Path | None, events: Any) -> None:
    """Figures of a surface, and where its picture is."""
    known = {name: value for name, value in result.sigma0.items() if value is not None}
    median = "unknown" if result.sigma is None else f"{result.sigma:.3g} m ({result.sigma_px:.2g} px of parallax)"
    events.talk(
        f"surface in {result.seconds:.1f} s · {result.valid_share:.1%} of {plan.grid.width * plan.grid.height} posts "
        f"have a height, median standard deviation {median}; {result.misfit_share:.2%} fit badly"
    )
    corrections = ", ".join(f"{c:.3f}" for c in result.corrections[::-1])
    events.talk(f"  last corrections, coarse to fine: {corrections} px")
    events.talk("  sigma0 of grey values: " + ", ".join(f"{name} {value:.3g}" for name, value in known.items()))
    for note in result.notes:
        events.talk(f"  note: {note}")
    if picture is not None:
        events.talk(f"  drawn in {picture}")

"""`photoplan simulate`: form images of a scene, or of a project's terrain and objects, by a described camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, bounds_option, ending, images_option
from photoplan.cli.output import say, show, show_json

_OF_PATTERNS = ("frames", "exposure", "size", "levels", "phase")
_OF_PROJECTS = ("images", "texture", "grain", "truth", "resolution", "bounds")


@click.command("simulate")
@click.argument("scene", metavar="[SCENE]", required=False)
@click.option("--scene", "project", type=PATH, metavar="PROJECT",
              help="In place of SCENE: render the images of a project from its terrain and objects.")  # fmt: skip
@images_option()
@click.option("--texture", type=PATH, metavar="FILE", help="Raster of the ground's colours [a pattern].")
@click.option("--grain", type=float, metavar="METRES", help="Finest wave of the pattern [8 ground pixels].")
@click.option("--truth", is_flag=True, help="Also X, Y, Z and object of each pixel: NAME_truth.tif.")
@click.option("--resolution", type=float, metavar="R", help="Also the scene's true orthophoto, ground pixel in metres.")
@bounds_option
@click.option("--model", type=PATH, metavar="FILE", help="Describes the camera [changes nothing].")
@click.option("-o", "--output", type=PATH, metavar="PATH",
              help="TIFF to write [SCENE_simulated.tif]; a project's folder [its folder/rendered].")  # fmt: skip
@click.option("--frames", type=int, metavar="N", help="Images to form; numbered files [1].")
@click.option("--seed", type=int, metavar="N", help="Of all that is random [the model's, else 0].")
@click.option("--exposure", type=float, multiple=True, metavar="FACTOR",
              help="Of light and time; once, or once for each frame [1].")  # fmt: skip
@click.option("--size", type=click.IntRange(1, 100_000), nargs=2, metavar="WIDTH HEIGHT",
              help="Of a pattern [512 512].")  # fmt: skip
@click.option("--levels", type=float, nargs=2, metavar="DARK BRIGHT", help="Values of a pattern [0 1].")
@click.option("--phase", type=float, nargs=2, metavar="X Y",
              help="Pixels by which a pattern is moved from the middle [0 0].")  # fmt: skip
@click.option("--oversampling", type=click.IntRange(1, 64), metavar="K",
              help="Cells of the scene along a side of a pixel [files 1, patterns 8, projects 2].")  # fmt: skip
@click.option("--dtype", type=click.Choice(["uint8", "uint16", "float32"]), help="Of the files [as the model says].")
@ending("Check everything, say what would be written, write nothing.", workers=True)
def command(scene: str | None, project: Path | None, as_json: bool, quiet: bool, **options: Any) -> None:
    """Form images of a scene with blur, noise, jitter, blooming and all else that a camera does.

    SCENE is an image file, or a pattern: flat, edge:ANGLE, bars:PERIOD,ANGLE, star:SECTORS, wedge:STEPS or
    discs:PITCH,DIAMETER. With --scene it is the terrain and the objects of a project, as its cameras see them.
    """

    if (scene is None) == (project is None):
        raise click.UsageError("give SCENE, a file or a pattern, or --scene PROJECT")
    idle = _OF_PATTERNS if scene is None else _OF_PROJECTS
    unfit = [name for name in idle if options.pop(name) not in (None, (), False)]
    if unfit:
        what = "project" if scene is None else "file or pattern"
        raise click.UsageError(f"--{unfit[0]} does not go with a {what}; leave it out")
    if project is None:
        _pattern(str(scene), as_json, quiet, options)
    else:
        _project(project, as_json, quiet, options)


def _pattern(scene: str, as_json: bool, quiet: bool, options: dict[str, Any]) -> None:
    """Images of a file or a pattern."""
    from photoplan.cli.telling import Telling
    from photoplan.products.simulate import SimulateRequest, simulate

    options["frames"] = 1 if options["frames"] is None else options["frames"]
    with Telling(quiet) as events:
        report = simulate(SimulateRequest(scene, **options), events)
    if as_json:
        show_json(report)
    else:
        for image in report.images:
            show(image.path)
    if not quiet:
        _tell_dry(options)
    _tell(report, quiet)


def _project(project: Path, as_json: bool, quiet: bool, options: dict[str, Any]) -> None:
    """Images of a project."""
    from photoplan.cli.telling import Telling
    from photoplan.products.simulate import SceneRequest, simulate_project

    with Telling(quiet) as events:
        report = simulate_project(SceneRequest(project, **options), events)
    if as_json:
        show_json(report)
    else:
        for path in (*(image.path for each in report.images for image in each.images), *report.rasters):
            show(path)
    for each in report.images:
        _tell(each, quiet)
    if not quiet:
        _tell_dry(options)
        say(f"finest wave of the pattern: {report.grain:g} m" + (f" · {len(report.kept)} files of an earlier run kept"
                                                                 if report.kept else ""))  # fmt: skip


def _tell_dry(options: dict[str, Any]) -> None:
    if options["dry_run"]:
        say("dry run: nothing was written")


def _tell(report: Any, quiet: bool) -> None:
    """What was formed, in words."""
    along = " ".join(f"{axis} {value:.4f}" for axis, value in zip("xy", report.mtf50))
    if not quiet:
        say(
            f"{len(report.images)} images of {report.bands} × {report.size[0]} × {report.size[1]} pixels, "
            f"{report.dtype} · MTF50 of the model: {along} cycles per pixel"
        )
    for note in report.notes:
        say(note)

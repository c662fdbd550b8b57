"""`photoplan simulate`: form images of a scene by a described camera."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, dry_run_option, json_option, overwrite_option, quiet_option, workers_option
from photoplan.cli.output import say, show, show_json


@click.command("simulate")
@click.argument("scene", metavar="SCENE")
@click.option("--model", type=PATH, metavar="FILE", help="Describes the camera [changes nothing].")
@click.option("--output", type=PATH, metavar="FILE", help="TIFF to write [SCENE_simulated.tif].")
@click.option("--frames", type=int, default=1, show_default=True, metavar="N", help="Images to form; numbered files.")
@click.option("--seed", type=int, metavar="N", help="Of all that is random [the model's, else 0].")
@click.option("--exposure", type=float, multiple=True, metavar="FACTOR",
              help="Of light and time; once, or once for each frame [1].")  # fmt: skip
@click.option("--size", type=click.IntRange(1, 100_000), nargs=2, metavar="WIDTH HEIGHT",
              help="Of a pattern [512 512].")  # fmt: skip
@click.option("--levels", type=float, nargs=2, metavar="DARK BRIGHT", help="Values of a pattern [0 1].")
@click.option("--phase", type=float, nargs=2, metavar="X Y",
              help="Pixels by which a pattern is moved from the middle [0 0].")  # fmt: skip
@click.option("--oversampling", type=click.IntRange(1, 64), metavar="K",
              help="Cells of the scene along a side of a pixel [1 for files, 8 for patterns].")  # fmt: skip
@click.option("--dtype", type=click.Choice(["uint8", "uint16", "float32"]), help="Of the files [as the model says].")
@workers_option
@overwrite_option
@dry_run_option("Check everything, say what would be written, write nothing.")
@json_option
@quiet_option
def command(scene: str, as_json: bool, quiet: bool, **options: Any) -> None:
    """Form images of a scene with blur, noise, jitter, blooming and all else that a camera does.

    SCENE is an image file, or a pattern: flat, edge:ANGLE, bars:PERIOD,ANGLE, star:SECTORS, wedge:STEPS or
    discs:PITCH,DIAMETER.
    """
    from photoplan.cli.telling import Telling
    from photoplan.engine.executors import available_cpus
    from photoplan.products.simulate.run import SimulateRequest, simulate

    options["workers"] = options["workers"] or available_cpus()
    with Telling(quiet) as events:
        report = simulate(SimulateRequest(scene, **options), events)
    if as_json:
        show_json(report)
    else:
        for image in report.images:
            show(image.path)
    if quiet:
        return
    if options["dry_run"]:
        say("dry run: nothing was written")
    along = " ".join(f"{axis} {value:.4f}" for axis, value in zip("xy", report.mtf50))
    say(
        f"{len(report.images)} images of {report.bands} × {report.size[0]} × {report.size[1]} pixels, {report.dtype} · "
        f"MTF50 of the model: {along} cycles per pixel"
    )
    for note in report.notes:
        say(note)

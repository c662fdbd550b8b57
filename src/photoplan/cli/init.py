"""`photoplan init`: a project file from the files that users have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import FOLDER, LISTED, PATH, beyond_area_option, ending, reading_options, table_format
from photoplan.cli.output import show, show_json, talking


@click.command("init")
@click.argument("folder", metavar="DIR", type=FOLDER)
@click.option("--images", required=True, metavar="PATTERN,…", help="Files; may be repeated.",
              **LISTED)  # fmt: skip
@click.option("--camera", type=PATH, help="Cameras: TOML, YAML or JSON [images have RPC].")
@click.option("--orientation", type=PATH, help="Orientation: TOML, JSON, table … [images are to be oriented].")
@click.option(
    "--terrain", metavar="FILE|HEIGHT", help="Raster of heights, or one height in metres; needed for products."
)
@click.option("--image-points", multiple=True, type=PATH, metavar="FILE", help="Measured image points.")
@click.option("--control", multiple=True, type=PATH, metavar="FILE", help="Ground points, control and check.")
@click.option("--positions", type=PATH, metavar="FILE", help="Observed projection centres (GNSS).")
@click.option("--crs", metavar="CRS", help="CRS of the project, EPSG:nnnn or WKT [the orientation's].")
@click.option(
    "--height-system",
    metavar="NAME",
    help="What the files do not state: ellipsoidal, EPSG:nnnn (a vertical CRS), or same.",
)
@click.option("--terrain-crs", metavar="CRS", help="CRS of a terrain file that states none (ASC).")
@click.option("--terrain-height-system", metavar="NAME", help="The terrain's alone.")
@click.option("--orientation-height-system", metavar="NAME", help="The orientation's alone.")
@reading_options
@click.option(
    "--earth-curvature",
    type=click.Choice(["none", "correction", "strict"]),
    help="Curved earth and map scale [strict for poses in true metres, such as OpenSfM's; else none].",
)
@click.option(
    "--scene",
    type=click.Choice(["z<0", "z>0"]),
    default="z<0",
    show_default=True,
    help="Side of the image on which the scene lies in the camera system of angles and fiducial marks.",
)
@click.option("--refraction", is_flag=True, help="Correct for refraction by a standard atmosphere.")
@beyond_area_option
@ending()
def command(folder: Path, as_json: bool, quiet: bool, **options: Any) -> None:
    """Write DIR/project.toml from images, camera, orientation and terrain.

    Prints the path of the project file on stdout. Height systems must be stated by the files or declared. Without
    --orientation the images are to be oriented (tie, resect, adjust), and --crs is needed.
    """
    from photoplan.products.init import InitRequest, init_project

    form = table_format(options)
    options["scene"] = {"z<0": "z < 0", "z>0": "z > 0"}[options["scene"]]
    talk = talking(quiet)
    result = init_project(InitRequest(folder=folder, form=form, **options), talk)
    if not as_json:
        show(result.path)
        return
    facts = {
        "project": str(result.path),
        "images": [i.name for i in result.project.images],
        "crs": result.project.crs,
        "height_systems": {
            "terrain": result.project.terrain and result.project.terrain.height_system,
            "orientation": result.project.orientation.height_system,
        },
        "without_orientation": list(result.without_orientation),
        "without_image": list(result.without_image),
    }
    show_json(facts)

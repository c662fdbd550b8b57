"""`photoplan init`: a project file from the files that users have."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import json_option

__all__ = ["command"]

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}


@click.command("init")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@click.option("--images", "images", multiple=True, required=True, metavar="PATTERN", help="Files; may be repeated.")
@click.option("--camera", required=True, type=click.Path(path_type=Path), help="Cameras: TOML, YAML or JSON.")
@click.option(
    "--orientation", required=True, type=click.Path(path_type=Path), help="Orientation: TOML, JSON, CSV or other table."
)
@click.option("--terrain", required=True, metavar="FILE|HEIGHT", help="Raster of heights, or one height in metres.")
@click.option("--crs", metavar="CRS", help="CRS of the project, EPSG:nnnn or WKT [the orientation's].")
@click.option(
    "--height-system",
    metavar="NAME",
    help="What the files do not state: ellipsoidal, EPSG:nnnn (a vertical CRS), or same.",
)
@click.option("--terrain-crs", metavar="CRS", help="CRS of a terrain file that states none (ASC).")
@click.option("--terrain-height-system", metavar="NAME", help="The terrain's alone.")
@click.option("--orientation-height-system", metavar="NAME", help="The orientation's alone.")
@click.option("--columns", help="Columns of a table: name,x,y,z,omega,phi,kappa[,camera] or name=LABEL,x=…")
@click.option("--delimiter", type=click.Choice([*_DELIMITERS]), help="Of a table [found by itself].")
@click.option("--decimal-comma", is_flag=True, help="Numbers of a table are written 1,5.")
@click.option("--angle-unit", type=click.Choice(["deg", "gon", "rad"]), default="deg", show_default=True)
@click.option(
    "--rotation",
    type=click.Choice(["opk", "pok", "kpo", "kop", "okp", "pko"]),
    default="opk",
    show_default=True,
    help="Order of omega, phi, kappa; the first is primary.",
)
@click.option(
    "--rotation-direction",
    "direction",
    type=click.Choice(["camera-to-ground", "ground-to-camera"]),
    default="camera-to-ground",
    show_default=True,
    help="What the table's rotation does.",
)
@click.option(
    "--earth-curvature", type=click.Choice(["none", "correction", "strict"]), default="none", show_default=True
)
@click.option("--refraction", is_flag=True, help="Correct for refraction by a standard atmosphere.")
@click.option("--overwrite", is_flag=True, help="Replace a project file that exists.")
@json_option
@click.option("-q", "--quiet", is_flag=True, help="No talk on stderr.")
def command(
    folder: Path,
    columns: str | None,
    delimiter: str | None,
    decimal_comma: bool,
    angle_unit: str,
    rotation: str,
    direction: Any,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Write DIR/project.toml from images, camera, orientation and terrain.

    Prints the path of the project file on stdout. Height systems must be stated by the files or declared.
    """
    from photoplan.io.orientation_table import TableFormat
    from photoplan.products.init import InitRequest, init_project

    sign: Any = _DELIMITERS[delimiter] if delimiter else None
    form = TableFormat(columns, sign, decimal_comma, angle_unit, rotation, direction)
    talk = (lambda line: None) if quiet else (lambda line: click.echo(line, err=True))
    result = init_project(InitRequest(folder=folder, form=form, **options), talk)
    if not as_json:
        click.echo(str(result.path))
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
    click.echo(json.dumps(facts, indent=2, ensure_ascii=False))

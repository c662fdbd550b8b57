"""`photoplan dtm profile`: heights along lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, POSITIVE, ending
from photoplan.cli.output import say, show, show_json


@click.command("profile")
@click.argument("model", type=PATH)
@click.argument("lines", type=PATH)
@click.option("-o", "--output", "outputs", type=PATH, required=True, multiple=True,
              metavar="FILE", help=".csv, or .png for a picture; may be repeated.")  # fmt: skip
@click.option("--tolerance", type=POSITIVE, default=0.001, show_default=True,
              metavar="M", help="Largest distance in height from the surface.")  # fmt: skip
@click.option("--x", metavar="NAME", help="Column of X of a CSV, by name or number [x, east, easting].")
@click.option("--y", metavar="NAME", help="Column of Y [y, north, northing].")
@click.option("--line", "line_column", metavar="NAME", help="Column that tells lines apart [line, if there is one].")
@click.option("--decimal-comma", is_flag=True, help="Numbers of a CSV are written 1,5.")
@click.option("--crs", help="CRS of a terrain file that does not state it.")
@ending()
def command(
    outputs: tuple[Path, ...],
    x: str | None,
    y: str | None,
    decimal_comma: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Profiles of MODEL over LINES: a vector file of lines, or a CSV of points along them, in the model's CRS.

    There is a point wherever the surface bends: at grid lines, breaklines and edges of triangles; at a wall two.
    """
    from photoplan.io.run_record import recording
    from photoplan.io.tables import Dialect
    from photoplan.io.terrain.points import PointTableFormat
    from photoplan.plain import pick
    from photoplan.products.dtm.profile import ProfileRequest, dtm_profile
    from photoplan.report.dtm.profile import profile_picture
    from photoplan.report.page import open_picture

    pictures = [path for path in outputs if path.suffix.lower() == ".png"]
    tables = tuple(path for path in outputs if path not in pictures)
    inputs, overwrite = [options["model"], options["lines"]], options["overwrite"]
    drawings = [open_picture(path, inputs, overwrite=overwrite) for path in pictures]
    form = PointTableFormat(x, y, Dialect(decimal_comma=decimal_comma))
    request = ProfileRequest(outputs=tables, form=form, **options)
    with recording("profile", request, inputs) as record:
        found = dtm_profile(request)
        for drawing in drawings:
            if drawing is not None:
                drawing.write(profile_picture(found))
        record(outputs, [pick(p, "name", "length") for p in found])
    if as_json:
        show_json({"files": outputs, "profiles": found})
        return
    for path in outputs:
        show(path)
    if not quiet:
        for p in found:
            heights = "no surface" if p.range is None else "{:.3f} to {:.3f} m".format(*p.range)
            say(f"{p.name}: {p.length:.2f} m, {len(p.distance)} points, {heights}")

"""`photoplan illumination`: light on slopes and haze, corrected in an orthophoto."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import LISTED, PATH, ending
from photoplan.cli.output import can_draw, show, show_json, talking

if TYPE_CHECKING:
    from photoplan.products.illumination import IlluminationReport


@click.command("illumination")
@click.argument("picture", type=PATH)
@click.option("--terrain", type=PATH, required=True, metavar="MODEL", help="Terrain model or raster of heights.")
@click.option("--sun", type=float, nargs=2, required=True, metavar="AZIMUTH ALTITUDE",
              help="From grid north, above the horizon, degrees.")  # fmt: skip
@click.option("--correct", metavar="NAME,…", **LISTED,
              help="cosine or c; haze or haze-by-height; both of them [c].")  # fmt: skip
@click.option("-o", "--output", type=PATH, required=True, metavar="TIF", help="The corrected picture.")
@click.option("--no-picture", is_flag=True, help="Do not draw what was before and after beside the output.")
@ending("Estimate the parameters and stop.", workers=True)
def command(as_json: bool, quiet: bool, no_picture: bool, correct: tuple[str, ...], **options: Any) -> None:
    """Take the light on slopes, and haze, out of PICTURE, an orthophoto.

    Parameters are estimated from the picture and printed with standard deviations. Where terrain casts its shadow, or
    turns away from the sun, slopes are not corrected.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.naming import together
    from photoplan.products.illumination import IlluminationRequest, correct_illumination
    from photoplan.report.illumination import draw_light
    from photoplan.report.page import open_picture

    request = IlluminationRequest(correct=correct or ("c",), **options)
    wanted = can_draw(not no_picture and not request.dry_run, talking(quiet))
    place = request.output.with_suffix(".png") if wanted else None
    drawing = open_picture(place, [request.picture, request.terrain], overwrite=request.overwrite)
    picture: Path | None = None
    with together():
        with Telling(quiet) as events:
            found = correct_illumination(request, events)
        if drawing is not None:
            picture = drawing.write(draw_light(found))
    if as_json:
        show_json(found, picture=picture)
        return
    for path in (found.path, picture):
        if path is not None:
            show(path)
    _print(found)


def _print(found: IlluminationReport) -> None:
    model = found.model
    names = ("per cos i", "a of c" if "c" in model.corrections else "sky", "haze", "haze per 100 m")
    for number, (band, before, after) in enumerate(zip(model.bands, *found.correlations), 1):
        values = (band.slope, band.sky, band.haze, band.haze_by_height)
        told = [
            f"{name} {value:.4g} ± {sigma:.2g}"
            for name, value, sigma in zip(names, values, band.sigmas)
            if value or sigma
        ]
        show(f"band {number}: {', '.join(told)}; correlation with cos i {before:+.3f}, then {after:+.3f}")
    dark = float((~found.sample.lit).mean())
    show(f"{dark:.1%} of the sample lie in shadow or turn away from the sun; slopes are not corrected there")

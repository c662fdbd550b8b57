"""`photoplan view picture`: a picture of what is seen from a point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH
from photoplan.cli.view_options import camera_options, run_view, running_options, take_request

_RGB: dict[str, Any] = {"type": int, "nargs": 3, "default": None, "metavar": "R G B"}
_LOOK = ("haze", "haze_colour", "sky", "nodata", "samples", "kernel", "shadows")


@click.command("picture")
@camera_options
@click.option("--content", "contents", multiple=True, metavar="WHAT",
              help="shade, tint[:RAMP[:LOW:HIGH]], slope, photos, photo:NAME, or a raster on the map; may be repeated, "
              "later ones over earlier ones, with @OPACITY [tint, shade@0.8; of a project photos].")  # fmt: skip
@click.option(
    "--matrix", type=PATH, help="Coordinate matrix of this view: content is changed, nothing looked for again."
)
@click.option("--sun", type=float, nargs=2, default=None, metavar="AZIMUTH ALTITUDE", help="Degrees [315 45].")
@click.option("--shadows", is_flag=True, default=None, help="Terrain and objects cast shadows.")
@click.option("--haze", type=float, help="Coefficient of haze, per kilometre [0; 0.1 is much].")
@click.option("--haze-colour", help="Colour of the horizon in haze [200 210 222].", **_RGB)
@click.option("--sky", help="Colour of the sky [186 212 238].", **_RGB)
@click.option("--nodata", help="Colour of ground that no content shows [214 214 214].", **_RGB)
@click.option("--samples", type=int, help="Rays along each side of a pixel [2].")
@click.option("--kernel", help="nearest, bilinear, bicubic, bicubic-1 or lanczos3 [bicubic].")
@click.option("--photo", metavar="FILE[@HOW]",
              help="A photograph with the pixels of the picture: over it, with an opacity (@0.3; 0.5), in @squares "
              "with it, or @beside it.")  # fmt: skip
@click.option("--lines", multiple=True, metavar="WHAT",
              help="FILE[:LAYER] of points and lines, or contours:INTERVAL; may be repeated. With "
              "@colour=#d55e00,width=2,dash=6-3,label=name,height=yes,distance=yes,rank=field,drape=yes.")  # fmt: skip
@click.option("--text-size", type=float, default=13.0, show_default=True, help="Of labels, pixels.")
@click.option("--svg", type=PATH, help="Lines and labels as a layer over the picture, too.")
@click.option("-o", "--output", type=PATH, metavar="PICTURE", help="PNG, JPEG or GeoTIFF; not needed with --dry-run.")
@running_options
def command(contents: tuple[str, ...], sun: tuple[float, float] | None, output: Path | None, **options: Any) -> None:
    """A picture of SOURCE, a project or terrain model, from a standpoint or with an image's own camera.

    The same command continues a run that was interrupted.
    """
    from photoplan.errors import UsageError
    from photoplan.products.view.content import ContentRequest
    from photoplan.products.view.job import LookRequest
    from photoplan.products.view.lines import LinesRequest
    from photoplan.products.view.photo import PhotoRequest

    look = {name: value for name in _LOOK if (value := options.pop(name)) is not None}
    if sun is not None:
        look |= {"azimuth": sun[0], "altitude": sun[1]}
    if contents:
        look["contents"] = tuple(ContentRequest.parse(text) for text in contents)
    elif options["source"].suffix.lower() == ".toml":
        look["contents"] = (ContentRequest("photos"),)
    photo = options.pop("photo")
    if photo is not None:
        look["photo"] = PhotoRequest.parse(photo)
    if output is None and not options["dry_run"]:
        raise UsageError("no `output`; give the name of the picture, or `dry_run`")
    drawn: dict[str, Any] = {name: options.pop(name) for name in ("lines", "text_size", "svg")}
    if drawn["lines"]:
        drawn["lines"] = tuple(LinesRequest.parse(text) for text in drawn["lines"])
        if any("label" in dict(each.options) for each in drawn["lines"]):
            from photoplan.report.lettering import lettering

            drawn["lettering"] = lettering(drawn["text_size"])
    request = take_request(options, output=output, look=LookRequest(**look), matrix=options.pop("matrix"), **drawn)
    run_view(request, options)

"""Options of how views look, of pictures and of sequences."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import several

_RGB: dict[str, Any] = {"type": int, "nargs": 3, "default": None, "metavar": "R G B"}
_LOOK = ("haze", "haze_colour", "sky", "nodata", "water_colour", "samples", "kernel", "tolerance", "shadows")

#: Contents, light, lines and pairs.
look_options = several(
    click.option(
        "--content",
        "contents",
        multiple=True,
        metavar="WHAT",
        help="shade, tint[:RAMP[:LOW:HIGH]], slope, photos, photo:NAME, or a raster on the map; may be repeated, "
        "later ones over earlier ones, with @OPACITY, rasters of classes with @classes "
        "[tint, shade@0.8; of a project photos].",
    ),
    click.option("--sun", type=float, nargs=2, default=None, metavar="AZIMUTH ALTITUDE", help="Degrees [315 45]."),
    click.option("--shadows", is_flag=True, default=None, help="Terrain and objects cast shadows."),
    click.option("--haze", type=float, help="Coefficient of haze, per kilometre [0; 0.1 is much]."),
    click.option("--haze-colour", help="Colour of the horizon in haze [200 210 222].", **_RGB),
    click.option("--sky", help="Colour of the sky [186 212 238].", **_RGB),
    click.option("--nodata", help="Colour of ground that no content shows [214 214 214].", **_RGB),
    click.option("--water-colour", help="Colour of water that no raster or photo shows [112 150 184].", **_RGB),
    click.option("--samples", type=int, help="Rays along each side of a pixel [2]."),
    click.option("--kernel", help="nearest, bilinear, bicubic, bicubic-1 or lanczos3 [bicubic]."),
    click.option(
        "--tolerance",
        type=float,
        metavar="PX",
        help="Largest error of places in rasters and photos; 0: every pixel strictly [0.02].",
    ),
    click.option(
        "--lines",
        multiple=True,
        metavar="WHAT",
        help="FILE[:LAYER] of points and lines, or contours:INTERVAL; may be repeated. With "
        "@colour=#d55e00,width=2,dash=6-3,label=name,height=yes,distance=yes,rank=field,drape=yes.",
    ),
    click.option("--text-size", type=float, default=13.0, show_default=True, help="Of labels, pixels."),
    click.option(
        "--stereo", type=click.Choice(["side-by-side", "anaglyph"]), help="A pair: left and right, or red-cyan."
    ),
    click.option(
        "--base", type=float, help="Distance of both eyes, metres [a thirtieth of that of the nearest ground]."
    ),
)


def take_look(options: dict[str, Any], photo: str | None = None) -> dict[str, Any]:
    """Fields of a request of views, taken out of the options of a verb."""
    from photoplan.errors import UsageError
    from photoplan.products.view.content import ContentRequest
    from photoplan.products.view.lines import LinesRequest
    from photoplan.products.view.make import LookRequest, Stereo
    from photoplan.products.view.photo import PhotoRequest

    look = {name: value for name in _LOOK if (value := options.pop(name)) is not None}
    contents, sun, how, base = (options.pop(name) for name in ("contents", "sun", "stereo", "base"))
    if sun is not None:
        look |= {"azimuth": sun[0], "altitude": sun[1]}
    if contents:
        look["contents"] = tuple(ContentRequest.parse(text) for text in contents)
    elif options["source"].suffix.lower() == ".toml":
        look["contents"] = (ContentRequest("photos"),)
    if photo is not None:
        look["photo"] = PhotoRequest.parse(photo)
    if how is None and base is not None:
        raise UsageError("`base` belongs to a pair; give `stereo`, too")
    out: dict[str, Any] = {
        "look": LookRequest(**look),
        "lines": options.pop("lines"),
        "text_size": options.pop("text_size"),
    }
    out["stereo"] = None if how is None else Stereo(how, base)
    if out["lines"]:
        out["lines"] = tuple(LinesRequest.parse(text) for text in out["lines"])
        if any("label" in dict(each.options) for each in out["lines"]):
            from photoplan.report.drawing import lettering

            out["lettering"] = lettering(out["text_size"])
    return out

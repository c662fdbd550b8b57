"""`photoplan dtm tint`: height tints of a terrain model."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.dtm_shade import light_options, picture_options, report_picture, take_light, take_request


@click.command("tint")
@picture_options
@click.option("--ramp", default="hypsometric", show_default=True, metavar="NAME|FILE",
              help="hypsometric, grey, spectral, or a text file with lines `height red green blue`.")  # fmt: skip
@click.option("--heights", type=float, nargs=2, default=None, metavar="LOW HIGH", help="Ends of a built-in ramp [all].")
@click.option("--classes", type=click.IntRange(1, 1000), metavar="N", help="So many classes instead of blends.")
@click.option("--classed", is_flag=True, help="With a ramp file: each height takes the colour of the entry below it.")
@click.option("--shade", is_flag=True, help="Combine with the hillshade.")
@click.option("--strength", type=float, default=0.6, show_default=True, help="How much of it, 0 to 1.")
@light_options
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Colours by height: red, green, blue, with a mask where MODEL has no terrain."""
    from photoplan.products.dtm.shading import make_picture, tint_picture
    from photoplan.terrain.shading import RAMPS

    ramp, span, steps = options.pop("ramp"), options.pop("heights"), options.pop("classes")
    classed, shade, strength = options.pop("classed"), options.pop("shade"), options.pop("strength")
    built_in = ramp in RAMPS
    if not built_in and (span is not None or steps is not None):
        raise click.UsageError("--heights and --classes go with a built-in --ramp; a file states its heights itself")
    if built_in and classed:
        raise click.UsageError("--classed goes with a ramp file; give --classes N with a built-in ramp")
    light = take_light(options)
    picture = tint_picture(ramp, span, 0 if classed else steps, light if shade else None, strength)
    request = take_request(options)
    report_picture(lambda events: make_picture(request, picture, events), as_json, quiet)

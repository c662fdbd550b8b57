"""`photoplan dtm slope`: slope, slope classes or aspect of a terrain model."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.dtm_shade import picture_options, report_picture, take_request


@click.command("slope")
@picture_options
@click.option("--percent", is_flag=True, help="Percent instead of degrees, for --classes too.")
@click.option("--classes", metavar="A,B,…", help="Write classes: 1 below A, 2 from A to B, …; e.g. 5,10,20,35.")
@click.option("--aspect", is_flag=True, help="Write the direction of fall instead, degrees from north; flat: -1.")
def command(percent: bool, classes: str | None, aspect: bool, as_json: bool, quiet: bool, **options: Any) -> None:
    """Slope in degrees (float32), its classes (with a colour table), or the aspect.

    Places without terrain are NaN, or class 0.
    """
    from photoplan.products.dtm.shading import aspect_picture, make_picture, slope_picture

    if aspect and (percent or classes):
        raise click.UsageError("--aspect goes with neither --percent nor --classes")
    picture = aspect_picture() if aspect else slope_picture("percent" if percent else "degrees", _limits(classes))
    request = take_request(options)
    report_picture(lambda events: make_picture(request, picture, events), as_json, quiet)


def _limits(text: str | None) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.replace(",", " ").split()) if text else ()
    except ValueError:
        raise click.UsageError(f"--classes {text!r}; write rising numbers such as 5,10,20,35") from None

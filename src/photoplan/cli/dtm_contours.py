"""`photoplan dtm contours`: contour lines of a terrain model."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, POSITIVE, bounds_option, ending
from photoplan.cli.output import say, show, show_json


@click.command("contours")
@click.argument("model", type=PATH)
@click.option("--interval", type=POSITIVE, required=True, metavar="M", help="Height between contours, metres.")
@click.option("--base", type=float, default=0.0, show_default=True, help="Height that contours are counted from.")
@click.option("--index", type=click.IntRange(0), default=5, show_default=True, help="Every N-th is an index contour.")
@click.option("--smooth", is_flag=True, help="Smooth lines inside their band; they never cross.")
@click.option("--simplify", is_flag=True, help="Leave out vertices inside the band; lines never cross.")
@click.option("--band", type=click.FloatRange(0, 0.5, min_open=True, max_open=True), default=0.25, show_default=True,
              help="Half width of the band, part of the interval.")  # fmt: skip
@click.option("--shortest", type=click.FloatRange(0), default=0.0, help="Leave out lines shorter than this, metres.")
@bounds_option
@click.option("--labels", is_flag=True, help="Places for labels: a second layer or file.")
@click.option("--label-all", is_flag=True, help="Labels on every contour, not on index contours alone.")
@click.option("--text-height", type=POSITIVE, help="Height of labels, metres on the ground [1/200 of the extent].")
@click.option("--label-spacing", type=POSITIVE, help="Metres between labels of a line [60 text heights].")
@click.option("--crs", help="CRS of a model that does not state it.")
@click.option("-o", "--output", type=PATH, required=True, metavar="FILE", help=".gpkg, .shp, .geojson or .dxf")
@click.option("--preview", type=PATH, metavar="PNG", help="A small picture to look at, too.")
@ending()
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Contour lines on MODEL's own surface: they bend sharply at breaklines, end at borders and at walls.

    Columns: height, is_index, depression. Higher ground is on a line's right. A post exactly at a level counts as above
    it.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.run_record import recording
    from photoplan.products.dtm.contours import ContourRequest, make_contours
    from photoplan.report.dtm.profile import contours_picture
    from photoplan.report.page import open_picture
    from photoplan.terrain.contours.run import ContourOptions

    names = ("interval", "base", "index", "smooth", "simplify", "band", "shortest")
    chosen = ContourOptions(**{name: options.pop(name) for name in names})
    preview, output = options.pop("preview"), options["output"]
    if preview is not None and preview.resolve() == output.resolve():
        raise click.UsageError(f"{preview}: the preview has the name of the output; choose another one")
    drawing = open_picture(preview, [options["model"]], overwrite=options["overwrite"])
    request = ContourRequest(options=chosen, sketch=drawing is not None, **options)
    with recording("contours", request, [request.model]) as record:
        with Telling(quiet) as events:
            facts = make_contours(request, events)
        if drawing is not None:
            drawing.write(contours_picture(facts))
        record([*facts.files, preview], facts)
    if as_json:
        show_json(facts, preview=preview)
        return
    for path in [*facts.files, *([preview] if preview else [])]:
        show(path)
    if quiet:
        return
    if not facts.lines:
        say(f"no contour: no level of {chosen.base:g} + n × {chosen.interval:g} m is passed")
        return
    labels = "" if facts.text_height is None else f", {len(facts.labels)} labels {facts.text_height:g} m high"
    say(
        f"{facts.lines} contours from {facts.lowest:.10g} to {facts.highest:.10g} m, {facts.length / 1000:.6g} km, "
        f"{facts.vertices} vertices; {facts.closed} closed, {facts.depressions} round hollows{labels}"
    )

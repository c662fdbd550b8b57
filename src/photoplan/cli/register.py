"""`photoplan register`: two images compared to a small part of a pixel."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import PATH, ending

if TYPE_CHECKING:
    from photoplan.products.register.run import RegisterReport


@click.command("register")
@click.argument("first", type=PATH)
@click.argument("second", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, metavar="GPKG", help="Vectors; NAME.csv beside it.")
@click.option("--radius", type=int, default=10, show_default=True, help="Of a round patch, pixels, 4 to 50.")
@click.option("--spacing", type=int, metavar="PX", help="Distance of the patches [they touch].")
@click.option(
    "--search", type=float, default=3.0, show_default=True, help="Largest displacement in x and y, pixels, up to 30."
)
@click.option("--correlation", type=float, default=0.7, show_default=True, help="Least correlation of a patch.")
@click.option("--sigma", type=float, default=0.2, show_default=True, help="Largest standard deviation, pixels.")
@click.option("--model", default="affine", show_default=True, metavar="KIND", help="none, shift or affine.")
@click.option("--no-picture", is_flag=True, help="Do not write NAME.png.")
@ending("Open both images, say how many patches there are, and stop.", workers=True)
def command(as_json: bool, quiet: bool, no_picture: bool, **options: Any) -> None:
    """Find by how much SECOND lies beside FIRST, patch by patch, to a small part of a pixel.

    Both have the same pixels, or places on one map. Each vector, in pixels of FIRST, says how far from its expected
    place the content of a patch lies in SECOND, with its standard deviation.
    """
    from photoplan.cli.output import can_draw, say, show, show_json, talking
    from photoplan.cli.telling import Telling
    from photoplan.io.naming import together
    from photoplan.products.register.run import RegisterRequest, register
    from photoplan.report.page import open_picture
    from photoplan.report.register import draw_vectors

    request = RegisterRequest(**options)
    wanted = can_draw(not no_picture and not request.dry_run, talking(quiet))
    place: Path | None = request.output.with_suffix(".png") if wanted else None
    drawing = open_picture(place, [request.first, request.second], overwrite=request.overwrite)
    with together():
        with Telling(quiet) as events:
            report = register(request, events)
        picture = None if drawing is None else drawing.write(draw_vectors(report))
    for note in report.notes:
        say(note)
    if as_json:
        show_json(report, picture=picture)
        return
    if report.output is None:
        rows, columns = report.shape
        show(f"{columns} × {rows} patches of {2 * request.radius + 1} px, every {report.step} px")
        return
    for path in (report.output, report.table, picture):
        if path is not None:
            show(path)
    _print(report)


def _print(report: RegisterReport) -> None:
    from photoplan.cli.output import show

    f = report.figures
    assert f is not None
    left = ", ".join(f"{count} {name}" for name, count in f.counts.items() if count and name != "found")
    shares = ", ".join(f"{name} % {value:.3f}" for name, value in f.percentiles.items())
    metres = "" if report.pair.pixel is None else f"; a pixel is {report.pair.pixel:.4g} on the map"
    rows = [
        ("patches", f"{f.counts['found']} of {f.patches} found" + (f"; left out: {left}" if left else "")),
        ("median", f"dx {f.median[0]:+.4f}, dy {f.median[1]:+.4f} px{metres}"),
        ("rms", f"dx {f.rms[0]:.4f}, dy {f.rms[1]:.4f} px"),
        ("lengths", f"{shares}, longest {f.largest:.3f} px"),
        ("within", f"1/4 px {f.quarter:.2%}, 1/2 px {f.half:.2%}"),
        ("sigma", f"{f.sigma[0]:.4f}, {f.sigma[1]:.4f} px (median), correlation {f.correlation:.3f}"),
    ]
    if report.model is not None:
        m = report.model
        sigma = (m.covariances[:, 0, 0] ** 0.5).tolist()
        shift = ", ".join(f"{axis} {m.unknowns[k, 0]:+.4f} ± {sigma[k]:.4f}" for k, axis in enumerate(("dx", "dy")))
        rows.append((m.kind, f"in the middle {shift} px; residuals {m.rms[0]:.4f}, {m.rms[1]:.4f} px (rms)"))
    for what, text in rows:
        show(f"{what:8} {text}")

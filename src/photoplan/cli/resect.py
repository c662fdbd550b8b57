"""`photoplan resect`: orient single images by control points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import PATH, POSITIVE, PROJECT, ending, images_option
from photoplan.cli.output import end_with_failures, say, show, show_json
from photoplan.plain import shown_metres

if TYPE_CHECKING:
    from photoplan.products.film import ResectedImage, ResectResult

_DIGITS = {"deg": 4, "gon": 4, "rad": 6}


@click.command("resect")
@click.argument("project", type=PROJECT)
@images_option("all with 3 control points")
@click.option("--image-points", multiple=True, type=PATH, metavar="FILE", help="Instead of the project's.")
@click.option("--control", multiple=True, type=PATH, metavar="FILE", help="Instead of the project's.")
@click.option("--sigma-image", type=POSITIVE, help="Of image points, pixels [the project's].")
@click.option("--sigma-control", type=click.FloatRange(0), nargs=2, metavar="XY Z", help="Metres [the project's].")
@click.option(
    "--free",
    metavar="c,x0,y0,k1",
    help="Parameters of the camera that are unknowns (also k2, k3, p1, p2, b1, b2); one image only.",
)
@click.option("--unknown-camera-constant", is_flag=True, help="Not even about known; one image only.")
@click.option("--critical", type=click.FloatRange(2, 20), default=4.0, show_default=True,
              help="Normalised residual from which a point is a gross error.")  # fmt: skip
@click.option("--report", type=PATH, metavar="HTML", help="Residuals with pictures.")
@ending("Do not write into the project.")
def command(as_json: bool, quiet: bool, free: str | None, **options: Any) -> None:
    """Exterior orientation of single images by control points, without start values.

    Writes center, angles and their standard deviations into PROJECT. An image that fails does not stop the others;
    they are listed at the end (exit code 4).
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.film import ResectRequest, resect_project
    from photoplan.report.page import open_report
    from photoplan.report.resect import resect_page

    parameters = tuple(dict.fromkeys(p.strip() for p in (free or "").split(",") if p.strip()))
    given = [*options["image_points"], *options["control"]]
    overwrite, project = options.pop("overwrite"), options["project"]
    page = open_report(options.pop("report"), given, overwrite=overwrite, project=project)
    request = ResectRequest(free=parameters, **options)
    with Telling(quiet) as events:
        events.begin("resection", 0, "images")
        result = resect_project(request, events)
    report = None if page is None or not result.images else page.write(resect_page(result))
    if as_json:
        show_json(result, report=report)
    else:
        _show(result, report)
    _talk(result, quiet)
    end_with_failures(result.failed, len(result.images), "images could not be oriented")


def _show(result: ResectResult, report: Path | None) -> None:
    for image in result.images:
        for line in _lines(image):
            show(line)
    if report is not None:
        show(report)


def _lines(image: ResectedImage) -> list[str]:
    """An image with its parameters and their standard deviations."""
    found = image.found
    used = int((~found.rejected).sum())
    sign, digits = image.angle_sign, _DIGITS[image.angle_unit]
    center = zip(("X0", "Y0", "Z0"), image.center, image.sigma_center)
    angles = zip(image.angle_names, image.angles, image.sigma_angles)
    lines = [
        f"{image.image.name}  {used} points · redundancy {found.redundancy} · sigma0 {found.sigma0:.3g} · "
        f"rms {found.rms:.2f} px" + (f" · 95 % within {found.reach_95:.1f} times ±" if found.redundancy > 0 else ""),
        "  " + "  ".join(_with_sigma(*parameter) for parameter in center),
        "  " + "  ".join(f"{name} {value:.{digits}f} ±{sigma:.{digits}f}{sign}" for name, value, sigma in angles),
    ]
    if image.calibrated is not None:
        c = image.calibrated
        rows = zip(c.parameters, c.after, c.sigma, c.units)
        lines.append("  " + "  ".join(f"{name} {value:.4f} ±{sigma:.4f} {u}" for name, value, sigma, u in rows))
    return lines + [f"  {line}" for line in image.gross_errors]


def _with_sigma(name: str, value: float, sigma: float) -> str:
    return f"{name} {shown_metres(value, sigma).removesuffix(' m')} ±{shown_metres(sigma, sigma)}"


def _talk(result: ResectResult, quiet: bool) -> None:
    for note in result.notes:
        say(note)
    for image in result.images:
        for note in image.notes:
            say(f"{image.image.name}: {note}")
    if result.left_out:
        names = ", ".join(result.left_out[:5]) + (" …" if len(result.left_out) > 5 else "")
        say(f"{len(result.left_out)} images have fewer than 3 control points: {names}")
    if result.written and not quiet:
        say(f"{result.project}: orientation of {len(result.images)} images written")

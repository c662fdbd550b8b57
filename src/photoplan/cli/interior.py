"""`photoplan interior`: interior orientation of film scans from their measured marks."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, PROJECT, ending, images_option
from photoplan.cli.output import end_with_failures, say, show, show_json


@click.command("interior")
@click.argument("project", type=PROJECT)
@images_option("all film")
@click.option(
    "--model",
    type=click.Choice(["similarity", "affine", "bilinear"]),
    help="From marks to scan [what the camera states].",
)
@click.option("--scan-resolution", metavar="DPI|UM", help="Such as 1200dpi or 21um [what the files state].")
@click.option("--report", type=PATH, metavar="HTML", help="Figures and plots as a page.")
@click.option("--plot", type=PATH, metavar="PNG", help="Residual vectors.")
@click.option("--write", is_flag=True, help="Make --model that of the cameras in the project file.")
@ending()
def command(images: tuple[str, ...], as_json: bool, quiet: bool, **options: Any) -> None:
    """Residuals, sigma0, scales, shear and film shrinkage of the scans in PROJECT.

    An image whose marks are missing, exchanged, mirrored or wrong does not stop the others; they are listed at the end
    (exit code 4).
    """
    from photoplan.io.store import recording
    from photoplan.products.film import InteriorRequest, interior_orientations
    from photoplan.report.interior import draw_residuals, interior_page
    from photoplan.report.page import open_picture, open_report

    project, overwrite = options["project"], options.pop("overwrite")
    page = open_report(options.pop("report"), (), overwrite=overwrite, project=project)
    plot = open_picture(options.pop("plot"), (), overwrite=overwrite, project=project)
    request = InteriorRequest(images=images or None, **options)
    with recording("interior", request, [project]) as record:
        found = interior_orientations(request)
        report = picture = None
        if page is not None and found.images:
            title = f"Interior orientation · {project.resolve().parent.name}"
            report = page.write(interior_page(found, title))
        if plot is not None and found.images:
            picture = plot.write(draw_residuals(found.images))
        record([project if found.written else None, report, picture], found)
    if as_json:
        show_json(found, report=report, plot=picture)
    else:
        for image in found.images:
            show(image)
        for path in (report, picture):
            if path is not None:
                show(path)
    if found.unmeasured:
        say(f"marks not measured in {', '.join(found.unmeasured)}: photoplan fiducials finds them")
    if not quiet:
        for camera in found.written:
            say(f"camera {camera!r}: interior = {options['model']!r} written to the project")
    end_with_failures(found.failed, len(found.images))

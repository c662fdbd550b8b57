"""`photoplan adjust`: bundle adjustment of a project."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import NEW_FOLDER, PROJECT, ending, images_option
from photoplan.cli.output import say, show, show_json
from photoplan.plain import shown_metres

if TYPE_CHECKING:
    from photoplan.products.adjust.run import AdjustReport

#: Gross errors and notes that are named; the rest is in the report.
_SHOWN = 20


@click.command("adjust")
@click.argument("project", type=PROJECT)
@click.option(
    "--calibrate", multiple=True, metavar="CAMERA=c:SIGMA,x0,…", help="Unknowns, with what is known [as stated]."
)
@click.option(
    "--datum",
    type=click.Choice(["observations", "orientations"]),
    help="What places the block: control and observed positions, or the orientations in PROJECT [as stated].",
)
@images_option()
@click.option("--no-robust", is_flag=True, help="Seek no gross errors.")
@click.option("--critical", type=float, default=4.0, show_default=True, help="Normalised residual of a gross error.")
@click.option("--no-variance-components", is_flag=True, help="Weight groups as stated, not as their residuals show.")
@click.option("--no-correlation", is_flag=True, help="Take errors of neighbouring image points as independent.")
@click.option("--iterations", type=click.IntRange(1), default=40, show_default=True, help="Most of each solution.")
@click.option("-o", "--output", type=NEW_FOLDER, metavar="FOLDER", help="Report [PROJECT/adjustment].")
@ending("Adjust and print the figures; write nothing.")
def command(as_json: bool, quiet: bool, **options: Any) -> None:
    """Orientations, points and cameras from all measurements of a project at once.

    Measurements are the files that [observations] names. Orientations and calibrated cameras are written into the
    project file (the one before is kept as *.previous.toml), a report and the points into the output folder.

    Images that cannot be oriented do not stop the others; they are listed at the end (exit code 4), and products leave
    them out.
    """
    from photoplan.cli.telling import Telling
    from photoplan.errors import ImagesLeftOut
    from photoplan.io.store import together
    from photoplan.products.adjust.run import AdjustRequest, adjust_project
    from photoplan.report.adjust import adjust_page
    from photoplan.report.page import open_report

    for name in ("robust", "variance_components", "correlation"):
        options[name] = not options.pop(f"no_{name}")
    request, page = AdjustRequest(**options), None
    if not request.dry_run:
        place = request.folder / "report.html"
        page = open_report(place, (), overwrite=request.overwrite, project=request.project)
    with together():
        with Telling(quiet) as events:
            report = adjust_project(request, events)
        written = report.written
        if page is not None:
            written = (page.write(adjust_page(report.figures)), *written)
    if as_json:
        show_json(report, files=written)
    else:
        for path in written:
            show(path)
        for line in _figures(report):
            show(line)
    for line in _doubts(report):
        say(line)
    for line in _talk(report):
        events.talk(line)
    if report.not_oriented:
        raise ImagesLeftOut(_not_oriented(report))


def _not_oriented(report: AdjustReport) -> str:
    """The images that are not oriented, by reason, and what may help."""
    names: dict[str, list[str]] = {}
    for name, reason in report.not_oriented:
        names.setdefault(reason, []).append(name)
    count = len(report.figures.images) + len(report.not_oriented)
    return "\n".join(
        [
            f"{len(report.not_oriented)} of {count} images could not be oriented; those of the others are "
            + ("written, and products leave these out:" if report.written else "determined:"),
            *(f"  {', '.join(images)}: {reason}" for reason, images in names.items()),
            "more tie points may connect them: `photoplan tie --overwrite` with other --pairs, --scale or --features; "
            "or control points in them",
        ]
    )


def _figures(report: AdjustReport) -> list[str]:
    f = report.figures
    lines = [
        f"sigma0 {f.sigma0:.3f} · image residuals {f.rms_pixels:.3f} px rms · redundancy {f.redundancy} · "
        f"{f.unknowns} unknowns · {f.iterations} iterations · {f.seconds:.1f} s",
        f"{len(f.images) + len(f.corrections)} images, {f.points} points adjusted · "
        f"{f.rejected} gross errors taken out",
    ]
    width = max((len(g.name) for g in f.groups), default=0)
    for g in f.groups:
        known = math.isfinite(g.factor)
        ratio = f"found/stated {g.factor:.2f}" if known else f"as stated (redundancy {g.redundancy:.1f}: not estimated)"
        lines.append(f"  {g.name:<{width}}  {g.count:>7}  rms {g.rms:>9.4g} {g.unit:<3}  {ratio}")
    for camera in f.cameras:
        for k, name in enumerate(camera.parameters):
            change = camera.after[k] - camera.before[k]
            value = f"{camera.after[k]:.8g} {camera.units[k]}".rstrip()
            lines.append(f"  camera {camera.name}: {name} {value} ± {camera.sigma[k]:.2g} (change {change:+.3g})")
    for image in f.corrections:
        found = ", ".join(f"{p.name} {p.value:+.4g} ± {p.sigma:.2g} {p.unit}" for p in image.parameters)
        lines.append(f"  {image.name}: {found or 'nothing of it was unknown'}")
    if f.check is not None:
        c = f.check
        count = max(c.horizontal, c.vertical)
        rmse = f"RMSE_H {shown_metres(c.rmse_h, c.rmse_h)}, RMSE_V {shown_metres(c.rmse_v, c.rmse_v)}"
        lines.append(f"check points: {rmse}, {count} points (ASPRS 2023)")
        lines += [f"  warning: {text}" for text in c.warnings]
    return lines


def _sigmas(normalised: float) -> str:
    return f", {abs(normalised):.1f} sigma" if math.isfinite(normalised) else ""


def _doubts(report: AdjustReport) -> list[str]:
    """Gross errors and notes, which are printed with `quiet` too."""
    f = report.figures
    lines = [f"gross error: {m.what}: {m.residual}{_sigmas(m.normalised)}" for m in f.gross[:_SHOWN]]
    if len(f.gross) > _SHOWN:
        lines.append(f"and {len(f.gross) - _SHOWN} more gross errors; all are in report.json")
    return [*lines, *f.notes]


def _talk(report: AdjustReport) -> list[str]:
    f = report.figures
    lines: list[str] = []
    if f.left_out:
        reasons: dict[str, int] = {}
        for _, reason in f.left_out:
            reasons[reason] = reasons.get(reason, 0) + 1
        lines += [f"left out: {count} × {reason}" for reason, count in reasons.items()]
    if report.orientations:
        lines.append(f"orientations of {report.orientations} images written into the project")
    return lines

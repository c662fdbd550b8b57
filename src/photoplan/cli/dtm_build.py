"""`photoplan dtm build`: a terrain model from measured points and lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import PATH, POSITIVE, beyond_area_option, ending
from photoplan.cli.output import can_draw, is_doubt, say, show, show_json

if TYPE_CHECKING:
    from photoplan.products.dtm.build import BuildReport, BuildRequest

#: Findings and gross errors that are shown; all are in the report, in the model and in --json.
_SHOWN = 10


@click.command("build")
@click.argument("points", type=PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=PATH, required=True, metavar="MODEL", help="The model, a .gpkg.")
@click.option(
    "--grid-width", type=POSITIVE, metavar="M", help="Grid width [half the spacing; half of that at breaklines]."
)
@click.option("--adapt", type=click.FloatRange(0), metavar="M", help="Widen a unit's grid while its surface stays "
              "within this; 0: never [a quarter of its standard deviation].")  # fmt: skip
@click.option("--unit-meshes", type=int, default=64, show_default=True, help="Meshes of a unit's side: a power of two.")
@click.option("--filter", "filters", multiple=True, metavar="CLASS=M", help="Standard deviation of measurement of "
              "mass, spot, breakline, formline, border or hole [mass: estimated; others: a share of it].")  # fmt: skip
@click.option("--covariance", default="auto", show_default=True, help="auto, gaussian, matern or exponential.")
@click.option("--gross", type=click.FloatRange(0), default=5.0, show_default=True, help="Normalised residual of gross "
              "errors; 0: none is sought.")  # fmt: skip
@click.option("--reach", type=POSITIVE, metavar="M", help="Gaps over twice this stay open [10 spacings].")
@click.option("--codes", type=PATH, metavar="FILE", help="Codes and layers: TOML, or CSV with code, class, sigma.")
@click.option("--columns", help="Columns of text files, such as x=East,y=North,z=Height,code=Art or x,y,z,-,code.")
@click.option("--delimiter", help="Comma, semicolon, tab or space [what fits].")
@click.option("--decimal-comma", is_flag=True, help="Numbers are written 1,5.")
@click.option("--attribute", help="Attribute of vector files that holds the code [kind, class or code].")
@click.option("--layer", "layers", multiple=True, help="Layer or surface to read; may be repeated [all].")
@click.option("--las-class", "las_classes", type=int, multiple=True, help="Class of LAS points; may be repeated [2].")
@click.option("--tin-points", is_flag=True, help="Vertices of a LandXML triangulation as points, if it has no others.")
@click.option("--nodata", type=float, help="Height that means none.")
@click.option("--crs", help="CRS of files that state none.")
@click.option(
    "--height-field",
    metavar="NAME",
    help="Attribute of vector files that holds heights, as of contours; of drawings that of blocks, or Text.",
)
@click.option("--unit", help="Unit of drawings whose header states none or a wrong one [as $INSUNITS states].")
@click.option("--height-system", help="Height system of files that state none: ellipsoidal or EPSG:nnnn.")
@beyond_area_option
@click.option("--report/--no-report", default=None, help="A page with plots beside the model [if matplotlib is there].")
@ending("Read, clean and plan; print it and stop.", workers=True)
def command(dry_run: bool, as_json: bool, quiet: bool, **options: Any) -> None:
    """Predict a terrain model from POINTS: files of points and lines (text, LAS, LandXML, GeoPackage, Shapefile, DXF).

    Least-squares collocation filters the points; slopes break at breaklines. The same command continues a run that was
    interrupted while it wrote.
    """
    from photoplan.cli.telling import Telling
    from photoplan.io.store import together
    from photoplan.products.dtm.build import describe_plan, dtm_build, load, plan_facts
    from photoplan.report.dtm import build_page, open_build_report, samples_of
    from photoplan.terrain.build import plan_build

    wanted = options.pop("report")
    request = _request(options)
    if dry_run:
        measured, findings, crs, system = load(request)
        plan = plan_build(measured, request.settings)
        if as_json:
            show_json(plan_facts(plan, measured, findings, crs, system))
            return
        show(describe_plan(plan, measured, crs, system))
        for finding in findings:
            show(f"  {finding.kind}: {finding.text}")
        for note in _noted(measured.notes):
            show(f"  {note}")
        return
    page = open_build_report(request.output, wanted, request.overwrite)
    with together():
        with Telling(quiet) as events:
            can_draw(page is None and wanted is None, events.talk, "report")
            built = dtm_build(request, events)
        report, warning = None, ""
        if page is not None:
            samples = samples_of(built.built, built.measured)
            report, warning = page.write(build_page(built, request.inputs, samples)), samples.covariance.warning
    if as_json:
        show_json(built, report=report)
        return
    show(built.path)
    if report is not None:
        show(report)
    for line in _summary(built):
        events.talk(line)
    for line in _noted([*built.measured.notes, *([f"warning: {warning}"] if warning else [])]):
        say(f"  {line}")


def _request(options: dict[str, Any]) -> BuildRequest:
    from photoplan.io.tables import Dialect
    from photoplan.io.terrain.options import CodeTable, ReadOptions, read_code_table
    from photoplan.products.dtm.build import BuildRequest
    from photoplan.terrain.settings import BuildSettings

    codes = options.pop("codes")
    delimiter = options.pop("delimiter")
    reading = ReadOptions(
        dialect=Dialect(
            options.pop("columns"),
            {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}.get(delimiter, delimiter),
            options.pop("decimal_comma"),
        ),
        codes=read_code_table(codes) if codes else CodeTable(),
        attribute=options.pop("attribute"),
        layers=options.pop("layers") or None,
        las_classes=options.pop("las_classes") or None,
        tin_points=options.pop("tin_points"),
        nodata=options.pop("nodata"),
        crs=options.pop("crs"),
        beyond_area=options.pop("beyond_area"),
        height_field=options.pop("height_field"),
        unit=options.pop("unit"),
    )
    settings = BuildSettings(
        grid_width=options.pop("grid_width"),
        unit_meshes=options.pop("unit_meshes"),
        adapt=options.pop("adapt"),
        family=options.pop("covariance"),
        filters=dict(_filter(text) for text in options.pop("filters")),
        gross=options.pop("gross"),
        reach=options.pop("reach"),
    )
    workers = options.pop("workers")
    return BuildRequest(inputs=options.pop("points"), options=reading, settings=settings, workers=workers, **options)


def _filter(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise click.BadParameter(f"{text!r}; write for example --filter mass=0.15") from None


def _summary(built: BuildReport) -> list[str]:
    f = built.figures
    lines = [
        f"{f['points']} points in {f['seconds']:.1f} s · {f['units']} units, grid "
        + ", ".join(f"{width} m ({count})" for width, count in f["grid_widths"].items()),
        f"covariance {f['covariance']}: signal ±{f['variance'] ** 0.5:.3f} m, half at {f['length']:.2f} m · "
        f"mass points ±{f['noise']:.3f} m · "
        + ("posts: none amid data · " if f["sigma"] is None else f"posts ±{f['sigma']:.3f} m · ")
        + ("too few points for residuals" if f["spread"] is None else f"normalised residuals {f['spread']:.2f}"),
    ]
    if f["calibration"]:
        lines.append("held-out blocks, errors over stated ±: " + ", ".join(_class(c) for c in f["calibration"]))
        bends = [f"{_bend(c)} {c['after']:.2f}" for c in reversed(f["calibration_by_bend"]) if c["enough"]]
        if bends:
            lines.append("  the same by curvature of the ground: " + ", ".join(bends))
    if built.gross:
        lines.append(f"gross errors, left out: {len(built.gross)}")
        lines += [f"  {g.name}: {g.residual:+.3f} m, {abs(g.normalised):.1f} σ" for g in built.gross[:_SHOWN]]
    if built.suspects:
        lines.append(f"suspects, used all the same: {len(built.suspects)}; look at them in the report or the model")
    if built.findings:
        lines.append(f"note: findings in the measurements: {len(built.findings)}")
        lines += [f"  {finding.kind}: {finding.text}" for finding in built.findings[:_SHOWN]]
    return lines


def _noted(notes: Sequence[str]) -> list[str]:
    """Return notes once each, in words that `quiet` does not hide; of many the first ones."""
    found = [note if is_doubt(note) else f"note: {note}" for note in dict.fromkeys(notes)]
    more = len(found) - _SHOWN
    return found[:_SHOWN] + ([f"note: {more} more notes are in the model's record"] if more > 0 else [])


def _bend(c: dict[str, Any]) -> str:
    word = "strongest" if c["to"] == 1 else "weakest" if c["from"] == 0 else "next"
    return f"{word} {100 * (c['to'] - c['from']):.0f} %"


def _class(c: dict[str, Any]) -> str:
    """Spread of held-out errors at some distances to data."""
    where = f"over {c['from']:.3g} m" if c["to"] is None else f"up to {c['to']:.3g} m"
    return f"{where} {c['after']:.2f}" if c["enough"] else f"{where} too few ({c['blocks']} blocks)"

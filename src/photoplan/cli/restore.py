"""`photoplan restore`: images restored with a filter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photoplan.cli.options import NEW_FOLDER, PATH, ending, memory_option
from photoplan.cli.output import end_with_failures, show, show_json

if TYPE_CHECKING:
    from photoplan.products.restore import FilterRequest, RestoredImage, RestorePlan
    from photoplan.project.steps import SteppedReader

_OPTIONS = (
    click.option("--filter", "filter_file", type=PATH, metavar="FILE|none",
                 help="TOML, or one kernel as rows of numbers; none: no filter [measured at edges of the images]."),
    click.option("--aperture", metavar="SHAPE[:RATIO]",
                 help="Undo a scanner's aperture: square or round, RATIO of aperture by step [1]."),
    click.option("--method", type=click.Choice(["auto", "exact", "regularised"]), default="auto", show_default=True,
                 help="Of a measured filter; auto: the one of least expected error."),
    click.option("--rotation", type=click.Choice(["radial", "separable"]), default="radial", show_default=True,
                 help="How an exact inverse becomes two-dimensional."),
    click.option("--size", type=click.IntRange(3, 101), metavar="N", help="Side of a measured filter [11 or more]."),
    click.option("--cells", type=click.IntRange(1, 15), default=1, show_default=True, metavar="N",
                 help="Filters for N by N parts of the field, interpolated between them."),
    click.option("--per-band", is_flag=True, help="A measured filter for each band."),
    click.option("--least-length", type=click.FloatRange(8.0, 10_000.0), metavar="PX", help="Of an edge [20]."),
    click.option("--noise", type=click.FloatRange(0.0), metavar="SIGMA",
                 help="Standard deviation in light, full scale 1 [found in the images]."),
    click.option("--save-filter", type=PATH, metavar="FILE.toml",
                 help="Where a measured filter is kept [restoration_filter.toml by the results]."),
)  # fmt: skip
#: Options that a measurement alone can follow.
_MEASURED = ("method", "rotation", "size", "cells", "per_band", "least_length", "noise", "save_filter")


def filter_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options to a command."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def filter_request(images: tuple[Path, ...], options: dict[str, Any]) -> FilterRequest:
    """What the options ask for; takes them out of `options`, but for those that others need too."""
    from photoplan.products.restore import DesignRequest, FilterRequest
    from photoplan.quality.restoration.design import DesignOptions

    file, aperture = options.pop("filter_file"), options.pop("aperture")
    asked = {name: options.pop(name) for name in _MEASURED if name != "save_filter"}
    if file is not None or aperture is not None:
        _refuse_measuring("--filter" if file is not None else "--aperture")
        none = file == Path("none")
        return FilterRequest(None if none else file, aperture, none=none)
    size = asked["size"]
    if size is not None and size % 2 == 0:
        raise click.UsageError(f"--size {size}: a filter has an odd number of rows and columns")
    design = DesignOptions(asked["method"], asked["rotation"], None if size is None else size // 2)
    return FilterRequest(
        design=DesignRequest(
            images,
            _stated("linearisation", options),
            asked["per_band"],
            asked["cells"],
            least_length=asked["least_length"],
            noise=asked["noise"],
            options=design,
        )
    )


def _stated(name: str, options: dict[str, Any]) -> Any:
    """The value of an option that was given; None if it has its default."""
    given = click.get_current_context().get_parameter_source(name) is not click.core.ParameterSource.DEFAULT
    return options[name] if given else None


def _refuse_measuring(given: str) -> None:
    """Refuse options of a measurement where the filter is given."""
    context = click.get_current_context()
    for name in _MEASURED:
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--{name.replace('_', '-')} is for filters that are measured; leave out {given}")


@click.command("restore")
@click.argument("images", nargs=-1, required=True, type=PATH, metavar="IMAGE…")
@filter_options
@click.option("-o", "--output", type=NEW_FOLDER, metavar="FOLDER",
              help="Folder of the results [restored, beside the first image].")  # fmt: skip
@click.option("--band", "bands", multiple=True, type=click.IntRange(1), metavar="N",
              help="Restore this band; may be repeated [all]. Others stay as they are.")  # fmt: skip
@click.option("--fall-off", type=PATH, metavar="MODEL.toml",
              help="Before all else correct the light fall-off, by a model of 'photoplan characterise'.")  # fmt: skip
@click.option("--chromatic", metavar="FILE|measure",
              help="First bring the bands together: by a model, or as measured in each image.")  # fmt: skip
@click.option("--linearisation", default="linear", show_default=True, metavar="linear|srgb|TABLE",
              help="How grey values become light, which is what is filtered.")  # fmt: skip
@click.option("--dtype", default="same", show_default=True, metavar="same|float32|uint16", help="Type of the results.")
@click.option("--compress", default="deflate", show_default=True, help="deflate, zstd, lzw, jpeg or none.")
@memory_option
@click.option("--report", type=PATH, metavar="FILE.html", help="Report with plots.")
@click.option("--no-quicklook", is_flag=True, help="Write no pictures.")
@ending("Say what would be done, and stop.", workers=True)
def command(images: tuple[Path, ...], as_json: bool, quiet: bool, dry_run: bool, **options: Any) -> None:
    """Restore images of any size: NAME_restored.tif (a cloud-optimised GeoTIFF) and its run record.

    Without --filter the sharpness of the images is measured at edges that they show, all together as images of one
    camera, and the filter follows from it; it is kept as a file. Noise grows by the figure that is printed first. An
    image that fails does not stop the others (exit code 4). The same command continues a run that was interrupted.
    """
    from photoplan.cli.telling import Telling
    from photoplan.products.restore import (
        FILTER_NAME,
        RestoreRequest,
        keep_filter,
        plan_restoration,
        requested_filter,
        restore_images,
    )
    from photoplan.report.page import open_report
    from photoplan.report.restore import restore_page

    if options["chromatic"] not in (None, "measure"):
        options["chromatic"] = Path(options["chromatic"])
    options["quicklook"] = not options.pop("no_quicklook")
    asked = filter_request(images, options)
    kept = options.pop("save_filter")
    files = [path for path in (asked.file, options["chromatic"], options["fall_off"]) if isinstance(path, Path)]
    page = open_report(options.pop("report"), [*images, *files], overwrite=options["overwrite"])

    def finished(image: Any) -> None:
        if not as_json:
            show(image.path)
        for line in _after(image):
            events.talk(line)

    with Telling(quiet, finished) as events:
        found = requested_filter(asked, events)
        request = RestoreRequest(images, asked.file or found.filter, **options)
        plan = plan_restoration(request)
        for line in _before(plan):
            events.talk(line)
        if dry_run:
            _show(plan, as_json)
            end_with_failures(plan.failed, len(plan.jobs))
            return
        if asked.design is not None:
            path = keep_filter(kept or request.folder / FILTER_NAME, plan.filter, overwrite=request.overwrite)
            events.talk(f"filter: {path}")
        report = restore_images(request, events, more=page is not None)
    written = None
    if page is not None and report.images:
        written = page.write(restore_page(found, plan.jobs, report))
    if as_json:
        show_json(report, report=written)
    elif written is not None:
        show(written)
    end_with_failures(report.failed, len(report.images))


def _before(plan: RestorePlan) -> list[str]:
    """What a user should know before the filter is used."""
    from photoplan.products.restore import NO_FILTER, filter_figures

    figures = filter_figures(plan.filter)
    sums = ", ".join(f"{total:.4g}" for total in figures["sums"][:6])
    kernels = "1 kernel" if figures["kernels"] == 1 else f"{figures['kernels']} kernels"
    lines = (
        []
        if plan.filter.description == NO_FILTER
        else [
            f"filter {figures['size'][0]} × {figures['size'][1]}, {kernels}, sum {sums}: noise grows "
            f"{figures['noise_gain']:.3g} times"
        ]
    )
    for name in ("condition", "rule", "expected"):
        if name in figures["facts"]:
            lines.append(f"{name}: {figures['facts'][name]}")
    return lines + [line for job in plan.jobs for line in _corrections(job.reader)]


def _corrections(reader: SteppedReader) -> list[str]:
    """What is corrected in an image before the filter."""
    from photoplan.products.chromatic import model_lines
    from photoplan.project.align import AlignStep
    from photoplan.project.steps import FallOffStep, fall_off_line

    lit, aligned = reader.step(FallOffStep), reader.step(AlignStep)
    lines = [] if lit is None else [fall_off_line(lit.fall_off)]
    lines += [] if aligned is None else model_lines(aligned.model)
    return [f"{reader.info.path.name}: {line}" for line in lines]


def _show(plan: RestorePlan, as_json: bool) -> None:
    from photoplan.products.restore import filter_figures

    rows: list[dict[str, Any]] = [
        {
            "image": job.reader.info.path,
            "path": job.target,
            "size": job.reader.size,
            "bands": job.reader.bands,
            "dtype": str(job.reader.dtype),
            "tiles": job.tiles,
        }
        for job in plan.jobs
    ]
    if as_json:
        show_json({"filter": filter_figures(plan.filter), "images": rows, "failed": plan.failed})
        return
    for row in rows:
        show(
            f"{row['image']}: {row['size'][0]} × {row['size'][1]}, {_count(row['bands'], 'band')} of {row['dtype']}, "
            f"{_count(row['tiles'], 'tile')} → {row['path']}"
        )


def _count(number: int, what: str) -> str:
    return f"1 {what}" if number == 1 else f"{number} {what}s"


def _after(image: RestoredImage) -> list[str]:
    """What became of an image; clipping with advice."""
    lines = [f"{image.image}: {image.pixels / 1e6:.1f} Mpx in {image.seconds:.1f} s"]
    below, above = sum(image.below), sum(image.above)
    if below or above:
        way_out = "--dtype float32 keeps all values"
        if image.dtype == "uint8" and above:
            way_out += ", --dtype uint16 those above 255"
        lines.append(
            f"warning: {image.image}: {below} values fell below and {above} above what the type holds "
            f"({image.clipped_share:.2%}) and were clipped; {way_out}"
        )
    if image.picture is not None:
        lines.append(f"quick look: {image.picture}")
    return lines

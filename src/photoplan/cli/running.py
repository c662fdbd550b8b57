"""What `ortho`, `mosaic`, `object`, `run` and `demo` do with a plan: execute it and report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import How
from photoplan.cli.output import can_draw, show, show_json
from photoplan.cli.telling import Telling
from photoplan.errors import TilesFailed
from photoplan.events import COMPILATIONS
from photoplan.io.project.model import Project
from photoplan.products.orthophoto.execution import ProductResult, execute, seams_path
from photoplan.products.orthophoto.finished import overview_path
from photoplan.products.orthophoto.plan import OrthoPlan
from photoplan.project.scene import Attempts, refuse_unusable


def telling(how: How) -> Telling:
    """Events of a run: paths of products go to stdout as soon as they are complete."""

    printed = set()

    def product(value: object) -> None:
        if isinstance(value, ProductResult) and not value.failed and not how.as_json:
            for path in (value.path, *value.others):
                if path not in printed:
                    show(path)
                printed.add(path)

    return Telling(how.quiet, product)


def make_products(
    project: Project, plan: Callable[..., OrthoPlan], options: dict[str, Any], how: How, events: Telling
) -> None:
    """Plan products with the options of `product_options` and make them, or show what would be made.

    Images whose files cannot be used are left out; they are raised at the end.
    """
    folder = options.pop("output") or project.folder / "products"
    plan_file, dry_run, images = (options.pop(name) for name in ("plan_file", "dry_run", "images"))
    squares = options.pop("show_quadtree")
    if squares and not dry_run and plan_file is None:
        raise click.UsageError("--show-quadtree shows a plan: give --plan FILE or --dry-run, too")
    changes = {k: v for k, v in options.items() if v is not None and v != ()}
    attempts, begun = Attempts(project, images or None), False
    for attempt in attempts:
        with attempt as usable:
            made = plan(usable, images or None, events=events, **changes)
            if dry_run or plan_file is not None:
                # Here, since plans as files need a library for vector data that a product does not: 30 MB of memory.
                from photoplan.cli.show_plan import show_plan

                show_plan(made, folder, plan_file, how, events, squares)
            else:
                with reporting(made, folder, how, events) as then:
                    again, begun = begun, True
                    execute(made, folder, how.run(events, again), then)
    refuse_unusable(attempts.left_out, len(project.select(images or None)))


def execute_and_report(plan: OrthoPlan, folder: Path, how: How, events: Telling) -> None:
    """Make the products and print their paths, or one JSON object."""
    with reporting(plan, folder, how, events) as then:
        execute(plan, folder, how.run(events), then)


@contextmanager
def reporting(
    plan: OrthoPlan, folder: Path, how: How, events: Telling
) -> Iterator[Callable[[list[ProductResult]], None]]:
    """Print the plan, and the products when they are made; yields what draws them before they get their names."""
    events.results.clear()
    started, kernels, compiled = time.perf_counter(), COMPILATIONS.kernels, COMPILATIONS.seconds
    settings = plan.settings
    tiles = sum(len(p.plan.tiles) for p in plan.products)
    events.talk(
        f"plan: {plan.what}, {tiles} tiles · {settings.resolution:g} m · kernel {settings.kernel} · "
        f"{settings.exactness} · nodata {settings.nodata} · "
        f"hidden {settings.hidden}{settings.filling} · {how.workers} {how.executor}"
    )
    for line in plan.blind:
        events.talk(f"  note: left out: {line}")
    failed = None

    def then(results: list[ProductResult]) -> None:
        if settings.accuracy:
            _tell_accuracy(results, how.quicklook, events)
        if settings.sources:
            _draw_sources(results, events)

    try:
        yield then
    except TilesFailed as error:
        failed = error
    seconds = time.perf_counter() - started
    results = [value for value in events.results if isinstance(value, ProductResult)]
    if how.as_json:
        show_json({"products": results, "seconds": seconds, "folder": folder})
    if failed is not None:
        raise failed
    kernels, compiled = COMPILATIONS.kernels - kernels, COMPILATIONS.seconds - compiled
    events.talk(_summary(results, plan, seconds, kernels, compiled))
    if how.quicklook:
        events.talk(f"quick look: {overview_path(plan, folder)}")


def _tell_accuracy(results: list[ProductResult], draw: bool, events: Telling) -> None:
    """Figures of each product's accuracy, and a picture where pictures can be made."""
    from photoplan.report.maps import draw_accuracy

    known = [(result.path, result.accuracy) for result in results if result.accuracy is not None]
    draw = bool(known) and can_draw(draw, events.talk)
    for path, found in known:
        raster = path.with_name(f"{path.stem}_accuracy.tif")
        picture = f", drawn in {draw_accuracy(raster)}" if draw else ""
        figures = f"median {found['median']:.3g} m, 95 % of the pixels below {found['p95']:.3g} m"
        events.talk(f"standard deviation of position: {figures}: {raster}{picture}")


def _draw_sources(results: list[ProductResult], events: Telling) -> None:
    """A picture of each mosaic's regions, where pictures can be made."""
    from photoplan.io.vector_layer import read_features
    from photoplan.report.maps import draw_regions

    draw = bool(results) and can_draw(True, events.talk)
    for result in results:
        regions = seams_path(result.path)
        painted = len(result.painted or {})
        shapes = {item.name: item.geometry for item in read_features(regions, "Polygon").items}
        title = f"{result.path.name}: what each of {painted} images paints, of {len(result.images)} that see the ground"
        picture = f", drawn in {draw_regions(regions.with_suffix('.png'), shapes, title)}" if draw else ""
        events.talk(f"regions: {regions}{picture}")


def _summary(results: list[ProductResult], plan: OrthoPlan, seconds: float, kernels: int, compiled: float) -> str:
    pixels = sum(p.grid.width * p.grid.height for p in plan.products) / 1e6
    worst = max(r.residual for r in results)
    cells = sum(r.cells for r in results)
    compilation = f" ({compiled:.1f} s of them to compile {kernels} kernel{'s' * (kernels > 1)})" if kernels else ""
    return (
        f"{plan.what} in {seconds:.1f} s{compilation} · {pixels:.1f} Mpx, {pixels / (seconds - compiled):.3g} Mpx/s · "
        f"{cells} cells, worst anchor residual {worst:.3g} px{_hidden(results)}"
    )


def _hidden(results: list[ProductResult]) -> str:
    """Ground that images cannot see, if somebody has asked."""
    areas = [r.hidden for r in results if r.hidden is not None]
    outside = [r.bare for r in results if r.bare is not None]
    hidden = f" · hidden {_area(areas)} m²" if areas else ""
    filled = [r.filled for r in results if r.filled is not None]
    if filled:
        images, around = (_area([each[name] for each in filled]) for name in ("images", "surroundings"))
        hidden += f", of it filled {images} m² from images and {around} m² from surroundings"
    gaps = [r.gaps for r in results if r.gaps is not None]
    hidden += f" · gaps {_area(gaps)} m²" if gaps else ""
    return f"{hidden} · in no image {_area(outside)} m²" if outside else hidden


def _area(parts: list[float]) -> str:
    """Their sum, with all digits before the point."""
    whole = sum(parts)
    return f"{whole:,.0f}" if whole >= 1000 else f"{whole:.4g}"

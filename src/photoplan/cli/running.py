"""What `ortho`, `run` and `demo` do with a plan: execute it and report."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from photoplan.cli.output import show_json
from photoplan.cli.telling import Telling
from photoplan.engine.executors import available_cpus
from photoplan.errors import TilesFailed
from photoplan.products.orthophoto.execution import ProductResult, Run, execute
from photoplan.products.orthophoto.plan import OrthoPlan


@dataclass(frozen=True)
class How:
    """The options of `executing`, as values."""

    workers: int
    executor: str
    memory: int | None
    overwrite: bool
    quicklook: bool
    as_json: bool
    quiet: bool

    @classmethod
    def from_options(cls, options: dict[str, Any]) -> How:
        """Take the options of `executing` out of the options of a verb."""
        return cls(
            workers=options.pop("workers") or available_cpus(),
            executor=options.pop("executor"),
            memory=options.pop("memory"),
            overwrite=options.pop("overwrite"),
            quicklook=not options.pop("no_quicklook"),
            as_json=options.pop("as_json"),
            quiet=options.pop("quiet"),
        )


def telling(how: How) -> Telling:
    """Events of a run: paths of products go to stdout as soon as they are complete."""

    def product(value: object) -> None:
        if isinstance(value, ProductResult) and not value.failed and not how.as_json:
            click.echo(str(value.path))

    return Telling(how.quiet, product)


def execute_and_report(plan: OrthoPlan, folder: Path, how: How, events: Telling) -> None:
    """Make the products and print their paths, or one JSON object."""
    started = time.perf_counter()
    settings = plan.settings
    tiles = sum(len(p.plan.tiles) for p in plan.products)
    events.talk(
        f"plan: {len(plan.products)} products, {tiles} tiles · {settings.resolution:g} m · kernel {settings.kernel} · "
        f"tolerance {settings.tolerance:g} px · nodata {settings.nodata} · "
        f"hidden {settings.hidden} · {how.workers} {how.executor}"
    )
    for line in plan.blind:
        events.talk(f"  sees no terrain and is left out: {line}")
    run = Run(how.workers, how.executor, how.memory, how.overwrite, how.quicklook, events)
    failed = None
    try:
        execute(plan, folder, run)
    except TilesFailed as error:
        failed = error
    seconds = time.perf_counter() - started
    results = [value for value in events.results if isinstance(value, ProductResult)]
    if how.as_json:
        show_json({"products": results, "seconds": seconds, "folder": folder})
    if failed is not None:
        raise failed
    events.talk(_summary(results, plan, seconds))
    if how.quicklook:
        events.talk(f"quick look: {folder / 'overview.png'}")


def _summary(results: list[ProductResult], plan: OrthoPlan, seconds: float) -> str:
    pixels = sum(p.grid.width * p.grid.height for p in plan.products) / 1e6
    worst = max(r.residual for r in results)
    cells = sum(r.cells for r in results)
    return (
        f"{len(results)} orthophotos in {seconds:.1f} s · {pixels:.1f} Mpx, {pixels / seconds:.3g} Mpx/s · "
        f"{cells} cells, worst anchor residual {worst:.3g} px{_hidden(results)}"
    )


def _hidden(results: list[ProductResult]) -> str:
    """Ground that images cannot see, if somebody has asked."""
    areas = [r.hidden for r in results if r.hidden is not None]
    return f" · hidden {sum(areas):.4g} m²" if areas else ""

"""Execute a plan: tiles to workers, pixels to files, a record beside each product."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from photoplan import __version__
from photoplan.engine.execute import MOST_SOURCE_BYTES, Pixels
from photoplan.engine.executors import executor_factory, run_tiles
from photoplan.errors import TilesFailed, UsageError
from photoplan.io.product import ProductFile
from photoplan.io.quicklook import write_overview
from photoplan.io.run_record import peak_memory_bytes, record_path, versions, write_run_record
from photoplan.kernels.rectify import is_compiled
from photoplan.plan.anchors import Anchors
from photoplan.plan.product import ProductPlan, Tile, compile_tile
from photoplan.products.orthophoto import OrthoPlan, OrthoProduct, render_tile
from photoplan.products.scene import Scene, SceneAddress, open_scene
from photoplan.products.settings import OrthoSettings

__all__ = ["ProductResult", "Run", "execute"]

#: Memory of the interpreter with all libraries, GDAL's cache and the assembly of a product, bytes.
BASE_MEMORY = 320 * 2**20


@dataclass(frozen=True)
class Run:
    """How a plan is executed; none of it changes a pixel."""

    workers: int = 1
    """Threads or processes."""
    executor: str = "threads"
    """``threads``, ``processes`` or a Dask scheduler's address."""
    memory: int | None = None
    """Bytes the run should stay under; None: no bound but the tiles in flight."""
    overwrite: bool = False
    """Whether finished products may be replaced."""
    quicklook: bool = True
    """Whether to write `overview.png`."""
    progress: Callable[[int, int], None] = lambda tiles, pixels: None
    """Called with the number of tiles just finished and of their pixels."""
    talk: Callable[[str], None] = lambda text: None
    """Called with a sentence that a user may want to read while it goes on."""

    @property
    def in_flight(self) -> int:
        """Tiles that may be under way at once.

        Raises
        ------
        UsageError
            `memory` does not suffice for one tile.
        """
        wanted = self.workers if self.workers == 1 else 2 * self.workers
        if self.memory is None:
            return wanted
        # A tile holds its source window as read and as packed for the kernel, relief, anchors and result.
        per_tile = 3 * MOST_SOURCE_BYTES
        fits = (self.memory - BASE_MEMORY) // per_tile
        if fits < 1:
            least = (BASE_MEMORY + per_tile) / 2**20
            raise UsageError(
                f"--memory {self.memory / 2**20:.0f} MiB; at least {least:.0f} MiB are needed for one tile"
            )
        return int(min(wanted, fits))


@dataclass(frozen=True)
class ProductResult:
    """What became of one product."""

    path: Path
    image: str
    seconds: float
    valid_share: float
    """Valid pixels among all pixels of the product, 0 to 1."""
    residual: float
    """Worst residual of the anchors over all tiles, pixels of the source image."""
    cells: int
    """Boxes that the anchors of all tiles have."""
    tiles: int
    """Tiles that the product has, the empty ones included."""
    resumed: int
    """Tiles taken over from an earlier run."""
    failed: tuple[int, ...]
    """Tiles that could not be computed; the product is then not written."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        return {
            "path": str(self.path),
            "image": self.image,
            "seconds": round(self.seconds, 3),
            "valid_share": round(self.valid_share, 6),
            "worst_anchor_residual_px": self.residual,
            "cells": self.cells,
            "tiles": self.tiles,
            "resumed_tiles": self.resumed,
            "failed_tiles": list(self.failed),
        }


@dataclass(frozen=True)
class _Job:
    """What a worker is told once: small, and pickles."""

    scene: SceneAddress
    product: ProductPlan
    kernel: str


def _work(job: _Job, tile: Tile) -> Pixels:
    return render_tile(job.product, job.kernel, job.scene.open(), tile)


def execute(plan: OrthoPlan, output: Path | str, run: Run | None = None) -> list[ProductResult]:
    """Make all products of a plan.

    Parameters
    ----------
    plan : OrthoPlan
    output : path
        Folder for `NAME_ortho.tif`, its run record, and the overview picture; made if it does not exist.
    run : Run, optional
        Workers, memory, overwriting, progress.

    Returns
    -------
    list of ProductResult
        In the plan's order.

    Raises
    ------
    UsageError
        A product exists and `run.overwrite` is False, or a product would replace an input; nothing is done then.
    RunLocked
        Another run is writing the same product.
    InputError
        An input is missing, damaged, or has changed since it was planned.
    TilesFailed
        Some tiles failed again and again; their products are not written, all others are.
    ResourceError
        Disk or memory ran out.
    """
    run = run or Run()
    folder = Path(output)
    in_flight = run.in_flight
    kept = _finished(plan, folder, run)
    _make_folder(folder)
    if kept:
        run.talk(f"{len(kept)} of {len(plan.products)} products are finished already")
    results = [kept.get(p.plan.name) or _make(plan, p, folder, run, in_flight) for p in plan.products]
    if run.quicklook:
        write_overview([r.path for r in results if not r.failed], folder / "overview.png")
    failed = [f"{r.path.name}: tiles {', '.join(map(str, r.failed))}" for r in results if r.failed]
    if failed:
        raise TilesFailed("finished, but these products lack tiles and were not written:\n  " + "\n  ".join(failed))
    return results


def _finished(plan: OrthoPlan, folder: Path, run: Run) -> dict[str, ProductResult]:
    """Products that exist: those of this very run, interrupted, are kept; any other is refused before any work.

    When all products of a plan exist, the run was not interrupted: doing it again needs `overwrite`.
    """
    existing = [p for p in plan.products if _path(folder, p).exists()]
    if run.overwrite or not existing:
        return {}
    kept = {p.plan.name: _kept(plan, p, folder) for p in existing}
    foreign = [name for name, result in kept.items() if result is None]
    if foreign or len(existing) == len(plan.products):
        first = _path(folder, plan[foreign[0]] if foreign else existing[0])
        more = f" and {len(existing) - 1} more" if len(existing) > 1 else ""
        raise UsageError(f"{first}{more} exists; give --overwrite to replace it, or another --output")
    return {name: result for name, result in kept.items() if result is not None}


def _kept(plan: OrthoPlan, product: OrthoProduct, folder: Path) -> ProductResult | None:
    """The result of an earlier run with the same key and settings; None if the product is not one."""
    path = _path(folder, product)
    try:
        record = json.loads(record_path(path).read_text(encoding="utf-8"))
        if record["key"] != product.key or OrthoSettings.from_dict(record["settings"]) != plan.settings:
            return None
        made = record["product"]
        return ProductResult(
            path,
            product.plan.image,
            made["seconds"],
            made["valid_share"],
            made["worst_anchor_residual_px"],
            made["cells"],
            made["tiles"],
            made["tiles"],
            (),
        )
    except (OSError, ValueError, KeyError, TypeError, UsageError):
        return None


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: no such folder, and it cannot be made ({error.strerror})") from None


def _path(folder: Path, product: OrthoProduct) -> Path:
    return folder / f"{product.plan.name}.tif"


def _make(plan: OrthoPlan, product: OrthoProduct, folder: Path, run: Run, in_flight: int) -> ProductResult:
    started = time.perf_counter()
    settings, scene = plan.settings, open_scene(plan.project, product.plan.image)
    if not is_compiled(scene.reader.dtype, scene.reader.bands, settings.kernel):
        run.talk("compiling the resampling kernels for this kind of image, once (up to a minute)")
    job = _Job(scene.address, replace(product.plan, tiles=()), settings.kernel)
    tally = _Tally()
    with ProductFile(
        _path(folder, product),
        product.grid,
        scene.reader.bands,
        scene.reader.dtype,
        run_key=product.key,
        nodata=settings.nodata_value,
        compress=settings.compress,
        overviews=settings.overviews,
        tile=settings.tile,
        overwrite=run.overwrite,
        inputs=scene.files,
        threads=run.workers,
    ) as file:
        finished = file.finished
        todo = [tile for tile in product.plan.tiles if tile.index not in finished]
        for tile in product.plan.tiles:
            if tile.index in finished:
                tally.again(compile_tile(product.plan, tile.window, scene.camera, scene.surface).anchors)
        if tally.resumed:
            run.talk(f"{product.plan.name}: {tally.resumed} of {len(product.plan.tiles)} tiles are finished already")
            run.progress(tally.resumed, 0)
        for outcome in run_tiles(todo, partial(_work, job), executor_factory(run.executor, run.workers), in_flight):
            done: Tile = outcome.task
            if outcome.error is not None:
                tally.failed.append(done.index)
                tally.reasons.append(f"tile {done.index}: {outcome.error}")
            else:
                pixels: Pixels = outcome.result
                if pixels.values is None:
                    file.append_empty(done.index)
                else:
                    file.append(done.index, pixels.values, pixels.valid)
                tally.add(pixels)
            run.progress(1, done.window.size)
        facts = None
        if not tally.failed:
            # Tiles that the plan leaves out hold nothing of the image.
            planned = {tile.index for tile in product.plan.tiles}
            for index in set(range(product.plan.tile_count)) - planned - finished:
                file.append_empty(index)
            facts = file.complete(_tags(plan, product))
    result = ProductResult(
        _path(folder, product),
        product.plan.image,
        time.perf_counter() - started,
        0.0 if facts is None else facts.valid_share,
        tally.residual,
        tally.cells,
        product.plan.tile_count,
        tally.resumed,
        tuple(sorted(tally.failed)),
    )
    if facts is not None:
        record = _record(plan, product, scene, run, result)
        write_run_record(
            record_path(result.path), {**record, "values_moved_off_nodata": facts.moved_values, "bytes": facts.bytes}
        )
    return result


@dataclass
class _Tally:
    residual: float = 0.0
    cells: int = 0
    resumed: int = 0
    failed: list[int] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)

    def add(self, pixels: Pixels) -> None:
        self.residual = max(self.residual, pixels.residual)
        self.cells += pixels.cells

    def again(self, anchors: Anchors | None) -> None:
        """Count a tile that an earlier run has finished."""
        self.resumed += 1
        if anchors is not None:
            self.residual = max(self.residual, anchors.residual)
            self.cells += len(anchors.corners)


def _tags(plan: OrthoPlan, product: OrthoProduct) -> dict[str, str]:
    """What the file itself says of its origin."""
    return {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_IMAGE": product.plan.image,
        "PHOTOPLAN_KERNEL": plan.settings.kernel,
        "PHOTOPLAN_KEY": product.key,
    }


def _record(plan: OrthoPlan, product: OrthoProduct, scene: Scene, run: Run, result: ProductResult) -> dict[str, Any]:
    """The run record: what a person needs to answer for the product, and to make it again."""
    center = scene.camera.center
    return {
        "product": result.to_dict(),
        "key": product.key,
        "inputs": [
            {"path": path, "sampled_sha256": digest, "size": Path(path).stat().st_size}
            for path, digest in scene.address.digests
        ],
        "project": json.loads(scene.address.text),
        "settings": plan.settings.to_dict(),
        "grid": {
            "crs": product.grid.crs,
            "bounds": product.grid.bounds,
            "resolution": product.grid.resolution,
            "width": product.grid.width,
            "height": product.grid.height,
        },
        "heights": {
            "terrain": scene.ground.height_systems[0],
            "orientation": scene.ground.height_systems[1],
            "working": scene.ground.working_system,
        },
        "crs_operations": [
            {"operation": step.operation, "accuracy_m": step.accuracy} for step in scene.ground.operations
        ],
        "projection_centre": [float(c) for c in center],
        "gsd_m": product.gsd,
        "first_cell_px": product.plan.rule.cell,
        "run": {"workers": run.workers, "executor": run.executor, "memory": run.memory},
        "versions": versions(),
        "peak_memory_bytes": peak_memory_bytes(),
    }

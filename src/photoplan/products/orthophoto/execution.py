"""Results of the products of a plan, and products of an earlier run that are kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photoplan import __version__
from photoplan.cameras.base import tremor_told
from photoplan.engine.execute import OutputName, RenderJob
from photoplan.engine.executors import Workers
from photoplan.engine.run import Kept, Tally, Work
from photoplan.errors import InputError, PhotoplanError, TilesFailed
from photoplan.events import Events
from photoplan.io.disk import TARGET, make_folder
from photoplan.io.files import safe_stem
from photoplan.io.product import (
    ProductFacts,
    ProductFile,
    is_product,
    refuse_foreign_overview,
    refuse_foreign_virtual,
    write_overview,
    write_stacked,
)
from photoplan.io.project.model import Project
from photoplan.io.raster_info import ImageForm, bands_of
from photoplan.io.store import (
    KeptTiles,
    RunMarker,
    input_entry,
    record_path,
    scratch,
    standing,
    together,
    when_named,
    write_run_record,
)
from photoplan.kernels.rectify import is_compiled
from photoplan.plan.accuracy import BANDS, radial_error
from photoplan.plan.footprint import Tiles
from photoplan.products.orthophoto.finished import (
    ProductResult,
    all_files,
    finished_products,
    outputs,
    overview_path,
    seams_path,
    stale_files,
)
from photoplan.products.orthophoto.plan import Look, OrthoPlan, OrthoProduct, known_errors, painting, tile_keys
from photoplan.products.plausibility import one_colour, one_colour_told
from photoplan.products.run import Run, refuse_inputs, tile_bytes
from photoplan.project.scene import Scene, Scenes, ScenesAddress, input_files, open_scene
from photoplan.project.steps import RestoreStep

#: Names and units of the bands of an accuracy raster.
_BANDS = ImageForm(descriptions=tuple(name for name, _ in BANDS), units=tuple(unit for _, unit in BANDS))


def execute(plan: OrthoPlan, output: Path | str, run: Run | None = None) -> list[ProductResult]:
    """Make all products of a plan.

    Parameters
    ----------
    plan : OrthoPlan
    output : path
        Folder for `NAME_ortho.tif`, its run record, and the preview of all products; made if it does not exist.
    run : Run, optional
        Workers, memory, overwriting, progress.

    Returns
    -------
    list of ProductResult
        In the plan's order.

    Raises
    ------
    UsageError
        A product exists and `run.overwrite` is False, or would replace any of the project's inputs; nothing is done
        then.
    RunLocked
        Another run is writing the same product.
    InputError
        An input is missing, damaged, or has changed since it was planned.
    TilesFailed
        Some tiles failed again and again; their products are not written, all others are.
    ResourceError
        Disk or memory ran out.
    """
    results = execute_all(plan, Path(output), run or Run())
    refuse_failed(results)
    return results


def refuse_failed(results: Sequence[ProductResult]) -> None:
    """Raise TilesFailed with the products that lack tiles, if there are any."""
    failed = [f"{r.path.name}: tiles {', '.join(map(str, r.failed))} ({r.reason})" for r in results if r.failed]
    if failed:
        raise TilesFailed(
            "finished, but these products lack tiles and were not written; the same command tries the tiles again:\n  "
            + "\n  ".join(failed)
        )


def execute_all(plan: OrthoPlan, folder: Path, run: Run) -> list[ProductResult]:
    """Make all products of a plan; those whose tiles failed are among the results. For errors see `execute`."""
    each = tile_bytes(plan.settings.tolerance, plan.settings.tile)
    run.check(each)
    picture = overview_path(plan, folder) if run.quicklook else None
    rasters = [path for p in plan.products for path in all_files(folder, p, plan.settings)]
    refuse_inputs(input_files(plan.project), [*rasters, *([] if picture is None else [picture])])
    in_sheets = plan.settings.choice is not None and plan.settings.choice.sheets is not None
    if in_sheets:
        # Shapely and vector files: a quarter of the start, and only here.
        from photoplan.products.orthophoto.sheets import sheet_index, write_index  # noqa: PLC0415
    index = sheet_index(plan, folder) if in_sheets else _stack_index(plan, folder)
    refuse_inputs(input_files(plan.project), index[:1])
    for path in index:
        refuse_foreign_virtual(path)
    marker = RunMarker(folder, " ".join(product.key for product in plan.products))
    goes_on = marker.interrupted or run.again
    done = [each for each in (picture, *index) if each is not None]
    kept = finished_products(plan, folder, run.overwrite, None if goes_on else done)
    if picture is not None and not run.overwrite:
        refuse_foreign_overview(picture, plan.command)
    make_folder(folder)
    marker.begin()
    if kept:
        run.events.talk(f"{len(kept)} of {len(plan.products)} products are finished already")
    if plan.settings.choice is not None:
        _tell_of_one_colour([p for p in plan.products if p.plan.name not in kept], plan.project, run.events)
    run.events.begin("tiles", sum(len(p.plan.tiles) for p in plan.products))
    with run.runner(_pixel_files(plan), folder, each) as runner:
        works = (_work(plan, p, folder, run, kept.get(p.plan.name), runner.workers) for p in plan.products)
        try:
            results: list[ProductResult] = runner.run(works)
        except InputError:
            # This plan cannot be completed: no later run continues it.
            marker.end()
            raise
    if picture is not None:
        write_overview([r.path for r in results if not r.failed], picture, plan.command)
    for path in index:
        (write_index if in_sheets else _write_stack)(plan, path, [r for r in results if not r.failed])
    if not any(r.failed for r in results):
        marker.end()
    return results


def _tell_of_one_colour(products: Sequence[OrthoProduct], project: Project, events: Events) -> None:
    """Name the images of mosaics that would paint one grey value."""
    for name in dict.fromkeys(name for product in products for name in product.images):
        try:
            grey = one_colour(open_scene(project, name).reader)
        except PhotoplanError:
            continue  # Tiles ask again, and say what is wrong with the file.
        if grey is not None:
            events.talk(f"note: {one_colour_told(name, grey)}")


def _work(
    plan: OrthoPlan, product: OrthoProduct, folder: Path, run: Run, kept: ProductResult | None, workers: Workers
) -> Work[ProductResult] | Kept[ProductResult]:
    """Return the work of a product, or its result if it is finished."""
    if kept is not None:
        return Kept(kept, len(product.plan.tiles))
    settings, address = plan.settings, product.address(plan.project)
    scenes = address.open()
    scene = scenes[0]
    for note in dict.fromkeys(note for row in range(len(product.images)) for note in scenes[row].notes):
        run.events.talk(f"note: {note}")
    if not is_compiled(scene.reader.dtype, scene.reader.bands, settings.kernel):
        run.events.talk("compiling the resampling kernels for this kind of image, once (up to a minute)")
    paths = outputs(folder, product, settings)
    kept_tiles = None
    if settings.choice is not None:
        kept_tiles = KeptTiles(record_path(paths["picture"]), tile_keys(address, product.plan, settings))
    open_file = partial(
        ProductFile,
        placement=product.grid.placement,
        run_key=product.key,
        overviews=settings.overviews,
        tile=settings.tile,
        overwrite=run.overwrite,
        inputs=[path for path, _ in address.digests],
        threads=run.workers,
        tiles=kept_tiles,
    )
    forms: dict[OutputName, dict[str, Any]] = {
        "picture": {
            "bands": scene.reader.bands,
            "dtype": scene.reader.dtype,
            "nodata": settings.nodata_value,
            "compress": settings.compress,
            "form": bands_of(scene.reader.info),
        },
        "hidden": {"bands": 1, "dtype": np.dtype(np.uint8), "nodata": 255, "resampling": "mode"},
        "sources": {"bands": 1, "dtype": np.dtype(np.uint16), "nodata": 0, "resampling": "mode"},
        "accuracy": {"bands": len(BANDS), "dtype": np.dtype(np.float32), "resampling": "nearest", "form": _BANDS},
    }
    files = {name: open_file(path, **forms[name]) for name, path in paths.items()}
    told = replace(product.plan, tiles=product.plan.tiles.only(()))
    errors = known_errors(address, told, settings) if settings.accuracy else None
    job = RenderJob(
        address=address,
        product=told,
        kernel=settings.kernel,
        outputs=tuple(files),
        errors=errors,
        paint=painting(product, settings),
    )
    return Work(
        name=product.plan.name,
        job=job,
        tiles=product.plan.tiles,
        count=product.plan.tiles.total,
        sinks=tuple(files.values()),
        complete=partial(_complete, plan, product, address, files, run.clock(workers)),
        scratch=partial(scratch, folder),
    )


def _pixel_files(plan: OrthoPlan) -> list[Path]:
    """Files that workers open."""
    addresses = (p.address(plan.project) for p in plan.products)
    return [Path(path) for path in dict.fromkeys(path for a in addresses for path, _ in a.digests)]


def _complete(
    plan: OrthoPlan,
    product: OrthoProduct,
    address: ScenesAddress,
    files: Mapping[OutputName, ProductFile],
    times: Callable[[], dict[str, Any]],
    tally: Tally,
) -> ProductResult:
    """Give the files of a product their names, and its record; with failed tiles they get none."""
    file = files["picture"]
    with together():
        made = [] if tally.failed else [each.complete(_tags(plan, product)) for each in files.values()]
        facts = made[0] if made else None
        painted: dict[str, float] | None = None
        if "sources" in files and facts is not None:
            # A product without regions does not need the libraries of vector data.
            from photoplan.io.vector_layer import source_regions, write_regions  # noqa: PLC0415

            shapes = source_regions(standing(files["sources"].path), product.grid, len(product.images))
            painted = {product.images[row - 1]: float(shape.area) for row, shape in shapes.items()}
            write_regions(seams_path(file.path), product.images, shapes, product.grid.crs)
        ran = times()
        result = ProductResult(
            path=file.path,
            others=tuple(all_files(file.path.parent, product, plan.settings)[1:]),
            images=product.images,
            seconds=ran["seconds"],
            valid_share=0.0 if facts is None else facts.valid_share,
            residual=tally.totals.get("worst_residual", 0.0),
            cells=tally.totals.get("cells", 0),
            tiles=len(product.plan.tiles),
            resumed=tally.resumed,
            hidden=_area(tally, "hidden", product) if plan.settings.asks_hidden else None,
            filled={name: _area(tally, f"filled_from_{name}", product) for name in ("images", "surroundings")}
            if plan.settings.fill_hidden
            else None,
            bare=None if plan.settings.choice is None else _area(tally, "bare", product) + _left_out(product, address),
            gaps=_area(tally, "gaps", product) if plan.settings.method == "direct" else None,
            painted=painted,
            accuracy=_accuracy(tally.totals["radial_errors"]) if "radial_errors" in tally.totals else None,
            failed=tuple(sorted(tally.failed)),
            reason=next(iter(tally.reasons), ""),
        )
        if facts is not None:
            write_run_record(
                result.path,
                key=product.key,
                inputs=[input_entry(path, digest) for path, digest in address.digests],
                run=ran,
                values_moved_off_nodata=facts.moved_values,
                bytes=facts.bytes,
                **_record(plan, product, address.open(), result),
                **_kept(made),
            )
        if facts is not None:
            # Of the orthophoto that this one replaces.
            for path in filter(is_product, stale_files(file.path.parent, product, plan.settings)):
                when_named(path.unlink)
    return result


def _kept(made: Sequence[ProductFacts]) -> dict[str, Any]:
    """Return the tiles that a record keeps, by file; nothing if none are kept."""
    found = {each.path.name: each.kept for each in made if each.kept}
    return {"tiles": found} if found else {}


def _accuracy(counts: list[int]) -> dict[str, float]:
    return {"median": radial_error(counts, 0.5), "p95": radial_error(counts, 0.95)}


def _area(tally: Tally, name: str, product: OrthoProduct) -> float:
    """Pixels that tiles have counted, m²."""
    return float(tally.totals.get(name, 0) * product.grid.resolution**2)


def _left_out(product: OrthoProduct, address: ScenesAddress) -> float:
    """Area of tiles that no image can paint, m²; of a single object the area that it has in them."""
    tiles = product.plan.tiles
    pixels = product.grid.window.size - tiles.windows[:, 2:].prod(axis=1).sum()
    if product.part is not None and not product.part.below:
        every = Tiles.every(tiles.window, tiles.side)
        surface, others = address.open().surface, every.only(np.setdiff1d(np.arange(tiles.total), tiles.indices))
        pixels = sum(np.isfinite(surface.relief(product.plan.target, tile.window)).sum() for tile in others)
    return float(pixels * product.grid.resolution**2)


def _tags(plan: OrthoPlan, product: OrthoProduct) -> dict[str, str]:
    """Return the tags by which a file states its origin."""
    return {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_IMAGE": ", ".join(product.images),
        "PHOTOPLAN_KERNEL": plan.settings.kernel,
        "PHOTOPLAN_KEY": product.key,
        **({} if plan.project.target is None else {TARGET: plan.project.target.frame}),
    }


def _record(plan: OrthoPlan, product: OrthoProduct, scenes: Scenes, result: ProductResult) -> dict[str, Any]:
    """Return all that a person needs to answer for the product, and to make it again."""
    scene = scenes[0]
    return {
        "product": result,
        "project": plan.project.alone(product.images).model_dump(mode="json", exclude_none=True),
        "settings": plan.settings,
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
        "images": [
            _image_record(name, scenes[row], look)
            for row, (name, look) in enumerate(zip(product.images, product.looks))
        ],
    }


def _image_record(name: str, scene: Scene, look: Look) -> dict[str, Any]:
    """An image as it took part."""
    step, vantage = scene.reader.step(RestoreStep), scene.camera.vantage
    return {
        "name": name,
        "projection_centre": [float(c) for c in vantage.point] if vantage.central else None,
        "gsd_m": look.gsd,
        "blur": look.blur,
        "restored": None if step is None else step.describe(),
        "tremor": tremor_told(scene.camera, look.footprint.usual_height),
    }


def _stack_index(plan: OrthoPlan, folder: Path) -> list[Path]:
    """Return the file that shows orthophotos as bands (lines of one camera on the same ground); none unless wanted."""
    name = plan.settings.stack
    return [folder / f"{safe_stem(name)}.vrt"] if name else []


def _write_stack(plan: OrthoPlan, path: Path, results: Sequence[ProductResult]) -> None:
    """Write that file, of the orthophotos that are there."""
    images = {product.plan.name: product.images[0] for product in plan.products}
    if results:
        write_stacked(path, {images[result.path.stem]: result.path for result in results})

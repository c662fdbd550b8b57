"""Make a surface: tiles to workers, heights and grey values to files, a record beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photoplan import __version__
from photoplan.engine.run import Tally, Work
from photoplan.errors import InputError, UsageError
from photoplan.io.disk import make_folder
from photoplan.io.image_form import ImageForm
from photoplan.io.naming import scratch, together
from photoplan.io.point_cloud import write_cloud
from photoplan.io.product import ProductFile, check_output
from photoplan.io.run_record import input_entry, write_run_record
from photoplan.io.surface_file import TARGET
from photoplan.plain import pick
from photoplan.products.run import Run, refuse_inputs
from photoplan.products.surface.findings import contradicted, findings
from photoplan.products.surface.job import TILE, SurfaceJob
from photoplan.products.surface.plan import SurfacePlan
from photoplan.products.surface.spread import median
from photoplan.project.scene import input_files
from photoplan.project.target_frame import at_heights

#: What the files hold: name of the file behind that of the product, band, unit.
KINDS = {
    "heights": ("", "height", "metre"),
    "sigma": ("_sigma", "standard deviation of the height", "metre"),
    "count": ("_count", "images that see it", ""),
    "fit": ("_fit", "standardised residuals of the grey values around it, root mean square", ""),
    "grey": ("_grey", "grey value", ""),
    "grey_sigma": ("_grey_sigma", "standard deviation of the grey value", ""),
    "residuals": ("_residuals", "standardised residual", ""),
}
#: Those that have the pixels of the grey values.
_FINE = ("grey", "grey_sigma", "residuals")


@dataclass(frozen=True)
class SurfaceResult:
    """What became of a surface."""

    path: Path
    """The heights."""
    others: tuple[Path, ...]
    """Standard deviations, number of images, fit, grey values and theirs, residuals, points."""
    images: tuple[str, ...]
    seconds: float
    valid_share: float
    """Posts with a height among all, 0 to 1."""
    sigma0: dict[str, float | None]
    """Standard deviation of a grey value by image; None: the image sees nothing of the surface."""
    redundancy: float
    """Observations beyond those that determine grey values and heights."""
    sigma: float | None
    """Median standard deviation of the heights, metres."""
    sigma_px: float | None
    """The same in pixels of parallax between the outermost images."""
    misfit_share: float
    """Heights around which residuals are more than twice as large as expected, among all, 0 to 1."""
    corrections: tuple[float, ...]
    """Mean last correction of the heights on each level, the finest first, pixels of parallax."""
    notes: tuple[str, ...]
    """What speaks against it, and what helps."""
    tiles: int
    resumed: int
    """Tiles taken over from an earlier run."""

    def json_fields(self) -> dict[str, Any]:
        """All figures, with units."""
        more = {"sigma_m": "sigma", "corrections_px": "corrections", "resumed_tiles": "resumed"}
        own = (
            "path",
            "images",
            "seconds",
            "valid_share",
            "sigma0",
            "redundancy",
            "sigma_px",
            "misfit_share",
            "notes",
            "tiles",
        )
        return pick(self, *own, other_files="others", **more)


def outputs(folder: Path, plan: SurfacePlan) -> dict[str, Path]:
    """Files of a surface."""
    kinds = {kind: ending for kind, (ending, _, _) in KINDS.items() if kind != "residuals" or plan.settings.residuals}
    return {kind: folder / f"{plan.settings.name}{ending}.tif" for kind, ending in kinds.items()}


def make_surface(plan: SurfacePlan, output: Path | str, run: Run | None = None) -> SurfaceResult:
    """Make a surface; a run that was killed is continued by the same call.

    Parameters
    ----------
    plan : SurfacePlan
    output : path
        Folder of the files; made if it does not exist.
    run : Run, optional
        Workers, memory, overwriting, progress.

    Raises
    ------
    UsageError
        A file exists and `run.overwrite` is False, or would replace an input.
    InputError
        An input has changed since it was planned, or the images contradict the surface and it is not forced.
    TilesFailed
        Tiles failed again and again; nothing is written.
    ResourceError
        Disk or memory ran out.
    """
    run = run or Run()
    folder = Path(output)
    job = SurfaceJob(
        address=plan.address,
        grid=plan.grid,
        scheme=plan.scheme,
        start=plan.settings.start,
        residuals=plan.settings.residuals,
        begun=plan.begun,
        frame=plan.frame,
        bands=plan.settings.bands,
        finer=plan.finer,
        seen=plan.most,
    )
    run.check(job.bytes)
    paths = outputs(folder, plan)
    written = [*paths.values(), *plan.settings.points]
    inputs = [Path(path) for path, _ in plan.inputs]
    refuse_inputs([*input_files(plan.project), *inputs], written)
    if len({path.resolve() for path in written}) < len(written):
        raise UsageError(f"points {', '.join(map(str, plan.settings.points))}: one file twice; give each its own name")
    for path in written:
        check_output(path, [], overwrite=run.overwrite)
    for place in (folder, *(path.parent for path in plan.settings.points)):
        make_folder(place)
    tiles = plan.tiles
    run.events.begin("tiles", len(tiles))
    with run.runner(inputs, folder, job.bytes) as runner:
        files = _files(plan, paths, run)
        work = Work(
            name=plan.settings.name,
            job=job,
            tiles=tiles,
            count=len(tiles),
            sinks=tuple(files.values()),
            complete=partial(_complete, plan, files, run.clock(runner.workers)),
            scratch=partial(scratch, folder),
        )
        result: SurfaceResult
        (result,) = runner.run([work])
    return result


def _files(plan: SurfacePlan, paths: dict[str, Path], run: Run) -> dict[str, ProductFile]:
    """The files, in the order of a tile's layers."""
    made = {}
    for kind, path in paths.items():
        grid, side = (plan.grey_grid, TILE * plan.scheme.ratio) if kind in _FINE else (plan.grid, TILE)
        _, name, unit = KINDS[kind]
        names = tuple(f"{name} of {image}" for image in plan.images) if kind == "residuals" else (name,)
        made[kind] = ProductFile(
            path,
            grid.placement,
            len(names),
            np.dtype(np.uint8 if kind == "count" else np.float32),
            run_key=plan.key,
            tile=side,
            overwrite=run.overwrite,
            inputs=[file for file, _ in plan.inputs],
            threads=run.workers,
            resampling="mode" if kind == "count" else "average",
            form=ImageForm(descriptions=names, units=(unit,) if unit else ()),
        )
    return made


def _complete(
    plan: SurfacePlan, files: dict[str, ProductFile], times: Callable[[], dict[str, Any]], tally: Tally
) -> SurfaceResult:
    """Give the files their names, and write the record."""
    heights = files["heights"]
    tally.check(heights.path)
    contradiction = contradicted(plan, tally.totals)
    if contradiction and not plan.force:
        raise InputError(f"{heights.path}: {contradiction}. Nothing is written; `force` writes it all the same")
    tags = {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_IMAGE": ", ".join(plan.images),
        "PHOTOPLAN_KEY": plan.key,
        TARGET: plan.settings.target,
    }
    scene, crs = plan.address.scenes[0].open(), plan.project.crs
    frame = None if plan.frame is None else at_heights(plan.frame, scene.ground.out_of_working(crs))
    with together():
        facts, *_ = [file.complete(tags) for file in files.values()]
        for path in plan.settings.points:
            z, sigma, grey = (files[kind].path for kind in ("heights", "sigma", "grey"))
            write_cloud(path, z, sigma, grey, crs, frame)
        ran = times()
        result = _result(plan, files, ran["seconds"], facts.valid_share, tally)
        write_run_record(
            heights.path,
            key=plan.key,
            inputs=[input_entry(path, digest) for path, digest in plan.inputs],
            run=ran,
            kind="surface",
            product=result,
            settings=plan.settings,
            scheme=plan.scheme,
            grid=plan.grid,
            frame=plan.frame,
            heights={"orientation": scene.ground.height_systems[1], "working": scene.ground.working_system},
            project=plan.project.alone(plan.images).model_dump(mode="json", exclude_none=True),
        )
    return result


def _result(
    plan: SurfacePlan, files: dict[str, ProductFile], seconds: float, share: float, tally: Tally
) -> SurfaceResult:
    """Figures of all tiles."""
    totals, parts = tally.totals, max(tally.totals["parts"], 1)
    pairs = zip(totals["squares"], totals["redundancy"])
    spreads = [float(np.sqrt(square / free)) if free > 0 else None for square, free in pairs]
    sigma0 = dict(zip(plan.images, spreads))
    sigma = median(totals["sigmas"])
    sigma_px = None if sigma is None else sigma / plan.height_error
    misfits = totals["misfits"] / totals["heights"] if totals["heights"] else 0.0
    corrections = tuple(move / parts for move in totals["moves"])
    astray = totals["astray"] / max(totals["astray"] + totals["heights"], 1)
    seen, total, squares = totals["greys"]
    contrast = float(np.sqrt(max(squares / seen - (total / seen) ** 2, 0.0))) if seen else 0.0
    return SurfaceResult(
        path=files["heights"].path,
        others=(*(file.path for kind, file in files.items() if kind != "heights"), *plan.settings.points),
        images=plan.images,
        seconds=seconds,
        valid_share=share,
        sigma0=sigma0,
        redundancy=sum(totals["redundancy"]),
        sigma=sigma,
        sigma_px=sigma_px,
        misfit_share=misfits,
        corrections=corrections,
        notes=findings(plan, sigma0, contrast, sigma_px, misfits, corrections[0], astray),
        tiles=len(files["heights"].windows),
        resumed=tally.resumed,
    )

"""Runs and findings of surface reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photoplan import __version__
from photoplan.engine.run import Tally, Work
from photoplan.errors import InputError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.io.disk import TARGET, make_folder
from photoplan.io.points import write_cloud
from photoplan.io.product import ProductFile, check_output
from photoplan.io.project.file import load_project
from photoplan.io.raster_info import ImageForm
from photoplan.io.store import input_entry, scratch, together, write_run_record
from photoplan.plain import pick
from photoplan.products.run import Run, refuse_inputs
from photoplan.products.surface.plan import HARDLY, TILE, SurfaceJob, SurfacePlan, median, plan_surface
from photoplan.project.scene import Attempts, input_files
from photoplan.project.target import at_heights
from photoplan.requests.surface import SurfaceRequest, SurfaceSettings

#: An image whose sigma0 is so many times the median of the others is told of; or all, if sigma0 is this part of the
#: contrast of the surface. Parts of the heights that fit badly, last corrections, and standard deviations, pixels of
#: parallax, from which it is told; so many of them without a height.
_ALONE, _NOISY, _MISFITS, _MOVING, _VAGUE, _ASTRAY = 1.6, 0.35, 0.02, 0.2, 1.0, 0.001
#: Where this part of the heights fits badly, the median standard deviation tells that, and nothing of texture.
_MOST_MISFIT = 0.25
#: From this part of the reach on it tells that nothing was found there.
_LOST = 0.1
#: Residuals in parts of the noise of pixels by themselves, and of the mean grey value, from which on it is no noise.
_CONTENT, _NO_NOISE = 2.0, 0.08
#: Standard deviations by which noise alone may still move heights in the last iteration.
_NOISE_MOVES = 1.0


def findings(
    plan: SurfacePlan,
    sigma0: dict[str, float | None],
    contrast: float,
    sigma_px: float | None,
    misfit_share: float,
    correction: float,
    astray: float,
) -> tuple[str, ...]:
    """Lines about a surface that should not be trusted as it is; none if nothing speaks against it."""
    return (
        *filter(None, [plan.gap_text]),
        *_of_images(plan, sigma0, contrast),
        *_of_fits(plan, misfit_share, astray),
        *_of_moves(plan, correction, sigma_px),
        *_of_noise(plan, sigma_px, misfit_share),
    )


def contradicted(plan: SurfacePlan, totals: Mapping[str, Any]) -> str:
    """Sentence that says why the images contradict a surface; empty if they do not, or have nothing to say.

    They do if heights are hardly better known than the reach says (images agree at none of them) although there is
    texture: residuals are larger than what the pixels of each image show to be noise, or than noise of any camera.
    """
    sigma, (squares, redundancy) = median(totals["sigmas"]), (np.array(totals[k]) for k in ("squares", "redundancy"))
    noise = np.reshape(totals["noise"], (-1, 3))
    known = (redundancy > 0) & (noise[:, 2] > 0)
    if sigma is None or not known.any() or sigma < _LOST * plan.scheme.reach:
        return ""
    if sigma < _VAGUE * plan.height_error * 2**plan.scheme.base:
        return ""
    sigma0 = np.sqrt(squares[known] / redundancy[known])
    own, mean = np.sqrt(noise[known, 0] / noise[known, 2]), noise[known, 1] / noise[known, 2]
    misfits = totals["misfits"] / max(totals["heights"], 1)
    beyond_own, beyond_any = (float(np.median(sigma0 / np.maximum(other, 1e-9))) for other in (own, mean))
    if beyond_own < _CONTENT and beyond_any < _NO_NOISE and misfits < _MOST_MISFIT:
        return ""
    return (
        f"the images contradict it: their median standard deviation of a height is {sigma:.3g} m where the reach is "
        f"{plan.scheme.reach:.3g} m, and residuals of {float(np.median(sigma0)):.3g} grey values are no noise. They "
        "show different things, orientations are wrong (`photoplan check`, `photoplan tie`, `photoplan adjust`), or "
        "the start is farther away than its reach (`start`, `reach`)"
    )


def _of_images(plan: SurfacePlan, sigma0: dict[str, float | None], contrast: float) -> Iterator[str]:
    """Yield lines on the standard deviations of grey values."""
    known = {name: value for name, value in sigma0.items() if value is not None}
    others = {
        name: float(np.median([v for other, v in known.items() if other != name])) for name in known if len(known) > 2
    }
    # Of others too few pixels tell, or those of margins alone.
    judged = [name for name in others if plan.parts.get(name, 1.0) > HARDLY]
    alone = [name for name in judged if known[name] > _ALONE * others[name]]
    usual = float(np.median([*known.values()])) if known else 0.0
    if not known:
        yield (
            "there is no height: within `reach` of the start (`start`) no two images see the same, or the start has no "
            "heights there. `photoplan check` tells where each image lies"
        )
    if alone:
        listed = ", ".join(f"{name} {known[name]:.3g} ({others[name]:.3g})" for name in alone[:6])
        whose, them = "its orientation is wrong, or it shows something else", "it"
        if len(alone) > 1:
            whose, them = "their orientations are wrong, or they show something else", "them"
        yield (
            f"sigma0 of {listed} is far above that of the other images (in brackets): {whose}. `photoplan tie` and "
            f"`photoplan adjust` orient anew; `images` leaves {them} out"
        )
    elif contrast > 0 and usual > _NOISY * contrast:
        coarse = ", the relief is finer than `resolution`" if plan.scheme.base else ""
        yield (
            f"sigma0 is {usual / contrast:.0%} of the contrast of the ground: images do not show the same, or no "
            f"texture. Orientations are wrong (`photoplan tie`, `photoplan adjust`){coarse}, or the start was too far "
            "away (`start`, `reach`)"
        )


def _of_fits(plan: SurfacePlan, misfit_share: float, astray: float) -> Iterator[str]:
    """Yield lines on heights that fit badly, or went too far."""
    if misfit_share > _MISFITS:
        searched = plan.scheme.search is not None
        helps = "`search`, or a better `start` with a smaller `reach`"
        if searched:
            reach = f"a larger `reach` where things stand more than {plan.scheme.reach:.3g} m above or below the start"
            helps = f"{reach}, `target` where walls are seen"
        yield (
            f"{misfit_share:.1%} of the heights fit badly: see {plan.settings.name}_fit.tif. They lie at edges and "
            "moving things, or in regions that went wrong; their standard deviations are as large as what heights do "
            f"around them, so mask by these ({plan.settings.name}_sigma.tif). What helps: a finer `resolution`, {helps}"
        )
    if astray > _ASTRAY:
        yield (
            f"{astray:.1%} of the posts have no height since it would lie farther from the start than 1.5 times "
            "`reach`: give a larger one if the start is that wrong; if not, the images contradict the start there"
        )


def _of_moves(plan: SurfacePlan, correction: float, sigma_px: float | None) -> Iterator[str]:
    """Yield lines on the last corrections."""
    # Reduced images are all that a coarse surface sees: their pixels count.
    pixel = 2**plan.scheme.base
    if correction > _MOVING * pixel:
        # Noise moves heights by no more than their standard deviations; what is more, facets cannot follow.
        noisy = sigma_px is not None and correction < _NOISE_MOVES * sigma_px
        helps = (
            "coarser `resolution` helps, as noise moves"
            if noisy
            else "finer `resolution` helps, as relief is finer than"
        )
        yield f"the last corrections were {correction:.2g} px: heights had not settled; a {helps} them"


def _of_noise(plan: SurfacePlan, sigma_px: float | None, misfit_share: float) -> Iterator[str]:
    """Yield lines on the median standard deviation of the heights."""
    if sigma_px is None or not sigma_px > _VAGUE * 2**plan.scheme.base:
        return
    part = sigma_px * plan.height_error / plan.scheme.reach
    if part > _LOST:
        yield (
            f"the median standard deviation is {sigma_px:.2g} px of parallax, {part:.0%} of the reach: images agree on "
            "no height there. The start is farther away (`start`, `reach`), there is hardly any texture, or "
            "orientations are wrong (`photoplan tie`, `photoplan adjust`)"
        )
    elif misfit_share < _MOST_MISFIT:
        yield (
            f"the median standard deviation is {sigma_px:.2g} px of parallax: hardly any texture tells heights. What "
            "images do not determine follows its surroundings; mask it by the standard deviations, or choose a coarser "
            "`resolution`"
        )


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
class SurfaceResult(Result):
    """Files and figures of a surface."""

    plan: SurfacePlan
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
    """Sentences that speak against it, with what helps."""
    tiles: int
    resumed: int
    """Tiles taken over from an earlier run."""

    def written(self) -> Sequence[Path]:
        """Return the heights first, then all other files."""
        return (self.path, *self.others)

    def messages(self) -> Sequence[str]:
        """Return how exact the heights are, what speaks against them, and which images are left out."""
        posts = self.plan.grid.width * self.plan.grid.height
        median = "unknown" if self.sigma is None else f"{self.sigma:.3g} m ({self.sigma_px:.2g} px of parallax)"
        known = [f"{name} {value:.3g}" for name, value in self.sigma0.items() if value is not None]
        return [
            f"surface in {self.seconds:.1f} s · {self.valid_share:.1%} of {posts} posts "
            f"have a height, median standard deviation {median}; {self.misfit_share:.2%} fit badly",
            f"  last corrections, coarse to fine: {', '.join(f'{c:.3f}' for c in self.corrections[::-1])} px",
            f"  sigma0 of grey values: {', '.join(known)}",
            *noted(self.notes),
        ]

    def raise_failures(self) -> None:
        """Name the images that could not be used."""
        self.plan.raise_failures()

    def json_fields(self) -> dict[str, Any]:
        """Return all figures, with units."""
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


def surface_project(request: SurfaceRequest, events: Events = SILENT) -> SurfacePlan | SurfaceResult:
    """Plan and make the surface of a project; images whose files cannot be used are left out.

    Raises
    ------
    UsageError
        A file exists, an option cannot be, or `memory` does not suffice.
    InputError
        An input cannot be used, or the images contradict the surface and it is not forced.
    GeometryError
        Fewer than two images see a common piece of ground, or an orientation cannot be right.
    TilesFailed
        Tiles failed again and again; nothing is written.
    """
    settings, images = request.part(SurfaceSettings), request.images or None
    for attempt in Attempts(load_project(request.project), images):
        with attempt as usable:
            plan = plan_surface(usable, settings, images, force=request.force, events=events)
            if not request.dry_run:
                for line in (*plan.messages(), str(plan)):
                    events.talk(line)
                result = make_surface(plan, request.folder, Run.of(request, events))
    return plan if request.dry_run else result


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
        plan=plan,
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

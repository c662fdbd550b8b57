"""Images restored with a filter: planned, executed by tiles, recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from photoplan.engine.executors import threads
from photoplan.engine.run import Kept, Runner, Work, tiles_in_flight
from photoplan.errors import InputError, PhotoplanError, ResourceError, RunLocked, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.disk import make_folder
from photoplan.io.filter_file import filter_text
from photoplan.io.fingerprint import fingerprint
from photoplan.io.image_form import ImageForm, form_of
from photoplan.io.names import unique_stems
from photoplan.io.naming import tidy
from photoplan.io.product import check_output
from photoplan.io.raster import RasterReader
from photoplan.io.run_record import record_path, run_key
from photoplan.io.storage import Nodata
from photoplan.plain import pick
from photoplan.products.chromatic import load_chromatic, measured_once, model_figures
from photoplan.products.restore.execute import Job, RestoredImage, earlier_result, memory_of_a_tile, restoration
from photoplan.products.restore.filter import RestoreRequest
from photoplan.project.align import AlignStep
from photoplan.project.fall_off import FallOffFile, FallOffStep, load_fall_off
from photoplan.project.filter_files import entries_of, load_filter
from photoplan.project.linearisation import linearisation_of
from photoplan.project.restored import kept_nodata, restoration_of, restored
from photoplan.project.stepped import SteppedReader
from photoplan.quality.colour.model import ChromaticModel
from photoplan.quality.linearise import Linearisation
from photoplan.quality.restoration.filters import RestorationFilter

#: Memory of the interpreter with all libraries, GDAL's cache and the assembly of a product, bytes.
BASE_MEMORY = 416 * 2**20


@dataclass(frozen=True, eq=False)
class RestoreReport:
    """What became of all images."""

    images: tuple[RestoredImage, ...]
    failed: dict[str, str]
    """Why an image could not be restored, by its name."""
    filter: RestorationFilter
    folder: Path

    def json_fields(self) -> dict[str, Any]:
        """The filter by its figures."""
        return {**pick(self, "images", "failed", "folder"), "filter": filter_figures(self.filter)}


def filter_figures(filter_: RestorationFilter) -> dict[str, Any]:
    """Size, noise gain and making of a filter as plain values."""
    columns, rows = filter_.margin
    return {
        "description": filter_.description,
        "size": [2 * columns + 1, 2 * rows + 1],
        "kernels": len(filter_.kernels),
        "noise_gain": filter_.noise_gain,
        "sums": sorted({round(kernel.total, 6) for kernel in filter_.kernels}),
        "facts": dict(entries_of(filter_).facts),
    }


@dataclass(frozen=True, eq=False)
class OpticalCorrections:
    """What is corrected before the filter: light fall-off, then lateral chromatic aberration."""

    fall_off: FallOffFile | None
    chromatic: ChromaticModel | Literal["measure"] | None
    light: Linearisation

    @classmethod
    def of(cls, request: RestoreRequest, light: Linearisation) -> OpticalCorrections:
        """Those that are asked for, their files read."""
        fall_off = None if request.fall_off is None else load_fall_off(request.fall_off)
        model = load_chromatic(request.chromatic) if isinstance(request.chromatic, Path) else request.chromatic
        return cls(fall_off, model, light)

    def source(self, path: Path) -> SteppedReader:
        """The pixels of an image, corrected."""
        source = SteppedReader(RasterReader(path))
        if self.fall_off is not None:
            source = source.then(FallOffStep(self.fall_off, self.light, source.dtype))
        if self.chromatic is None:
            return source
        return source.then(AlignStep(measured_once(path) if self.chromatic == "measure" else self.chromatic))


@dataclass(frozen=True, eq=False)
class RestorePlan:
    """All images that can be restored, before any pixel is."""

    request: RestoreRequest
    filter: RestorationFilter
    jobs: tuple[Job, ...]
    failed: dict[str, str]
    in_flight: int

    @property
    def tiles(self) -> int:
        """Tiles of all images."""
        return sum(job.tiles for job in self.jobs)


def plan_restoration(request: RestoreRequest) -> RestorePlan:
    """Open the filter and all images, and see where the results go; nothing is written.

    Raises
    ------
    UsageError
        An image is given twice, a result exists or would replace an input, or `memory` is too small for a tile.
    InputError
        The filter or the table of the linearisation cannot be used.
    """
    given = request.filter
    filter_ = load_filter(given) if isinstance(given, Path) else given
    text = filter_text(entries_of(filter_))
    light = linearisation_of(request.linearisation)
    corrections = OpticalCorrections.of(request, light)
    files = [path.resolve() for path in request.images]
    twice = [path for path in files if files.count(path) > 1]
    if twice:
        raise UsageError(f"image {twice[0]} is given twice")
    stems = unique_stems(str(path.absolute()) for path in request.images)
    tools = [path for path in (given, request.chromatic, request.fall_off) if isinstance(path, Path)]
    tools += [] if request.linearisation in ("linear", "srgb") else [Path(request.linearisation)]
    jobs, failed = [], {}
    for path in request.images:
        try:
            source = corrections.source(path)
            out = np.dtype(source.info.dtype if request.dtype == "same" else request.dtype)
            _check_bands(path, source.bands, request.bands)
            chosen = _only(filter_, request.bands)
            reader = restored(source, chosen, light, out)
            target = request.folder / f"{stems[str(path.absolute())]}_restored.tif"
            jobs.append(_job(request, reader, target, text, tuple(tools)))
        except InputError as error:
            failed[path.name] = str(error)
    for job in jobs:
        _check_outputs(job, request)
    return RestorePlan(
        request=request, filter=filter_, jobs=tuple(jobs), failed=failed, in_flight=_in_flight(request, jobs)
    )


def _check_bands(path: Path, count: int, wanted: Iterable[int]) -> None:
    for band in wanted:
        if not 1 <= band <= count:
            raise InputError(f"{path}: band {band} is asked for; the image has {count}")


def _only(filter_: RestorationFilter, bands: tuple[int, ...]) -> RestorationFilter:
    """The filter for some bands alone."""
    if not bands:
        return filter_
    kernels = [replace(kernel, band=band) for band in sorted(set(bands)) for kernel in filter_.for_band(band)]
    if not kernels:
        raise InputError(f"the filter has no kernel for band {', '.join(map(str, bands))}")
    return RestorationFilter(tuple(kernels), filter_.image_size, filter_.description, filter_.facts)


def _job(request: RestoreRequest, reader: SteppedReader, target: Path, text: str, tools: tuple[Path, ...]) -> Job:
    info = reader.info
    digest = fingerprint(info.path).digest
    facts = [text, request.settings["bands"], str(reader.dtype), request.linearisation]
    aligned, lit = reader.step(AlignStep), reader.step(FallOffStep)
    if aligned is not None:
        facts.append(model_figures(aligned.model))
    if lit is not None:
        facts += ["light fall-off", lit.fall_off.digest]
    light = restoration_of(reader).restorer.linearisation
    if light.grey is not None and light.light is not None:
        facts += [light.grey.tolist(), light.light.tolist()]
    key = run_key("restored image", facts, [{"sampled_sha256": digest}])
    nodata: Nodata = kept_nodata(info, reader.dtype)
    if request.compress == "jpeg" and (reader.dtype != np.uint8 or reader.bands not in (1, 3)):
        raise InputError(
            f"{info.path}: {reader.bands} bands of {reader.dtype}; compression jpeg takes one or three of uint8"
        )
    form: ImageForm = form_of(info)
    return Job(
        reader=reader,
        target=target,
        form=form,
        key=key,
        nodata=nodata,
        digest=digest,
        tools=tools,
        inputs=(*request.images, *tools),
    )


def _check_outputs(job: Job, request: RestoreRequest) -> None:
    """Refuse results that exist, but for those of this very run when it was interrupted."""
    mine = earlier_result(job, request.settings) is not None
    outputs = [job.target, *([job.picture] if request.quicklook else [])]
    outputs += [job.chromatic_file] if request.chromatic == "measure" else []
    for path in outputs:
        check_output(path, job.inputs, overwrite=request.overwrite or mine)


def _in_flight(request: RestoreRequest, jobs: list[Job]) -> int:
    wanted = threads(request.workers).in_flight
    each = max((memory_of_a_tile(job.reader) for job in jobs), default=0)
    return tiles_in_flight(wanted, request.memory if jobs else None, BASE_MEMORY, each)


def restore_images(request: RestoreRequest, events: Events = SILENT, more: bool = False) -> RestoreReport:
    """Restore all images; one that cannot be used does not stop the others.

    Parameters
    ----------
    events : Events
        Told of tiles that are done, and of each image as soon as it is written.
    more : bool
        Whether the caller makes more of the images, such as a report: those that are all there are then no reason to
        refuse.

    Raises
    ------
    UsageError, InputError
        See `plan_restoration`; nothing is done then.
    ResourceError
        Disk or memory ran out; the same request goes on where it stopped.
    """
    plan = plan_restoration(request)
    settings = request.settings
    kept = {job.target: earlier_result(job, settings) for job in plan.jobs} if not request.overwrite else {}
    for job in plan.jobs:
        if kept.get(job.target):
            tidy([job.target, job.picture, job.chromatic_file, record_path(job.target)])
    if plan.jobs and not more and all(kept.get(job.target) for job in plan.jobs):
        first = plan.jobs[0].target
        raise UsageError(f"{first}: exists already; choose another output or say `overwrite`")
    make_folder(request.folder)
    failed = dict(plan.failed)

    def works() -> Iterator[Work[RestoredImage | None] | Kept[RestoredImage | None]]:
        for job in plan.jobs:
            found = kept.get(job.target)
            if found is not None:
                events.talk(f"{found.image}: is restored already")
                yield Kept(found, job.tiles)
                continue
            try:
                yield restoration(job, request, events)
            except PhotoplanError as error:
                failed[job.reader.info.path.name] = str(error)
                events.done(job.tiles)

    def excuse(work: Work[RestoredImage | None], error: PhotoplanError) -> None:
        if isinstance(error, ResourceError | RunLocked):
            raise error
        failed[next(job.reader.info.path.name for job in plan.jobs if job.target.stem == work.name)] = str(error)

    events.begin("restoring", plan.tiles)
    with threads(request.workers) as workers:
        results = Runner(workers, plan.in_flight, events, excuse).run(works())
    return RestoreReport(tuple(r for r in results if r is not None), failed, plan.filter, request.folder)

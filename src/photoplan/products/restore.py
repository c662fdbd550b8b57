"""Restoration of images: filters, design, and execution."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from photoplan import __version__
from photoplan.engine.executors import threads
from photoplan.engine.run import Kept, Made, Runner, Tally, Work, tiles_in_flight
from photoplan.errors import InputError, PhotoplanError, ResourceError, RunLocked, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, raise_failed
from photoplan.io.disk import COMPRESSIONS, Nodata, make_folder, make_parents
from photoplan.io.files import fingerprint, unique_stems
from photoplan.io.product import ProductFacts, ProductFile, check_output, write_quicklook
from photoplan.io.quality_files import filter_text
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import ImageForm, form_of, placement_of
from photoplan.io.store import (
    input_entry,
    record_path,
    recorded_result,
    run_key,
    run_times,
    standing,
    tidy,
    together,
    write_run_record,
)
from photoplan.plain import pick
from photoplan.plan.footprint import Tile, Tiles
from photoplan.products.measured_filter import load_chromatic, measured_once, model_figures, model_lines, save_chromatic
from photoplan.project.align import AlignStep
from photoplan.project.steps import (
    PART,
    FallOffFile,
    FallOffStep,
    SteppedReader,
    entries_of,
    fall_off_line,
    kept_nodata,
    linearisation_of,
    load_fall_off,
    load_filter,
    read_counted,
    restoration_of,
    restored,
    save_filter,
)
from photoplan.quality.colour import ChromaticModel
from photoplan.quality.curves import Linearisation
from photoplan.quality.restoration.design import aperture_filter
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter
from photoplan.requests.quality import RestoreRequest, table_of

if TYPE_CHECKING:
    from photoplan.products.measured_filter import MeasuredFilter

#: File that a measured filter is written to, in the folder of the results.
FILTER_NAME = "restoration_filter.toml"
#: Description of the filter that leaves images as they are.
NO_FILTER = "none"


@dataclass(frozen=True, eq=False)
class FoundFilter:
    """A filter and where it comes from."""

    filter: RestorationFilter
    origin: str
    """In words: "the file …"; empty: there is no filter."""
    measured: MeasuredFilter | None = None
    """The measurement that it follows from, if there was one."""


def requested_filter(request: RestoreRequest, events: Events = SILENT) -> FoundFilter:
    """Return the filter that is set; if none is, design it from what is measured in the images."""
    if request.filter == "none":
        return FoundFilter(RestorationFilter((FilterKernel(np.ones((1, 1))),), description=NO_FILTER), "")
    if isinstance(request.filter, RestorationFilter):
        return FoundFilter(request.filter, request.filter.description)
    if isinstance(request.filter, Path):
        return FoundFilter(load_filter(request.filter), f"the file {request.filter}")
    if request.aperture is not None:
        return FoundFilter(_for_aperture(request.aperture), f"the aperture of a scanner, {request.aperture}")
    # Libraries of measuring take 60 MB of memory, which an image with a given filter does without.
    from photoplan.products.measured_filter import design_restoration  # noqa: PLC0415

    found = design_restoration(request, events)
    for line in found.lines():
        events.talk(line)
    return FoundFilter(found.filter, "edges of the images", found)


def keep_filter(path: Path, filter_: RestorationFilter, *, overwrite: bool = False) -> Path:
    """Write a filter, unless the file holds the very same one already."""
    try:
        if path.read_text(encoding="utf-8") == filter_text(entries_of(filter_)):
            return path
    except (OSError, UnicodeDecodeError):
        pass
    try:
        make_parents(path.parent)
    except OSError as error:
        raise UsageError(f"{path.parent}: cannot be made ({error.strerror})") from None
    return save_filter(path, filter_, overwrite=overwrite)


def _for_aperture(text: str) -> RestorationFilter:
    shape, _, stated = text.partition(":")
    try:
        ratio = float(stated) if stated else 1.0
    except ValueError:
        ratio = float("nan")
    if shape not in ("square", "round") or ratio != ratio:
        raise UsageError(
            f"`aperture` {text}; it is square or round, with :RATIO of aperture by step, such as round:1.2"
        )
    kernel = FilterKernel(aperture_filter(cast(Literal["square", "round"], shape), ratio))
    facts = {"rule": f"inverse of the transfer function of a {shape} aperture of {ratio:g} steps (Ecker 1991, eq. 4.5)"}
    return RestorationFilter((kernel,), description=f"{shape} aperture, {ratio:g} steps", facts=facts)


@dataclass(frozen=True, eq=False)
class Job:
    """One image and what becomes of it."""

    reader: SteppedReader
    target: Path
    form: ImageForm
    key: str
    """Digest of image, filter and settings: finished tiles of another key are of no use."""
    nodata: Nodata
    digest: str
    """Digest of the image."""
    tools: tuple[Path, ...]
    """Files of the filter and of corrections: with the image they are what the result is made from."""
    inputs: tuple[Path, ...]
    """Files that must not be overwritten."""

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        width, height = self.reader.size
        return -(-width // PART) * -(-height // PART)

    @property
    def chromatic_file(self) -> Path:
        """File of a measured model of lateral chromatic aberration."""
        return self.target.with_name(self.target.stem.removesuffix("_restored") + "_chromatic.toml")

    @property
    def picture(self) -> Path:
        """The quick look."""
        return self.target.with_suffix(".png")


@dataclass(frozen=True)
class RestoredImage(Result):
    """One restored image."""

    image: str
    path: Path
    dtype: str
    noise_gain: float
    """Factor by which uncorrelated noise grew, the largest of all kernels."""
    below: tuple[int, ...]
    """Valid pixels of each band that were darker than the type can hold, and were clipped."""
    above: tuple[int, ...]
    """The same for brighter ones."""
    valid_share: float
    pixels: int
    """Pixels of a band."""
    tiles: int
    resumed: int
    """Tiles taken over from an earlier run."""
    seconds: float
    picture: Path | None = None

    @property
    def clipped_share(self) -> float:
        """Clipped pixels among the valid ones of all bands, 0 to 1."""
        valid = self.valid_share * self.pixels * len(self.below)
        return (sum(self.below) + sum(self.above)) / valid if valid else 0.0

    def written(self) -> list[Path]:
        """Return the restored image."""
        return [self.path]

    def messages(self) -> list[str]:
        """Return what became of the image, with advice if pixels were clipped."""
        lines = [f"{self.image}: {self.pixels / 1e6:.1f} Mpx in {self.seconds:.1f} s"]
        below, above = sum(self.below), sum(self.above)
        if below or above:
            way_out = "`dtype` float32 keeps all values"
            if self.dtype == "uint8" and above:
                way_out += ", `dtype` uint16 those above 255"
            lines.append(
                f"warning: {self.image}: {below} values fell below and {above} above what the type holds "
                f"({self.clipped_share:.2%}) and were clipped; {way_out}"
            )
        if self.picture is not None:
            lines.append(f"quick look: {self.picture}")
        return lines

    def json_fields(self) -> dict[str, Any]:
        """With the share of clipped pixels."""
        own = ("image", "path", "dtype", "noise_gain", "clipped_share", "valid_share", "pixels", "tiles", "seconds")
        return pick(self, *own, clipped_below="below", clipped_above="above", resumed_tiles="resumed")


def memory_of_a_tile(reader: SteppedReader) -> int:
    """Bytes that one tile in flight takes at most: pixels as read, as light, and as the result."""
    margin = restoration_of(reader).restorer.margin
    area = (PART + 6 * margin.columns) * (PART + 6 * margin.rows)
    each = reader.bands * (2 * reader.dtype_before(len(reader.steps) - 1).itemsize + 2 * reader.dtype.itemsize) + 48
    if reader.step(FallOffStep) is not None:
        # Stored pixels, light before and after, and the terms of the gain.
        each += reader.bands * (np.dtype(reader.info.dtype).itemsize + 20) + 100
    if reader.step(AlignStep) is not None:
        # The same pixels before they are displaced, and the displacements.
        each += 2 * reader.bands * reader.dtype_before(len(reader.steps) - 1).itemsize + 56
    return int(area * each)


def earlier_result(job: Job, settings: dict[str, Any]) -> RestoredImage | None:
    """The result of an earlier run with the same image, filter and settings; None if there is none."""

    def result(made: dict[str, Any], recorded: object) -> RestoredImage | None:
        if recorded != settings or not job.target.is_file():
            return None
        return RestoredImage(
            image=made["image"],
            path=job.target,
            dtype=made["dtype"],
            noise_gain=made["noise_gain"],
            below=tuple(made["clipped_below"]),
            above=tuple(made["clipped_above"]),
            valid_share=made["valid_share"],
            pixels=made["pixels"],
            tiles=made["tiles"],
            resumed=made["tiles"],
            seconds=made["seconds"],
            picture=job.picture if job.picture.is_file() else None,
        )

    return recorded_result(job.target, job.key, result)


@dataclass(frozen=True, eq=False)
class RestoreJob:
    """Restoration of one image, as workers get it once."""

    reader: SteppedReader

    def __call__(self, tile: Tile) -> Made:
        """Restored pixels of a tile, and how many were clipped."""
        pixels = read_counted(self.reader, tile.window)
        record = {"below": [int(n) for n in pixels.below], "above": [int(n) for n in pixels.above]}
        return Made(((pixels.values, pixels.valid),), record)


def restoration(job: Job, how: RestoreRequest, events: Events) -> Work[RestoredImage | None]:
    """Return the work for an image, or for the part of it that an earlier run has left."""
    reader = job.reader
    for note in reader.info.warnings:
        events.talk(f"note: {note}")
    if not restoration_of(reader).restorer.is_compiled:
        events.talk("compiling the filter kernels, once (some seconds)")
    file = ProductFile(
        job.target,
        placement_of(reader.info),
        reader.bands,
        reader.dtype,
        run_key=job.key,
        nodata=job.nodata,
        compress=how.compress,
        tile=PART,
        overwrite=how.overwrite,
        inputs=job.inputs,
        threads=how.workers,
        form=job.form,
    )
    tiles = Tiles.every(file.placement.window, file.tile)
    return Work(
        name=job.target.stem,
        job=RestoreJob(reader),
        tiles=tiles,
        count=len(tiles),
        sinks=(file,),
        complete=partial(_complete, job, how, file, run_times()),
    )


def _complete(
    job: Job, how: RestoreRequest, file: ProductFile, times: Callable[[], dict[str, Any]], tally: Tally
) -> RestoredImage:
    """Give the product its name, its record and its quick look."""
    if tally.failed:
        raise PhotoplanError(f"{job.target}: {tally.reasons[0]}; finished tiles are kept")
    with together():
        facts = file.complete(_tags(job))
        reader = job.reader
        aligned = reader.step(AlignStep)
        if how.chromatic == "measure" and aligned is not None:
            save_chromatic(job.chromatic_file, aligned.model)
        ran = times()
        nothing = [0] * reader.bands
        result = RestoredImage(
            image=reader.info.path.name,
            path=job.target,
            dtype=str(reader.dtype),
            noise_gain=restoration_of(reader).restorer.filter.noise_gain,
            below=tuple(tally.totals.get("below", nothing)),
            above=tuple(tally.totals.get("above", nothing)),
            valid_share=facts.valid_share,
            pixels=reader.size[0] * reader.size[1],
            tiles=job.tiles,
            resumed=tally.resumed,
            seconds=ran["seconds"],
            picture=job.picture if how.quicklook else None,
        )
        if how.quicklook:
            write_quicklook(standing(job.target), job.picture)
        write_run_record(
            job.target,
            key=job.key,
            inputs=[input_entry(reader.info.path, job.digest), *job.tools],
            run={"workers": how.workers, "memory": how.memory, **ran},
            **_record(job, how, result, facts),
        )
    return result


def _tags(job: Job) -> dict[str, str]:
    """Return the tags that state the origin in the file itself."""
    return {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_IMAGE": job.reader.info.path.name,
        "PHOTOPLAN_RESTORED": restoration_of(job.reader).restorer.filter.description or "yes",
        "PHOTOPLAN_KEY": job.key,
        "TIFFTAG_SOFTWARE": f"photoplan {__version__}",
    }


def _record(job: Job, how: RestoreRequest, result: RestoredImage, facts: ProductFacts) -> dict[str, Any]:
    """Return what is needed to check the result, and to make it again."""
    restorer = restoration_of(job.reader).restorer
    aligned, lit = job.reader.step(AlignStep), job.reader.step(FallOffStep)
    return {
        "product": result,
        "settings": _settings(how),
        "linearisation": restorer.linearisation.describe(),
        "chromatic": None if aligned is None else model_figures(aligned.model),
        "fall_off": lit and lit.fall_off,
        "filter": {
            "description": restorer.filter.description,
            "image_size": restorer.filter.image_size,
            "facts": dict(restorer.filter.facts),
            "kernels": [
                {"band": k.band, "at": k.at, "noise_gain": k.noise_gain, "sum": k.total, "values": k.values}
                for k in restorer.filter.kernels
            ],
        },
        "values_moved_off_nodata": facts.moved_values,
        "bytes": facts.bytes,
    }


def _settings(request: RestoreRequest) -> dict[str, Any]:
    """Return what decides the results beside images and filter, as plain values."""
    chromatic = "a model" if isinstance(request.chromatic, ChromaticModel) else request.chromatic
    return {
        "bands": list(request.bands),
        "linearisation": request.linearisation or "linear",
        "dtype": request.dtype,
        "chromatic": chromatic and str(chromatic),
        "fall_off": request.fall_off and str(request.fall_off),
        "compress": request.compress,
    }


#: Memory of the interpreter with all libraries, GDAL's cache and the assembly of a product, bytes.
BASE_MEMORY = 416 * 2**20


@dataclass(frozen=True, eq=False)
class RestoreReport(Result):
    """Restored images, and why others failed."""

    images: tuple[RestoredImage, ...]
    failed: dict[str, str]
    """Reason why an image could not be restored, by its name."""
    found: FoundFilter
    folder: Path
    jobs: tuple[Job, ...]

    def json_fields(self) -> dict[str, Any]:
        """Return the images, and the filter by its figures."""
        return {**pick(self, "images", "failed", "folder"), "filter": filter_figures(self.found.filter)}

    def written(self) -> list[Path]:
        """Return the restored images."""
        return [image.path for image in self.images]


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
    """Corrections before the filter: light fall-off, then lateral chromatic aberration."""

    fall_off: FallOffFile | None
    chromatic: ChromaticModel | Literal["measure"] | None
    light: Linearisation

    @classmethod
    def of(cls, request: RestoreRequest, light: Linearisation) -> OpticalCorrections:
        """Read the corrections of a request."""
        fall_off = None if request.fall_off is None else load_fall_off(request.fall_off)
        model = load_chromatic(request.chromatic) if isinstance(request.chromatic, Path) else request.chromatic
        return cls(fall_off, cast("ChromaticModel | Literal['measure'] | None", model), light)

    def source(self, path: Path) -> SteppedReader:
        """The pixels of an image, corrected."""
        source = SteppedReader(RasterReader(path))
        if self.fall_off is not None:
            source = source.then(FallOffStep(self.fall_off, self.light, source.dtype))
        if self.chromatic is None:
            return source
        return source.then(AlignStep(measured_once(path) if self.chromatic == "measure" else self.chromatic))


@dataclass(frozen=True, eq=False)
class RestorePlan(Result):
    """All images that can be restored, before any pixel is."""

    request: RestoreRequest
    found: FoundFilter
    jobs: tuple[Job, ...]
    failed: dict[str, str]
    in_flight: int

    @property
    def tiles(self) -> int:
        """Tiles of all images."""
        return sum(job.tiles for job in self.jobs)

    def json_fields(self) -> dict[str, Any]:
        """Return the filter by its figures, and what becomes of each image."""
        rows = [
            {
                "image": job.reader.info.path,
                "path": job.target,
                **pick(job.reader, "size", "bands"),
                "dtype": str(job.reader.dtype),
                "tiles": job.tiles,
            }
            for job in self.jobs
        ]
        return {"filter": filter_figures(self.found.filter), "images": rows, "failed": self.failed}

    def written(self) -> list[Path]:
        """Return nothing: no file was written."""
        return []

    def summary(self) -> list[str]:
        """Return what becomes of each image."""
        return [
            f"{job.reader.info.path}: {job.reader.size[0]} × {job.reader.size[1]}, {_count(job.reader.bands, 'band')} "
            f"of {job.reader.dtype}, {_count(job.tiles, 'tile')} → {job.target}"
            for job in self.jobs
        ]

    def lines(self) -> list[str]:
        """Return what to know before the filter is used: growth of noise, rules, corrections."""
        figures, lines = filter_figures(self.found.filter), []
        if self.found.filter.description != NO_FILTER:
            sums = ", ".join(f"{total:.4g}" for total in figures["sums"][:6])
            lines.append(
                f"filter {figures['size'][0]} × {figures['size'][1]}, {_count(figures['kernels'], 'kernel')}, sum "
                f"{sums}: noise grows {figures['noise_gain']:.3g} times"
            )
        lines += [f"{name}: {figures['facts'][name]}" for name in ("condition", "rule", "expected")
                  if name in figures["facts"]]  # fmt: skip
        for job in self.jobs:
            lit, aligned = job.reader.step(FallOffStep), job.reader.step(AlignStep)
            found = [] if lit is None else [fall_off_line(lit.fall_off)]
            found += [] if aligned is None else model_lines(aligned.model)
            lines += [f"{job.reader.info.path.name}: {line}" for line in found]
        return lines

    def raise_failures(self) -> None:
        """Name the images that cannot be restored."""
        raise_failed(self.failed, len(self.jobs))


def _count(number: int, what: str) -> str:
    return f"1 {what}" if number == 1 else f"{number} {what}s"


def plan_restoration(request: RestoreRequest, events: Events = SILENT) -> RestorePlan:
    """Find the filter, open all images, and see where the results go; nothing is written.

    Raises
    ------
    UsageError
        An image is given twice, a result exists or would replace an input, or `memory` is too small for a tile.
    InputError
        The filter or the table of the linearisation cannot be used.
    """
    if request.compress not in COMPRESSIONS:
        raise UsageError(f"compression {request.compress!r}; allowed are {', '.join(COMPRESSIONS)}")
    found = requested_filter(request, events)
    filter_ = found.filter
    text = filter_text(entries_of(filter_))
    light = linearisation_of(request.linearisation or "linear")
    corrections = OpticalCorrections.of(request, light)
    files = [path.resolve() for path in request.images]
    twice = [path for path in files if files.count(path) > 1]
    if twice:
        raise UsageError(f"image {twice[0]} is given twice")
    stems = unique_stems(str(path.absolute()) for path in request.images)
    tools = [path for path in (request.filter, request.chromatic, request.fall_off) if isinstance(path, Path)]
    tools += table_of(request.linearisation)
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
        request=request, found=found, jobs=tuple(jobs), failed=failed, in_flight=_in_flight(request, jobs)
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
    facts: list[Any] = [text, list(request.bands), str(reader.dtype), request.linearisation or "linear"]
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
    mine = earlier_result(job, _settings(request)) is not None
    outputs = [job.target, *([job.picture] if request.quicklook else [])]
    outputs += [job.chromatic_file] if request.chromatic == "measure" else []
    for path in outputs:
        check_output(path, job.inputs, overwrite=request.overwrite or mine)


def _in_flight(request: RestoreRequest, jobs: list[Job]) -> int:
    wanted = threads(request.workers).in_flight
    each = max((memory_of_a_tile(job.reader) for job in jobs), default=0)
    return tiles_in_flight(wanted, request.memory if jobs else None, BASE_MEMORY, each)


def restore(request: RestoreRequest, events: Events = SILENT) -> RestoreReport | RestorePlan:
    """Restore all images, see `restore_images`; in a dry run return the plan."""
    plan = plan_restoration(request, events)
    for line in plan.lines():
        events.talk(line)
    return plan if request.dry_run else _restore(plan, events)


def restore_images(request: RestoreRequest, events: Events = SILENT) -> RestoreReport:
    """Restore all images; one that cannot be used does not stop the others.

    Images that are all restored already are refused, unless a report is made of them.

    Raises
    ------
    UsageError, InputError
        See `plan_restoration`; nothing is done then.
    ResourceError
        Disk or memory ran out; the same request goes on where it stopped.
    """
    return _restore(plan_restoration(request, events), events)


def _restore(plan: RestorePlan, events: Events) -> RestoreReport:
    request = plan.request
    if plan.found.measured is not None:
        path = request.save_filter or request.folder / FILTER_NAME
        events.talk(f"filter: {keep_filter(path, plan.found.filter, overwrite=request.overwrite)}")
    settings = _settings(request)
    kept = {job.target: earlier_result(job, settings) for job in plan.jobs} if not request.overwrite else {}
    for job in plan.jobs:
        if kept.get(job.target):
            tidy([job.target, job.picture, job.chromatic_file, record_path(job.target)])
    if plan.jobs and request.report is None and all(kept.get(job.target) for job in plan.jobs):
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
    images = tuple(result for result in results if result is not None)
    return RestoreReport(images=images, failed=failed, found=plan.found, folder=request.folder, jobs=plan.jobs)

"""One image restored by tiles: workers, the log of finished tiles, the product and its record."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.engine.executors import Workers, executor_factory, run_tiles
from photoplan.errors import PhotoplanError
from photoplan.io.image_form import ImageForm, placement_of
from photoplan.io.product import ProductFacts, ProductFile
from photoplan.io.quicklook import write_quicklook
from photoplan.io.run_record import peak_memory_bytes, record_path, versions, write_run_record
from photoplan.io.storage import Nodata
from photoplan.io.tile_log import TileLog
from photoplan.plain import pick
from photoplan.products.chromatic import model_figures, save_chromatic
from photoplan.products.restore.request import RestoreRequest
from photoplan.project.restored_reader import PART, RestoredReader


@dataclass(frozen=True, eq=False)
class Job:
    """One image and what becomes of it."""

    reader: RestoredReader
    target: Path
    form: ImageForm
    key: str
    """Digest of image, filter and settings: finished tiles of another key are of no use."""
    nodata: Nodata
    digest: str
    """Of the image."""
    inputs: tuple[Path, ...]
    """Files that must not be overwritten."""

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        width, height = self.reader.size
        return -(-width // PART) * -(-height // PART)

    @property
    def chromatic_file(self) -> Path:
        """Where a measured model of lateral chromatic aberration is written."""
        return self.target.with_name(self.target.stem.removesuffix("_restored") + "_chromatic.toml")

    @property
    def picture(self) -> Path:
        """The quick look."""
        return self.target.with_suffix(".png")


@dataclass(frozen=True)
class RestoredImage:
    """What became of one image."""

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

    def json_fields(self) -> dict[str, Any]:
        """With the share of clipped pixels."""
        own = ("image", "path", "dtype", "noise_gain", "clipped_share", "valid_share", "pixels", "tiles", "seconds")
        return pick(self, *own, clipped_below="below", clipped_above="above", resumed_tiles="resumed")


def memory_of_a_tile(reader: RestoredReader) -> int:
    """Bytes that one tile in flight takes at most: pixels as read, as light, and as the result."""
    margin = reader.restorer.margin
    area = (PART + 6 * margin.columns) * (PART + 6 * margin.rows)
    each = reader.bands * (2 * reader.source.dtype.itemsize + 2 * reader.dtype.itemsize) + 48
    if reader.lit is not None:
        # Stored pixels, light before and after, and the terms of the gain.
        each += reader.bands * (np.dtype(reader.info.dtype).itemsize + 20) + 100
    if reader.aligned is not None:
        # The same pixels before they are displaced, and the displacements.
        each += 2 * reader.bands * reader.source.dtype.itemsize + 56
    return int(area * each)


def earlier_result(job: Job, settings: dict[str, Any]) -> RestoredImage | None:
    """The result of an earlier run with the same image, filter and settings; None if there is none."""
    try:
        record = json.loads(record_path(job.target).read_text(encoding="utf-8"))
        made = record["product"]
        if record["key"] != job.key or record["settings"] != settings or not job.target.is_file():
            return None
        return RestoredImage(
            made["image"],
            job.target,
            made["dtype"],
            made["noise_gain"],
            tuple(made["clipped_below"]),
            tuple(made["clipped_above"]),
            made["valid_share"],
            made["pixels"],
            made["tiles"],
            made["tiles"],
            made["seconds"],
            job.picture if job.picture.is_file() else None,
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


def restore_one(
    job: Job, how: RestoreRequest, in_flight: int, advance: Callable[[int, int], None], talk: Callable[[str], None]
) -> RestoredImage:
    """Restore an image, or what an earlier run has left of it.

    Raises
    ------
    InputError
        The image is damaged.
    PhotoplanError
        A tile failed again and again; finished tiles are kept.
    ResourceError
        Disk or memory ran out; finished tiles are kept.
    """
    started = time.perf_counter()
    reader = job.reader
    for note in reader.info.warnings:
        talk(f"note: {note}")
    if not reader.restorer.is_compiled:
        talk("compiling the filter kernels, once (some seconds)")
    width, height = reader.size
    counted = _Counted()
    with ProductFile(
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
    ) as file:
        facts = _all_tiles(job, how, file, (in_flight, counted), advance, talk)
    below, above = counted.sums(reader.bands)
    if how.chromatic == "measure" and reader.aligned is not None:
        save_chromatic(job.chromatic_file, reader.aligned.model)
    result = RestoredImage(
        reader.info.path.name,
        job.target,
        str(reader.dtype),
        reader.restorer.filter.noise_gain,
        below,
        above,
        facts.valid_share,
        width * height,
        job.tiles,
        counted.resumed,
        time.perf_counter() - started,
        job.picture if how.quicklook else None,
    )
    # The record first: a disk that is full for the picture does not leave a result without it.
    write_run_record(record_path(job.target), _record(job, how, result, facts))
    if how.quicklook:
        write_quicklook(job.target, job.picture)
    return result


@dataclass
class _Counted:
    tiles: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    resumed: int = 0

    def sums(self, bands: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Clipped pixels of each band, below and above."""
        total = np.sum(list(self.tiles.values()) or [np.zeros((2, bands), np.int64)], axis=0)
        return tuple(map(int, total[0])), tuple(map(int, total[1]))


def _all_tiles(
    job: Job,
    how: RestoreRequest,
    file: ProductFile,
    state: tuple[int, _Counted],
    advance: Callable[[int, int], None],
    talk: Callable[[str], None],
) -> ProductFacts:
    """Bring every tile into the product; those of an earlier run are there already."""
    in_flight, counted = state
    bands = job.reader.bands
    # What was clipped is logged before the tile itself, so that every finished tile has its figures.
    with TileLog(job.target.with_name(f".{job.target.name}.clipped"), job.key) as log:
        finished = file.finished & log.finished
        for index in finished:
            counted.tiles[index] = np.frombuffer(log.read(index), np.int64).reshape(2, bands)
        counted.resumed = len(finished)
        if finished:
            talk(f"{job.target.stem}: {len(finished)} of {job.tiles} tiles are finished already")
            advance(len(finished), 0)
        tasks = [(i, window) for i, window in enumerate(file.windows) if i not in finished]
        with Workers(executor_factory("threads", how.workers)) as workers:
            for outcome in run_tiles(tasks, lambda task: job.reader.read_counted(task[1]), workers, in_flight):
                index, window = outcome.task
                if outcome.error is not None:
                    raise PhotoplanError(f"{job.target}: tile {index}: {outcome.error}; finished tiles are kept")
                pixels = outcome.result
                clipped = np.array([pixels.below, pixels.above], np.int64)
                log.append(index, clipped.tobytes())
                file.append(index, pixels.values, pixels.valid)
                counted.tiles[index] = clipped
                advance(1, window.size)
        facts = file.complete(_tags(job))
        log.remove()
    return facts


def _tags(job: Job) -> dict[str, str]:
    """What the file itself says of its origin."""
    return {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_IMAGE": job.reader.info.path.name,
        "PHOTOPLAN_RESTORED": job.reader.restorer.filter.description or "yes",
        "PHOTOPLAN_KEY": job.key,
        "TIFFTAG_SOFTWARE": f"photoplan {__version__}",
    }


def _record(job: Job, how: RestoreRequest, result: RestoredImage, facts: ProductFacts) -> dict[str, Any]:
    """The run record: what a person needs to answer for the result, and to make it again."""
    restorer = job.reader.restorer
    return {
        "product": result,
        "key": job.key,
        "inputs": [{"path": job.reader.info.path, "sampled_sha256": job.digest}]
        + [{"path": path} for path in job.inputs if path.resolve() != job.reader.info.path.resolve()],
        "settings": how.settings,
        "linearisation": restorer.linearisation.describe(),
        "chromatic": None if job.reader.aligned is None else model_figures(job.reader.aligned.model),
        "fall_off": None if job.reader.lit is None else job.reader.lit.fall_off.to_dict(),
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
        "run": {"workers": how.workers, "memory": how.memory},
        "versions": versions(),
        "peak_memory_bytes": peak_memory_bytes(),
    }

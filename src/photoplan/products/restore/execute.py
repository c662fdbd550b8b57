"""One image restored by tiles: what a tile is, the product and its record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photoplan import __version__
from photoplan.engine.run import Made, Tally, Work
from photoplan.errors import PhotoplanError
from photoplan.events import Events
from photoplan.io.image_form import ImageForm, placement_of
from photoplan.io.naming import standing, together
from photoplan.io.product import ProductFacts, ProductFile
from photoplan.io.quicklook import write_quicklook
from photoplan.io.run_record import input_entry, recorded_result, run_times, write_run_record
from photoplan.io.storage import Nodata
from photoplan.plain import pick
from photoplan.plan.tiles import Tile, Tiles
from photoplan.products.chromatic import model_figures, save_chromatic
from photoplan.products.restore.filter import RestoreRequest
from photoplan.project.align import AlignStep
from photoplan.project.fall_off import FallOffStep
from photoplan.project.restored import read_counted, restoration_of
from photoplan.project.stepped import PART, SteppedReader


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
    """Of the image."""
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
    """What a worker is told once."""

    reader: SteppedReader

    def __call__(self, tile: Tile) -> Made:
        """Restored pixels of a tile, and how many were clipped."""
        pixels = read_counted(self.reader, tile.window)
        record = {"below": [int(n) for n in pixels.below], "above": [int(n) for n in pixels.above]}
        return Made(((pixels.values, pixels.valid),), record)


def restoration(job: Job, how: RestoreRequest, events: Events) -> Work[RestoredImage | None]:
    """What there is to do for an image, or for what an earlier run has left of it."""
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
    """What the file itself says of its origin."""
    return {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_IMAGE": job.reader.info.path.name,
        "PHOTOPLAN_RESTORED": restoration_of(job.reader).restorer.filter.description or "yes",
        "PHOTOPLAN_KEY": job.key,
        "TIFFTAG_SOFTWARE": f"photoplan {__version__}",
    }


def _record(job: Job, how: RestoreRequest, result: RestoredImage, facts: ProductFacts) -> dict[str, Any]:
    """What a person needs to answer for the result, and to make it again."""
    restorer = restoration_of(job.reader).restorer
    aligned, lit = job.reader.step(AlignStep), job.reader.step(FallOffStep)
    return {
        "product": result,
        "settings": how.settings,
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

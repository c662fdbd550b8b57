"""A raster that is computed window by window and appears under its name only when it is complete."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.executors import available_cpus, threads
from photoplan.engine.run import Made, Runner, Tally, Work
from photoplan.errors import ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import Placement, Window, refuse_absurd
from photoplan.io.disk import free_megabytes
from photoplan.io.image_form import ImageForm
from photoplan.io.naming import together
from photoplan.io.product import ProductFacts, ProductFile, check_output
from photoplan.io.run_record import input_entry, run_key, run_times, settings_of, write_run_record
from photoplan.io.storage import Nodata
from photoplan.plan.tiles import Tile, Tiles

GridTile = NDArray[Any] | tuple[NDArray[Any], NDArray[np.bool_]] | None
"""Values (bands, h, w); or values and validity (h, w), True = valid; or None: nothing is valid."""
GridTiles = Callable[[Window], GridTile]
"""Computes a window of the grid; called from several threads."""


@dataclass(frozen=True)
class GridOptions:
    """How a grid is written, and what is told of it."""

    _: KW_ONLY
    kind: str
    """What it is, such as "hillshade"."""
    settings: Mapping[str, Any]
    """All that decides its values beside the inputs and the place: goes into the record and the run's key."""
    inputs: Sequence[Path]
    """Files that decide its values; none may be overwritten, also by a link."""
    tile: int = 512
    """Side of the windows and of the blocks in the file, pixels; a multiple of 16, at least 128."""
    workers: int | None = None
    """Windows computed at once; None: as many as there are cores."""
    overwrite: bool = False
    """Replace an output that exists."""
    events: Events = SILENT
    """Told of windows that are finished."""
    compress: str = "deflate"
    """`none`, `deflate`, `zstd`, `lzw` or `jpeg`."""
    overviews: bool = True
    """Reduced copies inside the file."""
    resampling: str = "average"
    """How they are reduced: `average`; `mode` or `nearest` for classes and directions, which have no mean."""
    colours: Mapping[int, tuple[int, int, int]] | None = None
    """Colour table of one band of uint8: red, green, blue, 0 to 255, of each value."""
    tags: Mapping[str, str] | None = None
    """Tags of the file."""
    form: ImageForm | None = None
    """Names, units and offsets of its bands."""

    @classmethod
    def of(cls, request: Any, kind: str, inputs: Sequence[Path], events: Events, **more: Any) -> GridOptions:
        """Those of a request: its fields that may decide values are the settings; its files are inputs or outputs."""
        # How exactly volumes are integrated does not change the raster beside them.
        settings = {name: value for name, value in settings_of(request).items() if name != "tolerance"}
        given = {"settings": settings, "workers": request.workers, "overwrite": request.overwrite, "events": events}
        return cls(kind=kind, inputs=inputs, **(given | more))

    @property
    def key(self) -> str:
        """The digest of all that decides its values beside the place."""
        return run_key(self.kind, self.settings, self.inputs)


def write_grid(
    path: Path, placement: Placement, dtype: Any, bands: int, nodata: Nodata, tiles: GridTiles, options: GridOptions
) -> ProductFacts:
    """Write a raster as a cloud-optimised GeoTIFF with its run record, crash-safe, with bounded memory.

    Windows are computed in threads; no more than two for each worker are held at once. The file appears under its name
    only when it is complete and has been read again (see `ProductFile`). A run that was killed is continued by the
    next one with the same inputs, settings and version.
    """
    path, dtype, times = Path(path), np.dtype(dtype), run_times()
    check_output(path, options.inputs, overwrite=options.overwrite)
    refuse_absurd(placement.size, options.tile, f"{path}: pixels of {abs(placement.coefficients[0]):g} m")
    workers = available_cpus() if options.workers is None else options.workers
    pool = threads(workers)
    if options.colours is not None and (dtype != np.uint8 or bands != 1):
        raise UsageError(f"{path}: a colour table for {bands} bands of {dtype}; it needs one band of uint8")
    key, inputs = options.key, [input_entry(each) for each in options.inputs]
    file = ProductFile(
        path,
        placement,
        bands,
        dtype,
        run_key=key,
        nodata=nodata,
        compress=options.compress,
        overviews=options.overviews,
        tile=options.tile,
        overwrite=options.overwrite,
        inputs=options.inputs,
        threads=workers,
        resampling=options.resampling,
        colours=options.colours,
        form=options.form,
    )
    windows = Tiles.every(file.placement.window, file.tile)
    kept = file.log_path.stat().st_size if file.log_path.exists() else 0
    _check_space(path, max(0, len(windows) * options.tile**2 * bands * dtype.itemsize - kept))
    work = Work(
        name=path.stem,
        job=GridJob(tiles, None if file.nodata_value is None else dtype.type(file.nodata_value)),
        tiles=windows,
        count=len(windows),
        sinks=(file,),
        complete=partial(_complete, file, dict(options.tags or {})),
    )
    options.events.begin(path.name, len(windows))
    with pool, together():
        (facts,) = Runner[ProductFacts](pool, None, options.events).run([work])
        write_run_record(
            path,
            key=key,
            inputs=inputs,
            run={"workers": workers, **times()},
            kind=options.kind,
            product=facts,
            settings=options.settings,
            grid=placement,
        )
    return facts


@dataclass(frozen=True)
class GridJob:
    """Computes a window, and what of it is valid."""

    tiles: GridTiles
    nodata: Any
    """Value of an invalid pixel; NaN: NaN; None: there is none."""

    def __call__(self, tile: Tile) -> Made:
        """Values and validity of a window."""
        found = self.tiles(tile.window)
        if found is None:
            return Made((None,))
        values, valid = found if isinstance(found, tuple) else (found, None)
        if valid is None and self.nodata is not None:
            missing = np.isnan(values) if values.dtype.kind == "f" else values == self.nodata
            valid = np.asarray(~missing.all(axis=0))
        return Made(((values, valid),))


def _complete(file: ProductFile, tags: dict[str, str], tally: Tally) -> ProductFacts:
    tally.check(file.path)
    return file.complete(tags)


def _check_space(path: Path, raw: int) -> None:
    """Refuse at once what cannot fit: the tiles and a plain copy of them stand on the disk at the same time."""
    free = free_megabytes(path)
    if 0 <= free < 2 * raw // 1_000_000:
        raise ResourceError(
            f"{path}: needs up to {2 * raw // 1_000_000} MB while it is made, {free} MB are free there; free some "
            "space, or choose a coarser resolution or smaller bounds"
        )

"""A raster that is computed window by window and appears under its name only when it is complete."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import ResourceError, UsageError
from photoplan.geometry.grid import Placement, Window
from photoplan.io.disk import free_megabytes
from photoplan.io.product import ProductFacts, ProductFile, check_output
from photoplan.io.storage import Nodata

GridTile = NDArray[Any] | tuple[NDArray[Any], NDArray[np.bool_]] | None
"""Values (bands, h, w); or values and validity (h, w), True = valid; or None: nothing is valid."""
GridTiles = Callable[[Window], GridTile]
"""Computes a window of the grid; called from several threads."""


@dataclass(frozen=True)
class GridOptions:
    """How a grid is written; none of it changes a value."""

    _: KW_ONLY
    tile: int = 512
    """Side of the windows and of the blocks in the file, pixels; a multiple of 16, at least 128."""
    workers: int | None = None
    """Windows computed at once; None: as many as there are cores."""
    overwrite: bool = False
    """Replace an output that exists."""
    inputs: Sequence[Path | str] = ()
    """Files that must not be overwritten, also by a link."""
    progress: Callable[[int, int], None] | None = None
    """Called with the number of windows just finished and of their pixels."""
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
    run_key: str | None = None
    """A digest of inputs, parameters and version: a run that was killed is continued by the next one with the same
    key. None: the next run starts afresh."""


def write_grid(
    path: Path, placement: Placement, dtype: Any, bands: int, nodata: Nodata, tiles: GridTiles, options: GridOptions
) -> ProductFacts:
    """Write a raster as a cloud-optimised GeoTIFF, crash-safe, with bounded memory.

    Windows are computed in threads; no more than two for each worker are held at once. The file appears under its name
    only when it is complete and has been read again (see `ProductFile`).

    Parameters
    ----------
    path
        The file.
    placement
        Its size, and where its pixels are.
    dtype, bands
        uint8, uint16, int16 or float32; number of bands.
    nodata
        A value, `mask` for a mask band, or `auto`: 0 for unsigned integers, -32768 for int16, NaN for float32.
    tiles
        Computes a window. Where it gives values alone, a pixel is invalid if all of its bands are nodata (for floats:
        NaN); with `mask` all are then valid. A valid value that equals nodata becomes its neighbour.
    options
        See `GridOptions`.

    Returns
    -------
    ProductFacts
        Path, size, share of valid pixels.

    Raises
    ------
    UsageError
        The output exists, is an input, or lies in a folder that cannot be written; before any window is computed.
    RunLocked
        Another run is writing it.
    ResourceError
        The disk has too little space, before any window is computed; or it became full.
    Exception
        Whatever `tiles` raises; nothing stays under the name then.
    """
    path, dtype = Path(path), np.dtype(dtype)
    check_output(path, options.inputs, overwrite=options.overwrite)
    workers = _workers(options.workers)
    if options.colours is not None and (dtype != np.uint8 or bands != 1):
        raise UsageError(f"{path}: a colour table for {bands} bands of {dtype}; it needs one band of uint8")
    key = options.run_key or secrets.token_hex(16)
    with ProductFile(
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
    ) as file:
        try:
            finished = file.finished
            waiting = [i for i in range(len(file.windows)) if i not in finished]
            _check_space(path, len(waiting) * options.tile**2 * bands * dtype.itemsize)
            if options.progress is not None and len(waiting) < len(file.windows):
                options.progress(len(file.windows) - len(waiting), 0)
            for index, tile in _computed(file.windows, waiting, tiles, workers):
                _append(file, index, tile, dtype)
                if options.progress is not None:
                    options.progress(1, file.windows[index].size)
            return file.complete(dict(options.tags or {}))
        except BaseException:
            if options.run_key is None:
                # Nobody could continue with these tiles: their key is known to this run alone.
                file.discard()
            raise


def _workers(wanted: int | None) -> int:
    if wanted is not None and wanted < 1:
        raise UsageError(f"{wanted} workers; at least one is needed")
    return wanted or os.cpu_count() or 1


def _check_space(path: Path, raw: int) -> None:
    """Refuse at once what cannot fit: the tiles and a plain copy of them stand on the disk at the same time."""
    free = free_megabytes(path)
    if 0 <= free < 2 * raw // 1_000_000:
        raise ResourceError(
            f"{path}: needs up to {2 * raw // 1_000_000} MB while it is made, {free} MB are free there; free some "
            "space, or choose a coarser resolution or smaller bounds"
        )


def _computed(
    windows: Sequence[Window], waiting: Sequence[int], tiles: GridTiles, workers: int
) -> Iterator[tuple[int, GridTile]]:
    """Index and content of windows as they are finished; no more than two for each worker under way."""
    if workers == 1:
        for index in waiting:
            yield index, tiles(windows[index])
        return
    with ThreadPoolExecutor(workers, "photoplan") as pool:
        running: dict[Future[GridTile], int] = {}
        try:
            for index in waiting:
                running[pool.submit(tiles, windows[index])] = index
                while len(running) >= 2 * workers:
                    yield from _finished(running)
            while running:
                yield from _finished(running)
        finally:
            for future in running:
                future.cancel()


def _finished(running: dict[Future[GridTile], int]) -> Iterator[tuple[int, GridTile]]:
    done, _ = wait(running, return_when=FIRST_COMPLETED)
    # In the order of the windows, so that the file of a serial run and of this one grow alike.
    for future in sorted(done, key=running.__getitem__):
        yield running.pop(future), future.result()


def _append(file: ProductFile, index: int, tile: GridTile, dtype: np.dtype[Any]) -> None:
    if tile is None:
        file.append_empty(index)
        return
    values, valid = tile if isinstance(tile, tuple) else (tile, None)
    if valid is None and file.nodata_value is not None:
        missing = np.isnan(values) if dtype.kind == "f" else values == dtype.type(file.nodata_value)
        valid = np.asarray(~missing.all(axis=0))
    file.append(index, values, valid)

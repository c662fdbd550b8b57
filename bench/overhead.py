"""What a tile costs beside its pixels: the loop with a job that does nothing, by threads and on a Dask cluster.

    python bench/overhead.py

Prints milliseconds of processor time (user + system, of this process and its children) per tile.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from photoplan.engine.executors import Question, Workers, executor_factory, open_workers
from photoplan.engine.run import Made, Runner, Tally, Work
from photoplan.events import SILENT
from photoplan.geometry.grid import MapGrid
from photoplan.io.product import ProductFile
from photoplan.io.store import versions
from photoplan.plan.footprint import Tile, Tiles

SIDE, TILES = 128, 1000
NOTHING = Made((None,), {"worst_residual": 0.0, "cells": 1})


def nothing(tile: Tile) -> Made:
    """A tile without pixels."""
    return NOTHING


def picture(tile: Tile) -> Made:
    """A tile of 3 bands of zeros that are valid: 49 kB."""
    return Made(((np.zeros((3, SIDE, SIDE), np.uint8), None),), {"worst_residual": 0.0, "cells": 1})


@contextmanager
def clock(name: str, count: int) -> Iterator[None]:
    """Print what a tile took."""
    before, began = os.times(), time.perf_counter()
    yield
    after, took = os.times(), time.perf_counter() - began
    cpu = sum(after[:4]) - sum(before[:4])
    print(f"{name:<28} {1000 * cpu / count:7.3f} CPU ms   {1000 * took / count:7.3f} ms per tile")


def make(name: str, job: object, workers: Workers, folder: Path, count: int = TILES) -> None:
    """Run a product of so many tiles."""
    across = round(count**0.5)
    grid = MapGrid(0.0, 0.0, 1.0, SIDE * across, SIDE * across, "EPSG:32633")
    path = folder / f"{name.replace(' ', '_')}.tif"
    file = ProductFile(path, grid.placement, 3, np.dtype(np.uint8), run_key=name, nodata="mask", tile=SIDE)
    tiles = Tiles.every(grid.window, SIDE)
    work = Work(
        name=name, job=job, tiles=tiles, count=len(tiles), sinks=(file,), complete=len_of, scratch=folder / ".parcels"
    )
    with clock(name, len(tiles)):
        Runner(workers, 2 * workers.threads, SILENT).run([work])


def len_of(tally: Tally) -> int:
    """Nothing is assembled here: only tiles are looked at."""
    return len(tally.failed)


def main() -> None:
    """All rows."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for count in (1, 2):
            with Workers(executor_factory("threads", count), count) as workers:
                make(f"{count} threads, nothing", nothing, workers, folder)
                make(f"{count} threads, 49 kB", picture, workers, folder)
        try:
            from distributed import LocalCluster  # noqa: PLC0415  (an optional package)
        except ImportError:
            print("no cluster: Dask is not installed")
            return
        with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None, protocol="tcp") as cluster:
            question = Question(versions, (), str(folder))
            with open_workers(cluster.scheduler_address, 1, question, SILENT) as workers:
                make("cluster, nothing", nothing, workers, folder)
                make("cluster, 49 kB", picture, workers, folder)


if __name__ == "__main__":
    main()

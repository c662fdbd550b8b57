"""What must hold for every product that is made by tiles: the same bytes, nothing half-made, nothing made twice."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.events import Told
from tools.small_block import Block, texture, write_image

from photoplan.engine import run as engine_run
from photoplan.engine.run import Work
from photoplan.errors import ResourceError, RunLocked
from photoplan.events import Events
from photoplan.io.lock import FileLock
from photoplan.io.product import ProductFile
from photoplan.io.project.file import load_project
from photoplan.products.dtm.shading import PictureRequest, make_picture, shade_picture
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.plan import plan_orthophotos
from photoplan.products.restore.request import RestoreRequest
from photoplan.products.restore.run import restore_images
from photoplan.quality.restoration.filters import FilterKernel, RestorationFilter
from photoplan.terrain.shading.run import Light

Make = Callable[[Path, int, Events], Path]


def ortho(block: Block, scratch: Path) -> Make:
    """Six tiles."""
    plan = plan_orthophotos(load_project(block.project), ["one"], resolution=1.0, tile=128)

    def make(folder: Path, workers: int, events: Events) -> Path:
        return execute(plan, folder, Run(workers, quicklook=False, events=events))[0].path

    return make


def restored(block: Block, scratch: Path) -> Make:
    """Four tiles."""
    pixels = np.tile(texture(bands=1), (1, 5, 4))[:, :700, :700]
    image = write_image(scratch / "scan.tif", np.ascontiguousarray(pixels), tiled=True)
    sharper = RestorationFilter((FilterKernel(np.array([[0.0, -0.1, 0.0], [-0.1, 1.4, -0.1], [0.0, -0.1, 0.0]])),))

    def make(folder: Path, workers: int, events: Events) -> Path:
        request = RestoreRequest((image,), sharper, folder, workers=workers, quicklook=False)
        report = restore_images(request, events)
        assert not report.failed, report.failed
        return report.images[0].path

    return make


def hillshade(block: Block, scratch: Path) -> Make:
    """A terrain raster; some tiles of 512."""

    def make(folder: Path, workers: int, events: Events) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        request = PictureRequest(block.terrain, folder / "shade.tif", resolution=0.7, workers=workers)
        return make_picture(request, shade_picture(Light()), events).path

    return make


@pytest.fixture(scope="module", params=[ortho, restored, hillshade], ids=lambda made: made.__name__)
def make(request: pytest.FixtureRequest, pristine: Block, tmp_path_factory: pytest.TempPathFactory) -> Make:
    return request.param(pristine, tmp_path_factory.mktemp("inputs"))


@pytest.fixture(scope="module")
def serial(make: Make, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return make(tmp_path_factory.mktemp("serial"), 1, Told()).read_bytes()


@pytest.mark.parametrize("workers", [2, 8])
def test_fault_26_any_number_of_workers(make: Make, serial: bytes, tmp_path: Path, workers: int) -> None:
    assert make(tmp_path, workers, Told()).read_bytes() == serial


def test_fault_26_any_order(make: Make, serial: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_tiles = engine_run.run_tiles

    def shuffled(tasks: Any, *rest: Any) -> Iterator[Any]:
        tasks = list(tasks)
        random.Random(1).shuffle(tasks)
        return run_tiles(tasks, *rest)

    monkeypatch.setattr(engine_run, "run_tiles", shuffled)
    assert make(tmp_path, 2, Told()).read_bytes() == serial


def counted(monkeypatch: pytest.MonkeyPatch, fails: Callable[[int], bool] = lambda tile: False) -> list[int]:
    """Tiles that are computed from now on; some fail when they are tried first."""
    computed: list[int] = []
    compute = engine_run.Runner._compute

    def computing(self: Any, work: Work[Any]) -> Any:
        def watched(tile: Any) -> Any:
            computed.append(tile.index)
            if computed.count(tile.index) == 1 and fails(tile.index):
                raise RuntimeError("the drive is gone for a moment")
            return work.job(tile)

        return compute(self, replace(work, job=watched))

    monkeypatch.setattr(engine_run.Runner, "_compute", computing)
    return computed


def test_fault_04_a_full_disk_costs_no_finished_tile(
    make: Make, serial: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing has the product's name, finished tiles are kept, and the next run makes the others alone."""
    with monkeypatch.context() as patch:
        append, left = ProductFile.append, iter(range(1))

        def ends(self: ProductFile, *arguments: Any) -> None:
            if next(left, None) is None:
                raise ResourceError("the disk is full")
            append(self, *arguments)

        patch.setattr(ProductFile, "append", ends)
        before = counted(patch)
        with pytest.raises(ResourceError):
            make(tmp_path, 1, Told())
    assert not list(tmp_path.glob("*.tif"))
    told = Told()
    again = counted(monkeypatch)
    path = make(tmp_path, 1, told)
    assert path.read_bytes() == serial
    assert len(before) == 2 and set(before) & set(again) == {before[1]}
    assert any(f"{path.stem}: 1 of {len(again) + 1} tiles are finished already" in line for line in told.talked)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_fault_05_a_tile_that_fails_for_a_moment_is_tried_again(
    make: Make, serial: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed = counted(monkeypatch, lambda tile: tile == 1)
    assert make(tmp_path, 2, Told()).read_bytes() == serial
    assert computed.count(1) == 2


def test_fault_26_a_second_run_is_refused(make: Make, serial: bytes, tmp_path: Path) -> None:
    path = make(tmp_path / "first", 1, Told())
    (tmp_path / "second").mkdir()
    with FileLock(tmp_path / "second" / f".{path.name}.lock"), pytest.raises(RunLocked):
        make(tmp_path / "second", 1, Told())


def test_every_phase_is_told(make: Make, serial: bytes, tmp_path: Path) -> None:
    told = Told()
    make(tmp_path, 1, told)
    phase, units, unit = told.phases[-1]
    assert unit == "tiles" and told.units[phase] == units > 1
    assert told.pixels > 0

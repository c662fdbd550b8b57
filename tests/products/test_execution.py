"""Executing a plan: the same bytes by whatever workers and in whatever order; what is kept, told and recorded."""

from __future__ import annotations

import json
import shutil
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.events import Told
from tools.small_block import CRS, NAMES, SIZE, X0, Y0, Block, make_project, texture, write_image
from tools.town import write_town

from photoplan.engine import execute as engine_execute
from photoplan.engine.executors import threads
from photoplan.errors import InputError, ResourceError, TilesFailed, UsageError
from photoplan.io.product import ProductFile
from photoplan.io.project.file import load_project
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.mosaic import plan_mosaic
from photoplan.products.orthophoto.plan import OrthoPlan, plan_orthophotos
from photoplan.products.run import BASE_MEMORY
from photoplan.project import scene
from photoplan.project.scene import open_scene

QUIET = Run(quicklook=False)


@pytest.fixture(scope="module")
def plan(pristine: Block) -> OrthoPlan:
    """Twenty tiles of three images."""
    return plan_orthophotos(load_project(pristine.project), resolution=1.0, tile=128)


@pytest.fixture(scope="module")
def serial(plan: OrthoPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Its products, made one tile after the other."""
    folder = tmp_path_factory.mktemp("serial")
    execute(plan, folder, QUIET)
    return products(folder)


def products(folder: Path) -> dict[str, bytes]:
    return {name: (folder / f"{name}_ortho.tif").read_bytes() for name in NAMES}


class TestFault26Equality:
    def test_fault_26_a_dask_cluster(self, plan: OrthoPlan, serial: dict[str, bytes], tmp_path: Path) -> None:
        distributed = pytest.importorskip("distributed")
        with distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp"
        ) as cluster:
            execute(plan, tmp_path, Run(2, cluster.scheduler_address, quicklook=False))
        assert products(tmp_path) == serial

    @pytest.mark.slow
    def test_fault_26_a_mosaic_with_objects_on_a_dask_cluster(self, pristine: Block, tmp_path: Path) -> None:
        distributed = pytest.importorskip("distributed")
        made = []
        town = write_town(shutil.copytree(pristine.folder, tmp_path / "block") / "project.toml", (X0, Y0), 100.0, CRS)
        plan = plan_mosaic(
            load_project(town), resolution=1.0, tile=128, bounds=(500_200, 5_300_100, 500_520, 5_300_300)
        )
        with distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp"
        ) as cluster:
            for executor, workers in (("threads", 1), (cluster.scheduler_address, 2)):
                execute(plan, tmp_path / str(workers), Run(workers, executor, quicklook=False))
                made.append((tmp_path / str(workers) / "mosaic.tif").read_bytes())
        assert made[0] == made[1]

    def test_fault_26_memory_does_not_change_a_byte(
        self, plan: OrthoPlan, serial: dict[str, bytes], tmp_path: Path
    ) -> None:
        execute(plan, tmp_path, Run(4, memory=500 * 2**20, quicklook=False))
        assert products(tmp_path) == serial


class TestContinuing:
    @staticmethod
    def broken_after(monkeypatch: pytest.MonkeyPatch, tiles: int) -> None:
        """The disk ends after some tiles."""
        append = ProductFile.append
        left = iter(range(tiles))

        def ends(self: ProductFile, *args: Any) -> None:
            if next(left, None) is None:
                raise ResourceError("the disk is full")
            append(self, *args)

        monkeypatch.setattr(ProductFile, "append", ends)

    def test_fault_04_finished_tiles_are_taken_over(
        self, plan: OrthoPlan, serial: dict[str, bytes], tmp_path: Path
    ) -> None:
        with pytest.MonkeyPatch.context() as patch:
            self.broken_after(patch, 4)
            with pytest.raises(ResourceError):
                execute(plan, tmp_path, QUIET)
        told = Told()
        results = execute(plan, tmp_path, Run(2, quicklook=False, events=told))
        assert [r.resumed for r in results] == [4, 0, 0]
        assert "one_ortho: 4 of 6 tiles are finished already" in told.talked
        assert told.units["tiles"] == sum(len(p.plan.tiles) for p in plan.products)
        assert products(tmp_path) == serial
        # Figures of tiles that were taken over are in the record as well.
        assert results[0].cells >= 6

    def test_other_settings_of_the_file_take_over_tiles_and_those_of_pixels_do_not(
        self, plan: OrthoPlan, pristine: Block, tmp_path: Path
    ) -> None:
        with pytest.MonkeyPatch.context() as patch:
            self.broken_after(patch, 4)
            with pytest.raises(ResourceError):
                execute(plan, tmp_path, QUIET)
        project = load_project(pristine.project)
        lzw = plan_orthophotos(project, ["one"], resolution=1.0, tile=128, compress="lzw")
        assert execute(lzw, tmp_path, QUIET)[0].resumed == 4
        with rasterio.open(tmp_path / "one_ortho.tif") as file:
            assert file.compression.value == "LZW"
        (tmp_path / "one_ortho.tif").unlink()
        with pytest.MonkeyPatch.context() as patch:
            self.broken_after(patch, 4)
            with pytest.raises(ResourceError):
                execute(plan, tmp_path, QUIET)
        nearest = plan_orthophotos(project, ["one"], resolution=1.0, tile=128, kernel="nearest")
        assert execute(nearest, tmp_path, QUIET)[0].resumed == 0

    def test_products_of_the_interrupted_run_are_kept_and_reported(
        self, plan: OrthoPlan, serial: dict[str, bytes], tmp_path: Path
    ) -> None:
        with pytest.MonkeyPatch.context() as patch:
            self.broken_after(patch, 8)
            with pytest.raises(ResourceError):
                execute(plan, tmp_path, QUIET)
        first = (tmp_path / "one_ortho.tif").stat()
        told = Told()
        results = execute(plan, tmp_path, Run(quicklook=False, events=told))
        assert told.results == results
        assert results[0].resumed == results[0].tiles
        assert (tmp_path / "one_ortho.tif").stat().st_mtime_ns == first.st_mtime_ns
        assert products(tmp_path) == serial

    def test_a_product_of_other_settings_is_not_kept(self, plan: OrthoPlan, pristine: Block, tmp_path: Path) -> None:
        """Nor one whose record is gone or says something else: it is refused, not replaced."""
        other = plan_orthophotos(load_project(pristine.project), ["one"], resolution=1.0, tile=128, kernel="nearest")
        execute(other, tmp_path, QUIET)
        for change in ("settings", "gone", "damaged"):
            if change == "gone":
                (tmp_path / "one_ortho.run.json").unlink()
            elif change == "damaged":
                (tmp_path / "one_ortho.run.json").write_text("{}")
            with pytest.raises(UsageError, match=r"one_ortho\.tif exists; give `overwrite`"):
                execute(plan, tmp_path, QUIET)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["one_ortho.run.json", "one_ortho.tif"]


def test_fault_05_failed_tiles_cost_their_product_only(
    plan: OrthoPlan, serial: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render = engine_execute.render

    def failing(product: Any, tile: Any, *rest: Any) -> Any:
        if product.sources == ("three",) and tile.index in (2, 5):
            raise RuntimeError("out of luck")
        return render(product, tile, *rest)

    monkeypatch.setattr(engine_execute, "render", failing)
    told = Told()
    with pytest.raises(TilesFailed) as error:
        execute(plan, tmp_path, Run(2, events=told))
    assert error.value.exit_code == 4
    assert "three_ortho.tif: tiles 2, 5 (tile " in str(error.value)
    assert "RuntimeError: out of luck" in str(error.value)
    assert [r.failed for r in told.results] == [(), (2, 5), ()]
    assert not (tmp_path / "three_ortho.tif").exists()
    assert not (tmp_path / "three_ortho.run.json").exists()
    assert (tmp_path / "ortho_overview.png").exists()
    monkeypatch.undo()
    results = execute(plan, tmp_path, QUIET)
    assert results[1].resumed == len(plan["three"].plan.tiles) - 2
    assert products(tmp_path) == serial


def test_fault_05_failed_tiles_of_a_mosaic_with_objects(
    pristine: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render = engine_execute.render

    def failing(product: Any, tile: Any, *rest: Any) -> Any:
        if tile.index == 3:
            raise RuntimeError("out of luck")
        return render(product, tile, *rest)

    town = write_town(shutil.copytree(pristine.folder, tmp_path / "block") / "project.toml", (X0, Y0), 100.0, CRS)
    plan = plan_mosaic(load_project(town), resolution=1.0, tile=128, sources=True)
    monkeypatch.setattr(engine_execute, "render", failing)
    with pytest.raises(TilesFailed, match=r"mosaic\.tif: tiles 3 \(tile 3") as error:
        execute(plan, tmp_path, Run(2, quicklook=False))
    assert error.value.exit_code == 4
    assert not list(tmp_path.glob("mosaic*"))
    monkeypatch.undo()
    (made,) = execute(plan, tmp_path, QUIET)
    assert made.resumed == len(plan.products[0].plan.tiles) - 1


def test_an_input_that_changes_after_planning_is_refused(small: Block) -> None:
    """Whoever opens a scene by the address that was planned with, in this process or in a worker's, finds out."""
    address = open_scene(load_project(small.project), "one").address
    assert address.open().reader.size == SIZE
    write_image(small.images[0], 255 - texture())
    scene._open.cache_clear()
    with pytest.raises(InputError, match=r"one\.tif: has changed since the run was planned; plan it again"):
        address.open()


class TestFault06Memory:
    @pytest.mark.parametrize(("workers", "most"), [(1, 1), (2, 4), (8, 16)])
    def test_tiles_in_flight(self, workers: int, most: int) -> None:
        assert Run().in_flight(threads(workers)) == most
        assert Run(memory=10**12).in_flight(threads(workers)) == most

    def test_less_memory_means_fewer_tiles(self) -> None:
        counts = [Run(memory=m * 2**20).in_flight(threads(8)) for m in (500, 700, 1000, 2000)]
        assert counts == sorted(counts)
        assert counts[0] == 1
        assert counts[-1] > 8

    def test_too_little_memory_is_refused_before_any_work(self, plan: OrthoPlan, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="`memory` 320 MiB; at least 464 MiB are needed"):
            execute(plan, tmp_path / "out", Run(memory=BASE_MEMORY))
        assert not (tmp_path / "out").exists()


def test_the_record_answers_for_the_product(plan: OrthoPlan, pristine: Block, tmp_path: Path) -> None:
    execute(plan, tmp_path, Run(2, quicklook=False))
    record = json.loads((tmp_path / "one_ortho.run.json").read_text())
    assert {Path(i["path"]).name for i in record["inputs"]} == {"one.tif", "dem.tif"}
    assert all(i["size"] == (tmp_path / i["path"]).stat().st_size for i in record["inputs"])
    assert record["settings"]["kernel"] == "bicubic"
    assert record["grid"]["crs"] == CRS
    assert record["heights"] == {"terrain": "same", "orientation": "same", "working": "same"}
    assert record["images"][0]["projection_centre"] == [500300.0, 5300200.0, 400.0]
    run = record["run"]
    assert (run["workers"], run["executor"], run["memory"]) == (2, "threads", None)
    started, finished = (datetime.fromisoformat(run[name]) for name in ("started", "finished"))
    assert started <= finished
    assert run["seconds"] == record["product"]["seconds"]
    assert record["product"]["tiles"] == len(plan["one"].plan.tiles)
    assert record["versions"]["photoplan"]
    assert record["peak_memory_bytes"] > 50 * 2**20
    with rasterio.open(tmp_path / "one_ortho.tif") as file:
        tags = file.tags()
        assert file.bounds == pytest.approx(record["grid"]["bounds"])
        assert record["product"]["valid_share"] == pytest.approx((file.dataset_mask() > 0).mean(), abs=1e-6)
    assert (tags["PHOTOPLAN_IMAGE"], tags["PHOTOPLAN_KEY"]) == ("one", record["key"])
    # What the record says of the project is enough to make the product again.
    assert record["project"]["images"][0]["angles"] == [0.8, -1.2, 3.0]


def test_kinds_of_storage(small: Block, tmp_path: Path) -> None:
    """Compression, mask and overviews as asked; pixels are the same wherever the storage is exact."""
    write_image(small.images[0], texture(bands=3))
    make_project(small)
    project = load_project(small.project)
    pixels = {}
    for name, settings in {
        "deflate": {},
        "zstd": {"compress": "zstd"},
        "none": {"compress": "none", "overviews": False},
        "mask": {"nodata": "mask"},
        "jpeg": {"compress": "jpeg"},
        "seven": {"nodata": "7"},
    }.items():
        plan = plan_orthophotos(project, ["one"], resolution=0.5, tile=256, **settings)  # type: ignore[arg-type]
        path = execute(plan, tmp_path / name, QUIET)[0].path
        with rasterio.open(path) as file:
            pixels[name] = np.where(file.dataset_mask() > 0, file.read(), 0)
            assert bool(file.overviews(1)) == (name != "none")
            assert file.nodata == {"mask": None, "jpeg": None, "seven": 7.0}.get(name, 0.0)
            assert (
                file.compression is None
                if name == "none"
                else file.compression.value.lower() == settings.get("compress", "deflate")
            )
    for name in ("zstd", "none", "mask", "seven"):
        np.testing.assert_array_equal(pixels[name], pixels["deflate"])
    assert 0 < np.abs(pixels["jpeg"].astype(int) - pixels["deflate"]).mean() < 3

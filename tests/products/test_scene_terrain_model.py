"""A terrain model in a project takes the place of a GeoTIFF: where it holds the same, products are the same."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import edit
from tools.small_block import CRS, DEM_STEP, Block
from tools.small_model import grid_unit, write_units_of

from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.project.file import load_project
from photoplan.io.terrain.model import ModelReader
from photoplan.products.check import check_project
from photoplan.products.init import InitRequest, init_project
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.plan import plan_orthophotos
from photoplan.project.ground import ground_of
from photoplan.project.scene import open_scene
from photoplan.surfaces.units import Unit, UnitLayout
from photoplan.targets.map import MapTarget

MESHES = 9
"""Seven by six units of nine meshes hold 64 × 55 posts of the block's 64 × 60."""


def model_of(dem: Path, path: Path, crs: str = CRS, **header: object) -> ModelReader:
    """The posts of a height raster as computing units, bit by bit."""
    with rasterio.open(dem) as file:
        heights = file.read(1)
        x0, y0 = file.xy(0, 0)
    rows, columns = ((n - 1) // MESHES for n in heights.shape)
    layout = UnitLayout(x0, y0, MESHES * DEM_STEP, columns, rows)

    def unit(column: int, row: int) -> Unit:
        part = heights[row * MESHES :, column * MESHES :][: MESHES + 1, : MESHES + 1]
        return Unit(*layout.corner(column, row), layout.side, part.copy(), np.full(part.shape, 0.1, np.float32))

    return write_units_of(path, layout, unit, crs, **header)  # type: ignore[arg-type]


def ortho(block: Block, folder: Path, workers: int = 2, executor: str = "threads") -> np.ndarray:
    project = load_project(block.project)
    # Inside the units: a raster goes on for half a mesh beyond its outer posts.
    plan = plan_orthophotos(project, ["one"], resolution=1.0, tile=128, bounds=(500_180, 5_300_090, 500_420, 5_300_310))
    (result,) = execute(plan, folder, Run(workers=workers, executor=executor, quicklook=False))
    with rasterio.open(result.path) as file:
        return file.read()


@pytest.mark.parametrize("executor", ["threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_same_orthophoto_as_from_the_raster(pristine: Block, small: Block, tmp_path: Path, executor: str) -> None:
    raster = ortho(pristine, tmp_path / "raster")
    model_of(small.terrain, small.folder / "model.gpkg")
    edit(small.project, "dem.tif", "model.gpkg")
    model = ortho(small, tmp_path / "model", executor=executor)
    assert raster.any()
    assert np.array_equal(raster, model)


def test_another_model_is_another_orthophoto(small: Block, tmp_path: Path) -> None:
    """The surface is really taken from the model: raised by 20 m it gives other pixels."""
    before = ortho(small, tmp_path / "before")
    with rasterio.open(small.terrain, "r+") as file:
        file.write(file.read() + np.float32(20))
    model_of(small.terrain, small.folder / "model.gpkg")
    edit(small.project, "dem.tif", "model.gpkg")
    assert not np.array_equal(before, ortho(small, tmp_path / "after"))


def test_the_run_record_names_the_model(small: Block, tmp_path: Path) -> None:
    model_of(small.terrain, small.folder / "model.gpkg")
    edit(small.project, "dem.tif", "model.gpkg")
    ortho(small, tmp_path / "out")
    record = next((tmp_path / "out").glob("*.run.json")).read_text()
    assert "model.gpkg" in record


def test_check_takes_a_model(small: Block) -> None:
    reader = model_of(small.terrain, small.folder / "model.gpkg")
    edit(small.project, "dem.tif", "model.gpkg")
    report = check_project(load_project(small.project))
    assert all(image.on_terrain > 0.9 for image in report.images)
    assert ground_of(load_project(small.project)).bounds == reader.layout.bounds


def test_a_model_in_another_crs(small: Block) -> None:
    """Terrain of UTM zone 32 under a project of zone 33: a plane there is met wherever a point of zone 33 lies."""
    step = crs_step("EPSG:32633", "EPSG:32632")
    x0, y0 = np.floor(step(np.array([500_300.0, 5_300_200.0])))
    layout = UnitLayout(x0 - 1000, y0 + 1000, 100.0, 20, 20)

    def plane(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
        return 100 + 0.01 * (X - x0) - 0.02 * (Y - y0)

    path = small.folder / "model.gpkg"
    write_units_of(path, layout, lambda c, r: grid_unit(layout, c, r, 4, plane, 100.0), "EPSG:32632")
    edit(small.project, "dem.tif", "model.gpkg")
    ground = ground_of(load_project(small.project))
    assert ground.file == path.resolve()
    assert [step.source for step in ground.operations] == ["EPSG:32633"]
    XY = np.array([500_300.0, 5_300_200.0]) + np.random.default_rng(1).uniform(-300, 300, (50, 2))
    assert ground.surface.heights(XY) == pytest.approx(plane(*step(XY).T), abs=1e-5)
    relief = ground.surface.relief(MapTarget(MapGrid.covering((500_290, 5_300_190, 500_310, 5_300_210), 1.0, CRS)),
                                   Window(0, 0, 20, 20))  # fmt: skip
    X, Y = np.meshgrid(500_290.5 + np.arange(20), 5_300_209.5 - np.arange(20))
    assert relief == pytest.approx(plane(*np.moveaxis(step(np.stack([X, Y], axis=-1)), -1, 0)), abs=1e-3)


def test_init_takes_a_model(small: Block) -> None:
    """CRS and height system come from the model's header; the project it writes can be opened."""
    model_of(small.terrain, small.folder / "model.gpkg", height_system="EPSG:5773")
    request = InitRequest(
        folder=small.folder,
        images=(str(small.folder / "images" / "*"),),
        camera=small.camera,
        orientation=small.orientation,
        terrain=str(small.folder / "model.gpkg"),
        crs=CRS,
        orientation_height_system="EPSG:5773",
        overwrite=True,
    )
    path = init_project(request).path
    project = load_project(path)
    assert project.terrain.file == "model.gpkg" and project.terrain.crs is None
    assert ground_of(project).height_systems == ("EPSG:5773", "EPSG:5773")


def test_other_processes_read_units_themselves(small: Block, tmp_path: Path) -> None:
    """A scene's address is opened from its text alone, as in another process, and gives the same heights."""
    model_of(small.terrain, small.folder / "model.gpkg")
    edit(small.project, "dem.tif", "model.gpkg")
    scene = open_scene(load_project(small.project), "one")
    XY = np.array([[500_300.0, 5_300_200.0]])
    here = scene.surface.heights(XY)
    command = "import pickle, sys; a, XY = pickle.load(sys.stdin.buffer); print(float(a.open().surface.heights(XY)[0]))"
    done = subprocess.run(
        [sys.executable, "-c", command], input=pickle.dumps((scene.address, XY)), capture_output=True, check=True
    )
    assert float(done.stdout) == here[0]
    (small.folder / "model.gpkg").unlink()
    model_of(small.terrain, small.folder / "model.gpkg", family="another")
    done = subprocess.run(
        [sys.executable, "-c", command], input=pickle.dumps((scene.address, XY)), capture_output=True, check=False
    )
    assert b"has changed since the run was planned" in done.stderr


class TestFault02HeightSystems:
    def test_fault_02_not_declared(self, small: Block) -> None:
        model_of(small.terrain, small.folder / "model.gpkg")
        edit(small.project, "dem.tif", "model.gpkg")
        text = small.project.read_text().replace('height_system = "same"', "")
        small.project.write_text(text)
        with pytest.raises(HeightSystemError, match="terrain not stated"):
            ground_of(load_project(small.project))

    def test_fault_02_the_models_own_counts(self, small: Block) -> None:
        """A model that states its heights and an orientation in others are joined exactly, or refused by name."""
        model_of(small.terrain, small.folder / "model.gpkg", height_system="EPSG:5773")
        edit(small.project, "dem.tif", "model.gpkg")
        edit(small.project, 'height_system = "same"\n', "")
        edit(small.project, 'height_system = "same"', 'height_system = "ellipsoidal"')
        try:
            ground = ground_of(load_project(small.project))
        except HeightSystemError as error:
            assert "grid" in str(error)
        else:
            assert any("5773" in str(step) or "EGM96" in str(step) for step in ground.operations)


def test_a_geopackage_that_is_no_model(small: Block) -> None:
    edit(small.project, "dem.tif", "model.gpkg")
    (small.folder / "model.gpkg").write_bytes(b"SQLite format 3\0" + bytes(4000))
    with pytest.raises(InputError, match=r"model\.gpkg: no terrain model of photoplan"):
        ground_of(load_project(small.project))

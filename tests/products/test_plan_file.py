"""Plans as files: executed they give the same bytes, changed inputs are refused, tiles may be taken out."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from tools.command import inside
from tools.small_block import CRS, NAMES, Block, make_project, texture, write_image, write_terrain

import photoplan
from photoplan.errors import InputError, UsageError
from photoplan.io.project.file import load_project
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.plan import OrthoPlan, plan_orthophotos
from photoplan.products.orthophoto.plan_file import compile_figures, read_plan, write_plan

QUIET = Run(quicklook=False)
SETTINGS = {"resolution": 1.0, "tile": 128, "kernel": "lanczos3", "tolerance": 0.01}


@pytest.fixture
def planned(small: Block) -> tuple[Path, OrthoPlan]:
    """The block's plan, and the file that it was written to."""
    plan = plan_orthophotos(load_project(small.project), **SETTINGS)  # type: ignore[arg-type]
    path = small.folder / "plans" / "p.gpkg"
    write_plan(path, plan, compile_figures(plan), small.folder / "products")
    return path, plan


def products(folder: Path) -> dict[str, bytes]:
    return {name: (folder / f"{name}_ortho.tif").read_bytes() for name in NAMES}


def test_a_plan_that_was_written_gives_the_same_bytes(planned: tuple[Path, OrthoPlan], tmp_path: Path) -> None:
    path, plan = planned
    again, folder = read_plan(path)
    assert folder == (path.parent.parent / "products").resolve()
    assert again.settings == plan.settings
    assert [p.key for p in again.products] == [p.key for p in plan.products]
    execute(plan, tmp_path / "direct", QUIET)
    execute(again, folder, QUIET)
    assert products(folder) == products(tmp_path / "direct")


def test_images_whose_border_leaves_the_terrain_run_from_a_plan(tmp_path: Path) -> None:
    """Places of the border without terrain are no numbers, which JSON does not have."""
    demo = Path(photoplan.__file__).parent / "demo_block"
    image = sorted((demo / "images").glob("*.jpg"))[0]
    words = ("--camera", demo / "int.yaml", "--orientation", demo / "ext.csv", "--terrain", demo / "dsm.tif")
    assert inside("init", tmp_path, "--images", image, *words, "--height-system", "same").code == 0
    project, plan = tmp_path / "project.toml", tmp_path / "plan.gpkg"
    assert inside("ortho", project, "--resolution", 2, "--plan", plan).code == 0
    said = inside("run", plan, "-o", tmp_path / "planned")
    assert said.code == 0, said.err
    assert inside("ortho", project, "--resolution", 2, "-o", tmp_path / "direct").code == 0
    name = f"{image.stem}_ortho.tif"
    assert (tmp_path / "planned" / name).read_bytes() == (tmp_path / "direct" / name).read_bytes()


def test_what_was_written_is_what_is_read(planned: tuple[Path, OrthoPlan], monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is planned twice: no scene is opened, no image looked at."""
    path, plan = planned
    from photoplan.products.orthophoto import plan as planning
    from photoplan.project import scene

    for module, name in ((scene, "footprint"), (planning, "covered_tiles"), (scene, "_open")):
        monkeypatch.setattr(module, name, None)
    again, _ = read_plan(path)
    assert (again.settings, again.blind, again.project) == (plan.settings, plan.blind, plan.project)
    for read, wrote in zip(again.products, plan.products, strict=True):
        assert (read.grid, read.gsd, read.key) == (wrote.grid, wrote.gsd, wrote.key)
        assert list(read.plan.tiles) == list(wrote.plan.tiles)
        assert replace(read.plan, tiles=wrote.plan.tiles) == wrote.plan
        for got, want in zip(
            (look.footprint for look in read.looks), (look.footprint for look in wrote.looks), strict=True
        ):
            assert (got.bounds, got.on_surface) == (want.bounds, want.on_surface)
            np.testing.assert_array_equal(got.outline, want.outline)


def test_a_plan_moves_with_its_project(planned: tuple[Path, OrthoPlan], small: Block, tmp_path: Path) -> None:
    """Paths in a plan are relative to it."""
    path, plan = planned
    moved = Path(shutil.move(small.folder, tmp_path / "elsewhere"))
    again, folder = read_plan(moved / "plans" / path.name)
    assert folder == (moved / "products").resolve()
    assert [p.key for p in again.products] == [p.key for p in plan.products]


def test_the_layers_show_what_will_be_done(planned: tuple[Path, OrthoPlan]) -> None:
    """Tile footprints cover the products, figures are those of the compiler, and both layers are in the map's CRS."""
    path, plan = planned
    figures = compile_figures(plan)
    meta, _, geometry, values = pyogrio.raw.read(path, layer="tiles")
    tiles = dict(zip(meta["fields"], values))
    assert meta["crs"] == CRS
    assert len(geometry) == figures.tiles == sum(len(product.plan.tiles) for product in plan.products)
    np.testing.assert_array_equal(tiles["cells"], figures.cells_of_tile)
    np.testing.assert_allclose(tiles["residual_px"], figures.residual_of_tile)
    assert tiles["residual_px"].max() <= 0.01
    bounds = shapely.bounds(shapely.from_wkb(geometry))
    for (xmin, ymin, xmax, ymax), width, height in zip(bounds, tiles["width"], tiles["height"]):
        assert (xmax - xmin, ymax - ymin) == pytest.approx((width, height), abs=1e-6)
    for product in plan.products:
        mine = bounds[tiles["product"] == product.plan.name]
        xmin, ymin, xmax, ymax = product.grid.bounds
        assert mine[:, 0].min() >= xmin - 1e-6 and mine[:, 3].max() <= ymax + 1e-6
        assert mine[:, 1].min() >= ymin - 1e-6 and mine[:, 2].max() <= xmax + 1e-6
    source = np.stack([tiles[f"source_{n}"] for n in ("col", "row", "width", "height")], axis=1)
    assert (source[:, :2] >= 0).all()
    assert (source[:, 0] + source[:, 2] <= 200).all() and (source[:, 1] + source[:, 3] <= 150).all()
    assert pyogrio.read_info(path, layer="footprints")["features"] == 3


@pytest.mark.parametrize("what", ["image", "terrain", "gone"])
def test_a_changed_input_is_refused(planned: tuple[Path, OrthoPlan], small: Block, what: str) -> None:
    path, _ = planned
    image = small.images[NAMES.index("two")]
    if what == "image":
        pixels = texture(seed=1)
        pixels[0, 75, 100] ^= 1
        write_image(image, pixels)
    elif what == "terrain":
        with rasterio.open(small.terrain) as file:
            heights = file.read(1)
        heights[30, 30] += 0.01
        write_terrain(small.terrain, heights)
    else:
        image.unlink()
    with pytest.raises(InputError) as error:
        read_plan(path)
    text = str(error.value)
    if what == "gone":
        assert str(image) in text
    else:
        assert f"{path}: inputs have changed since the plan was written (" in text
        assert ("two" in text, "one" in text) == (True, what == "terrain")
        assert "make the plan again" in text


def test_a_touched_input_is_no_other_one(planned: tuple[Path, OrthoPlan], small: Block) -> None:
    for file in (*small.images, small.terrain):
        file.touch()
    read_plan(planned[0])


def test_the_project_file_is_not_asked_again(planned: tuple[Path, OrthoPlan], small: Block) -> None:
    """A plan is what was looked at, whatever became of the project file."""
    path, plan = planned
    small.project.unlink()
    assert [p.key for p in read_plan(path)[0].products] == [p.key for p in plan.products]


def test_tiles_that_were_taken_out_are_not_made(planned: tuple[Path, OrthoPlan], small: Block, tmp_path: Path) -> None:
    """The rest is what it would have been; a product without tiles is not made; the whole one is another product."""
    path, plan = planned
    with sqlite3.connect(path) as db:
        db.execute("DELETE FROM tiles WHERE product = 'one_ortho' AND tile <> 1")
        db.execute("DELETE FROM tiles WHERE product = 'two_ortho'")
    db.close()
    part, folder = read_plan(path)
    execute(part, folder, QUIET)
    execute(plan, tmp_path / "whole", QUIET)
    with rasterio.open(folder / "one_ortho.tif") as file:
        pixels = file.read()
    with rasterio.open(tmp_path / "whole" / "one_ortho.tif") as file:
        whole = file.read()
    assert pixels.shape == whole.shape
    np.testing.assert_array_equal(pixels[:, :128, 128:256], whole[:, :128, 128:256])
    assert pixels[:, :128, 128:256].any()
    rest = pixels.copy()
    rest[:, :128, 128:256] = 0
    assert not rest.any()
    assert part["one"].key != plan["one"].key
    assert (folder / "three_ortho.tif").read_bytes() == (tmp_path / "whole" / "three_ortho.tif").read_bytes()
    assert not (folder / "two_ortho.tif").exists()


@pytest.mark.parametrize("damage", ["header", "format", "key", "settings", "layer", "tiles"])
def test_a_damaged_plan_is_refused(planned: tuple[Path, OrthoPlan], damage: str) -> None:
    path, _ = planned
    with sqlite3.connect(path) as db:
        if damage == "header":
            db.execute("UPDATE photoplan_plan SET content = '{'")
        elif damage == "format":
            db.execute("UPDATE photoplan_plan SET format = 99")
        elif damage == "key":
            db.execute('UPDATE photoplan_plan SET content = replace(content, \'"key": "\', \'"key": "0\')')
        elif damage == "settings":
            db.execute("UPDATE photoplan_plan SET content = replace(content, '\"lanczos3\"', '17')")
        elif damage == "tiles":
            db.execute("DELETE FROM tiles")
        else:
            db.execute("ALTER TABLE tiles RENAME COLUMN tile TO tail")
    db.close()
    with pytest.raises(InputError) as error:
        read_plan(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "make" in str(error.value)


def test_fault_13_a_plan_exists(planned: tuple[Path, OrthoPlan]) -> None:
    path, plan = planned
    figures = compile_figures(plan)
    before = path.read_bytes()
    with pytest.raises(UsageError, match=r"p\.gpkg.*`overwrite`"):
        write_plan(path, plan, figures, path.parent)
    assert path.read_bytes() == before
    write_plan(path, plan, figures, path.parent, overwrite=True)
    assert read_plan(path)[1] == path.parent.resolve()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_changed_setting_makes_another_plan(small: Block, planned: tuple[Path, OrthoPlan]) -> None:
    """An orientation that was corrected in the project makes new keys, so that no old tile is taken over."""
    _, plan = planned
    small.orientation.write_text(small.orientation.read_text().replace("400.000000", "400.001000"))
    make_project(small)
    again = plan_orthophotos(load_project(small.project), **SETTINGS)  # type: ignore[arg-type]
    assert not {p.key for p in again.products} & {p.key for p in plan.products}


def changed(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    with closing(sqlite3.connect(path)) as db, db:
        header = json.loads(db.execute("SELECT content FROM photoplan_plan").fetchone()[0])
        change(header)
        db.execute("UPDATE photoplan_plan SET content = ?", (json.dumps(header),))
        db.execute("DROP TRIGGER IF EXISTS x")


@pytest.mark.parametrize(
    "name", ["../../evil", "/tmp/evil", "a/b", "..", "..\\evil", ".hidden", "CON", "a\nb", "", 7, None]
)
def test_fault_11_a_name_inside_a_plan_leads_nowhere(
    planned: tuple[Path, OrthoPlan], tmp_path: Path, name: Any
) -> None:
    path, _ = planned
    before = {*tmp_path.rglob("*"), *path.parent.parent.rglob("*")}

    def change(header: dict[str, Any]) -> None:
        header["products"][0]["name"] = name

    changed(path, change)
    with pytest.raises(InputError):
        read_plan(path)
    ran = inside("run", path, "-o", tmp_path / "out" / "deep")
    assert ran.code == 3, ran.err
    assert {*tmp_path.rglob("*"), *path.parent.parent.rglob("*")} == before


def test_fault_11_two_products_of_one_name_are_refused(planned: tuple[Path, OrthoPlan]) -> None:
    def change(header: dict[str, Any]) -> None:
        header["products"][0]["name"] = header["products"][1]["name"].upper()

    changed(planned[0], change)
    with pytest.raises(InputError, match="two products would write the same file"):
        read_plan(planned[0])


@pytest.mark.parametrize("output", ["../../elsewhere", "/tmp/elsewhere", "../..", "linked", "\0"])
def test_fault_11_a_plan_does_not_choose_a_folder_outside(planned: tuple[Path, OrthoPlan], output: str) -> None:
    path, _ = planned
    (path.parent / "linked").symlink_to(path.parents[2])
    changed(path, lambda header: header.update(output=output))
    assert read_plan(path)[1] is None
    ran = inside("run", path)
    assert ran.code == 2 and "outside its own folder; give --output" in ran.err, ran.err

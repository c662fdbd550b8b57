"""Images with rational polynomials through a project: found, checked, rectified, put together."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import RPCTransformer
from rasterio.warp import Resampling, reproject
from rasterio.warp import transform as warp
from tools.command import Here
from tools.rpc_files import as_text, tagged
from tools.rpc_images import CRS, camera, functions

from photoplan.cameras.rpc import RationalFunctions, RpcCamera
from photoplan.errors import InputError
from photoplan.geometry.grid import MapGrid
from photoplan.io.camera.satellite import read_rpc
from photoplan.io.project.file import load_project
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.plan.anchors import AnchorRule, compile_anchors
from photoplan.plan.ground import TileGround
from photoplan.products.orthophoto.plan import plan_orthophotos, render
from photoplan.targets.map import MapTarget

SIZE = (150, 220)


def small(seed: int = 0) -> RationalFunctions:
    """Polynomials of an image of 100 m pixels, with the smoothness of real ones."""
    full = functions(seed)
    coefficients = full.coefficients.copy()
    coefficients[:, 4:] *= 0.1
    scale = (full.image_scale[0] / 20, full.image_scale[1] / 20)
    offset = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return replace(full, coefficients=coefficients, image_scale=scale, image_offset=offset)


def pixels(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    return (120 + 60 * np.sin(x / 9) + 60 * np.cos(y / 11) + rng.uniform(0, 9, y.shape)).astype(np.uint8)[None]


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    """The command, called inside this process."""
    return Here(capsys)


@pytest.fixture
def project(tmp_path: Path, photoplan: Here) -> Path:
    """Two images: one holds its polynomials, the other has a file beside it."""
    tagged(tmp_path / "a.tif", small(), pixels(1))
    with rasterio.open(
        tmp_path / "b.tif", "w", driver="GTiff", width=SIZE[0], height=SIZE[1], count=1, dtype="uint8"
    ) as file:
        file.write(pixels(2))
    shifted = small(3)
    (tmp_path / "b_rpc.txt").write_text(as_text(replace(shifted, ground_offset=(16.42, 48.23, 300.0))))
    done = photoplan(
        "init", tmp_path / "p", "--images", tmp_path / "[ab].tif", "--terrain", "250", "--height-system", "same"
    )
    assert done.code == 0, done.err
    assert "2 images with rational polynomials" in done.err
    return tmp_path / "p" / "project.toml"


def test_init_finds_polynomials_by_itself(project: Path) -> None:
    loaded = load_project(project)
    assert loaded.crs == CRS
    assert loaded.cameras == {}
    assert loaded.height_system == "ellipsoidal"
    assert [(i.name, i.geometry_file) for i in loaded.images] == [("a", None), ("b", "../b_rpc.txt")]


def test_an_orthophoto_is_what_gdalwarp_makes(project: Path) -> None:
    plan = plan_orthophotos(load_project(project), ["a"], resolution=100.0, kernel="nearest", tolerance=1e-3)
    mine, valid = render(plan, "a")
    grid = plan["a"].grid
    theirs = np.zeros_like(mine)
    with rasterio.open(project.parent.parent / "a.tif") as image:
        reproject(
            image.read(),
            theirs,
            rpcs=image.rpcs,
            src_crs="EPSG:4326",
            dst_crs=grid.crs,
            dst_transform=grid.placement.affine,
            resampling=Resampling.nearest,
            RPC_HEIGHT=250.0,
            tolerance=0.0,
        )
    assert (valid == (theirs[0] > 0)).mean() > 0.999
    both = valid & (theirs[0] > 0)
    # GDAL interpolates positions, to an eighth of a pixel.
    assert (mine[0] == theirs[0])[both].mean() > 0.95
    assert both.sum() > 0.9 * SIZE[0] * SIZE[1]


def test_mosaic_check_and_info_know_them(project: Path, photoplan: Here) -> None:
    checked = photoplan("check", project)
    assert checked.code == 0
    assert "all plausible" in checked.out
    assert "b_rpc.txt" in photoplan("info", project).out
    done = photoplan("mosaic", project, "--resolution", "100", "--sources")
    assert done.code == 0, done.err
    record = json.loads((project.parent / "products" / "mosaic.run.json").read_text())
    assert [i["projection_centre"] for i in record["images"]] == [None, None]
    with rasterio.open(project.parent / "products" / "mosaic.tif") as mosaic:
        assert (mosaic.read(1) > 0).mean() > 0.5
    again = photoplan("mosaic", project, "--resolution", "100", "--sources")
    assert again.code == 2, "the product is there"


def test_a_point_of_the_image_is_found_on_the_ground(project: Path, photoplan: Here, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("name,x,y\none,20.25,30.5\n")
    done = photoplan("monoplot", project, "a", tmp_path / "points.csv", "-o", tmp_path / "ground.csv")
    assert done.code == 0, done.err
    header, row = ((tmp_path / "ground.csv").read_text().split("\n"))[:2]
    found = dict(zip(header.split(","), row.split(",")))
    truth = replace(camera(SIZE), functions=small()).rays([20.25, 30.5], 250.0)[0]
    assert [float(found[k]) for k in "XYZ"] == pytest.approx(truth.tolist(), abs=1e-3)
    refused = photoplan(
        "monoplot", project, "a", tmp_path / "points.csv", "-o", tmp_path / "g.csv", "--sigma-position", 1, 1, 1
    )
    assert refused.code == 2
    assert "no projection centre" in refused.err


def test_a_shift_of_the_project_moves_the_orthophoto(project: Path) -> None:
    text = project.read_text()
    project.write_text(text.replace('rpc = "tags"', 'rpc = "tags"\nshift = [2.0, -3.0]\ndrift = [0.0, 0.0, 0.0, 0.0]'))
    loaded = load_project(project)
    moved = plan_orthophotos(loaded, ["a"], resolution=100.0, kernel="nearest", tolerance=1e-3)
    same = moved["a"].address(loaded).open()[0].camera
    assert isinstance(same, RpcCamera)
    XYZ = same.rays([50.0, 50.0], 250.0)[0]
    plain = same.functions(same.ground(XYZ))
    assert [50.0, 50.0] - plain == pytest.approx([2.0, -3.0], abs=1e-6)


def test_what_needs_a_pose_says_that_there_is_none(project: Path) -> None:
    with pytest.raises(InputError, match="image 'a' has no pose"):
        load_project(project).image("a")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('rpc = "tags"', 'rpc = "/vsicurl/x"', "virtual file systems"),
        ('rpc = "tags"', 'rpc = "tags"\ncamera = "c"', "camera: unknown entry"),
        ('rpc = "tags"', "rpc = 3", "allowed is"),
        ('rpc = "tags"', 'rpc = "tags"\nshift = [1.0]', "shift"),
    ],
)
def test_wrong_entries_are_named(project: Path, old: str, new: str, told: str) -> None:
    project.write_text(project.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=told):
        load_project(project)


def test_polynomials_are_written_for_others(project: Path, photoplan: Here, tmp_path: Path) -> None:
    """Of an image with polynomials they are these again, over the heights of its terrain."""
    done = photoplan("convert", project, "--to", "rpc", "-o", tmp_path / "rpc")
    assert done.code == 0, done.err
    assert "off by at most" in done.err
    found = read_rpc(tmp_path / "rpc" / "a_RPC.TXT").functions
    seen = replace(camera(SIZE), functions=small())
    xy = np.random.default_rng(5).uniform(0, 1, (100, 2)) * SIZE - 0.5
    geodetic = seen.ground(seen.rays(xy, 250.0)[0])
    assert np.abs(found(geodetic) - xy).max() < 1e-4
    refused = photoplan("convert", project, "--to", "rpc", "-o", tmp_path / "rpc")
    assert refused.code == 2


def test_cells_of_a_tile_stay_few() -> None:
    """Half a metre, a tile of 512 pixels, 400 m of relief: polynomials as smooth as those of Pléiades."""
    rpc = small()
    coefficients = rpc.coefficients.copy()
    coefficients[:, 4:] *= 0.1
    fine = replace(rpc, image_scale=(15e3, 22e3), image_offset=(15e3, 22e3), coefficients=coefficients)
    seen = replace(camera((30000, 44000)), functions=fine)
    x, y = seen.vantage.point[:2]
    grid = MapGrid.covering((x, y, x + 256.0, y + 256.0), 0.5, CRS)
    relief = np.random.default_rng(1).uniform(100, 500, (grid.height, grid.width)).astype(np.float32)
    anchors = compile_anchors(seen, TileGround.of(MapTarget(grid), grid.window, relief), AnchorRule.of("bicubic", 0.02))
    assert anchors is not None
    assert len(anchors.box_heights) <= 8


def test_a_roof_stands_where_it_is(project: Path, photoplan: Here) -> None:
    """Its pixels are where GDAL projects its points, and the ground behind it is hidden."""
    middle = plan_orthophotos(load_project(project), ["a"], resolution=100.0)["a"].grid.bounds
    X, Y = np.round([(middle[0] + middle[2]) / 2, (middle[1] + middle[3]) / 2], -2)
    roof = shapely.box(X - 1500, Y - 1000, X + 1500, Y + 1000)
    shape = shapely.force_3d(roof, 750.0)
    layer = VectorLayer("objects", "Polygon Z", [shape], {"name": np.array(["roof"], object)})
    write_geopackage(project.parent / "roof.gpkg", [layer], CRS)
    project.write_text(project.read_text() + '\n[[objects]]\nfile = "roof.gpkg"\nheight_system = "same"\n')
    # So much ground that the polynomials end within the one tile.
    words = ("--images", "a", "--bounds", X - 19000, Y - 19000, X + 19000, Y + 19000)
    words += ("--resolution", 100, "--kernel", "nearest", "--tolerance", 0.001, "--no-quicklook", "-q")
    made = []
    for folder, way in (("true", ["--true", "--hidden", "nodata"]), ("bare", [])):
        said = photoplan("ortho", project, "-o", project.parent / folder, *words, *way)
        assert said.code == 0, said.err
        with rasterio.open(project.parent / folder / "a_ortho.tif") as file:
            made.append((file.read(1), file.read_masks(1) > 0))
            affine, crs = file.transform, file.crs
    (true, valid), (bare, _) = made
    row, col = np.indices(true.shape)
    x, y = affine @ (col + 0.5, row + 0.5)
    inside = shapely.contains_xy(roof.buffer(-150), x, y)
    lon, lat = warp(crs, "EPSG:4326", x[inside], y[inside])
    with rasterio.open(project.parent.parent / "a.tif") as image, RPCTransformer(image.rpcs) as gdal:
        rows, cols = gdal.rowcol(lon, lat, np.full(len(lon), 750.0), op=np.floor)
        there = image.read(1)[np.asarray(rows, int), np.asarray(cols, int)]
    assert valid[inside].all() and (true[inside] == there).mean() > 0.99
    assert (bare[inside] == there).mean() < 0.5
    outside = ~shapely.contains_xy(roof.buffer(60), x, y)
    hidden = outside & ~valid & made[1][1]
    assert hidden.sum() > 20 and (true == bare)[outside & valid].all()

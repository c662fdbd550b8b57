"""Sheets of a mosaic: together they are the mosaic, and after an edit only those that change are made again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import rasterio.features
import shapely
from tools.command import Here
from tools.small_block import CRS, Block

BOUNDS = (500_200, 5_300_100, 500_520, 5_300_300)
OPTIONS = ("--resolution", 1, "--tile", 128, "--no-quicklook", "--feather", 20)


def regions(path: Path, right: float) -> Path:
    """A region of the third image whose eastern edge can be moved."""
    box = shapely.box(500_330, 5_300_180, right, 5_300_220)
    pyogrio.raw.write(path, shapely.to_wkb(np.array([box])), [np.array(["three"], object)], ["image"],
                      layer="regions", driver="GPKG", geometry_type="Polygon", crs=CRS)  # fmt: skip
    return path


def polygons(path: Path, shapes: dict[str, shapely.Geometry]) -> Path:
    path.unlink(missing_ok=True)
    pyogrio.raw.write(path, shapely.to_wkb(np.array(list(shapes.values()))), [np.array(list(shapes), object)], ["name"],
                      layer="sheets", driver="GPKG", geometry_type="Polygon", crs=CRS)  # fmt: skip
    return path


def states(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("m_*.tif")}


def test_sheets_join_and_follow_edits(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, folder = Here(capsys), small.folder / "products"
    seams = regions(small.folder / "drawn.gpkg", 500_380)
    words = ("mosaic", small.project, *OPTIONS, "--seams", seams)
    whole = photoplan(*words, "--bounds", *BOUNDS)
    assert whole.code == 0, whole.err
    cut = (*words, "--sheets", 100, "--name", "m", "--bounds", *BOUNDS, "--json")
    said = photoplan(*cut)
    assert said.code == 0, said.err
    names = [Path(each["path"]).stem for each in json.loads(said.out)["products"]]
    assert len(names) == 8 and names[0] == "m_500200_5300200" and "in 8 sheets" in said.err
    with rasterio.open(folder / "mosaic.tif") as file:
        wanted, nodata = file.read(), file.nodata
        left, top = file.bounds.left, file.bounds.top
    with rasterio.open(folder / "m.vrt") as file:
        assert (file.count, file.nodata, file.crs.to_string()) == (3, nodata, CRS)
        # Lines are multiples of 100 m whatever the bounds.
        assert (file.bounds.left, file.bounds.right, file.bounds.top) == (500_200, 500_600, 5_300_300)
        window = rasterio.windows.from_bounds(left, BOUNDS[1], BOUNDS[2], top, file.transform)
        apart = np.abs(file.read(window=window).astype(int) - wanted)
    # Tiles lie elsewhere, and with them anchors: hundredths of a pixel.
    assert apart.max() <= 1 and (apart > 0).mean() < 1e-3
    item = json.loads((folder / "m_500300_5300200.stac.json").read_text())
    lon, lat, *_ = item["bbox"]
    assert item["stac_version"] == "1.0.0" and item["properties"]["proj:shape"] == [100, 100]
    assert item["properties"]["proj:epsg"] == 32633 and (round(lon), round(lat)) == (15, 48)
    assert shapely.geometry.shape(item["geometry"]).is_valid and (folder / item["assets"]["data"]["href"]).is_file()
    _edited(photoplan, cut, seams, folder)


def _edited(photoplan: Here, cut: tuple[object, ...], seams: Path, folder: Path) -> None:
    before = states(folder)
    # Nothing is made again by accident, or without need; a lost sheet is.
    assert photoplan(*cut).code == 2 and states(folder) == before
    (folder / "m_500300_5300100.tif").unlink()
    times = {path: path.stat().st_mtime_ns for path in folder.glob("m_*.tif")}
    assert photoplan(*cut).code == 0 and states(folder).keys() == before.keys()
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())
    seams.unlink()
    regions(seams, 500_360)
    said = photoplan(*cut, "--overwrite")
    assert said.code == 0, said.err
    after = states(folder)
    changed = {name for name in before if after[name] != before[name]}
    # The edge moved from 80 to 60 m of this sheet, between 20 m above and 20 m below a line: two sheets.
    assert changed == {"m_500300_5300100.tif", "m_500300_5300200.tif"} and "6 of 8 products are finished" in said.err


def test_sheets_that_cannot_be(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, folder = Here(capsys), small.folder / "products"
    words = ("mosaic", small.project, *OPTIONS, "--bounds", *BOUNDS, "--name", "m", "--sheets")
    for size, told in ((100.5, "whole number"), (-1, "--sheets -1"), (0.0, "--sheets 0"), (1, "more than 10000")):
        said = photoplan(*words, size)
        assert said.code == 2 and told in said.err, said.err
    folder.mkdir(exist_ok=True)
    (folder / "m.vrt").write_text("mine")
    said = photoplan(*words, 200)
    assert said.code == 2 and "m.vrt" in said.err and not list(folder.glob("*.tif"))


def test_drawn_sheets_are_the_mosaic_inside_their_lines(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """A square, a triangle beside it whose box lies over it, and a polygon outside: each on its own, then as one."""
    photoplan, folder = Here(capsys), small.folder / "products"
    seams = regions(small.folder / "drawn.gpkg", 500_355)
    words = ("mosaic", small.project, *OPTIONS, "--seams", seams)
    whole = photoplan(*words, "--bounds", *BOUNDS)
    assert whole.code == 0, whole.err
    shapes = {
        "North 1": shapely.box(500_250, 5_300_180, 500_380, 5_300_280),
        "slope": shapely.Polygon([(500_380, 5_300_280), (500_380, 5_300_120), (500_480.5, 5_300_120.5)]),
        "far": shapely.box(0, 0, 10, 10),
    }
    sheets = polygons(small.folder / "sheets.gpkg", shapes)
    cut = (*words, "--sheets", sheets, "--name", "m", "--json")
    said = photoplan(*cut)
    assert said.code == 0 and "in 2 sheets" in said.err, said.err
    names = [Path(each["path"]).name for each in json.loads(said.out)["products"]]
    assert names == ["m_North 1.tif", "m_slope.tif"] or names == ["m_North_1.tif", "m_slope.tif"]
    with rasterio.open(folder / "mosaic.tif") as file:
        wanted, at = file.read().astype(int), file.transform
    with rasterio.open(folder / "m.vrt") as file:
        inside = rasterio.features.geometry_mask(
            [shapes["North 1"], shapes["slope"]], file.shape, file.transform, invert=True
        )
        row, col = (round(v) for v in ((at.f - file.bounds.top), (file.bounds.left - at.c)))
        same = wanted[:, row : row + file.height, col : col + file.width]
        apart = np.abs(file.read().astype(int) - same)
        assert apart[:, inside].max() <= 1 and (apart[:, inside] > 0).mean() < 1e-3 and inside.mean() > 0.5
        assert not file.read()[:, ~inside].any()
    item = json.loads((folder / "m_slope.stac.json").read_text())
    assert len(item["geometry"]["coordinates"][0]) > 6 and shapely.geometry.shape(item["geometry"]).is_valid
    # An edited seam inside the square alone, then another line of the triangle alone.
    before = states(folder)
    seams.unlink()
    regions(seams, 500_345)
    assert photoplan(*cut, "--overwrite").code == 0
    assert {name for name, each in states(folder).items() if each != before[name]} == {names[0]}
    before = states(folder)
    shapes["slope"] = shapely.Polygon([(500_380, 5_300_280), (500_380, 5_300_120), (500_470.5, 5_300_120.5)])
    polygons(sheets, shapes)
    assert photoplan(*cut, "--overwrite").code == 0
    assert {name for name, each in states(folder).items() if each != before[name]} == {names[1]}


def test_drawn_sheets_of_a_plan_file(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    shape = shapely.Polygon([(500_300, 5_300_280), (500_300, 5_300_180), (500_380.5, 5_300_180.5)])
    sheets = polygons(small.folder / "sheets.gpkg", {"a": shape})
    words = ("mosaic", small.project, *OPTIONS, "--sheets", sheets)
    assert photoplan(*words).code == 0
    sheets_of_plan = small.folder / "plan.gpkg"
    said = photoplan(*words, "--name", "planned", "--plan", sheets_of_plan)
    assert said.code == 0, said.err
    sheets.unlink()
    assert photoplan("run", sheets_of_plan, "--no-quicklook").code == 0
    one, other = (small.folder / "products" / f"{name}_a.tif" for name in ("mosaic", "planned"))
    with rasterio.open(one) as first, rasterio.open(other) as second:
        np.testing.assert_array_equal(first.read(), second.read())


def test_fault_12_drawn_sheets_that_cannot_be(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, box = Here(capsys), shapely.box(500_250, 5_300_180, 500_380, 5_300_280)
    words = ("mosaic", small.project, *OPTIONS, "--sheets")
    for k, (shapes, told) in enumerate((
        ({"a": box, "A": box}, "'a' and 'A' would have one file"),
        ({"a": shapely.box(0, 0, 1, 1)}, "no polygon touches"),
        ({"a": shapely.Polygon([(0, 0), (9, 9), (9, 0), (0, 9)])}, "cross themselves"),
    )):  # fmt: skip
        said = photoplan(*words, polygons(small.folder / f"{k}.gpkg", shapes))
        assert said.code == 3 and told in said.err, said.err
    said = photoplan(*words, small.folder / "none.gpkg")
    assert said.code == 3 and "none.gpkg" in said.err
    assert not list((small.folder / "products").glob("*.tif"))

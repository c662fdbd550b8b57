"""Sheets of a mosaic: together they are the mosaic, and after an edit only those that change are made again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import rasterio
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

"""`photoplan dtm flow` from files to catchments."""

from __future__ import annotations

import json

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from tools.dem_file import X0, Y0, write_dem


@pytest.fixture
def valley(tmp_path):
    """Sides fall to y = 20, the axis to the west, with a pit in it and a hole in the terrain."""

    def height(x, y):
        z = 200 + 5.0 * np.abs(y - 20) + 0.1 * x - 3.0 * ((np.abs(x - 30) < 2) & (y == 20))
        return np.where((x > 50) & (y > 35), np.nan, z)

    return write_dem(tmp_path / "valley.tif", height, (60, 41))


def test_catchments_and_lengths(valley, tmp_path, photoplan):
    table = tmp_path / "outlets.csv"
    table.write_text(f"name,x,y\nmouth,{X0},{Y0 + 20}\nbridge,{X0 + 40.2},{Y0 + 21}\n")
    out, polygons = tmp_path / "flow.tif", tmp_path / "catchments.gpkg"
    said = photoplan(
        "dtm", "flow", valley, "--outlets", table, "--snap", 2, "--catchments", polygons, "-o", out, "--json"
    )
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    hole = 9 * 5
    assert facts["area"] == facts["outflow_area"] == 60 * 41 - hole
    assert facts["filled_area"] == 3 and facts["filled_volume"] == pytest.approx(2.9 + 2.8 + 2.7, abs=1e-3)
    mouth, bridge = facts["outlets"]
    # Snapped 2 m at most, to the axis, downstream.
    assert (bridge["x"], bridge["y"]) == (X0 + 39, Y0 + 20)
    assert bridge["upstream_area"] == 21 * 41 - hole
    assert mouth["own_area"] == mouth["upstream_area"] - bridge["upstream_area"]
    with rasterio.open(out) as file:
        area, length, longest, direction, catchment, depth = file.read()
        assert "catchment" in file.tags()["BANDS"]
    assert np.isnan(area[:5, 51:]).all() and np.isfinite(area).sum() == facts["area"]
    assert length[10, 20] == pytest.approx(10 + 20) and longest[20, 0] == pytest.approx(59 + 20)
    assert direction[10, 20] == 6 and direction[20, 10] == 4 and direction[20, 0] == -1
    assert catchment[20, 10] == 1 and catchment[10, 45] == 2 and depth[20, 30] == pytest.approx(2.8, abs=1e-4)
    meta, _, wkb, values = pyogrio.raw.read(polygons)
    columns = dict(zip(meta["fields"], values))
    assert [*columns["name"]] == ["mouth", "bridge"]
    np.testing.assert_allclose(shapely.area(shapely.from_wkb(wkb)), columns["own_area"])
    np.testing.assert_allclose(columns["own_area"], [mouth["own_area"], bridge["own_area"]])
    assert shapely.is_valid(shapely.from_wkb(wkb)).all()


def test_without_outlets_every_way_out_has_its_catchment(valley, tmp_path, photoplan):
    out, polygons = tmp_path / "flow.tif", tmp_path / "catchments.gpkg"
    said = photoplan("dtm", "flow", valley, "-o", out, "--catchments", polygons, "--method", "dinf")
    assert said.code == 0 and str(out) in said.out and "pits filled" in said.out, said.err
    _, _, wkb, _ = pyogrio.raw.read(polygons)
    assert shapely.area(shapely.from_wkb(wkb)).sum() == pytest.approx(60 * 41 - 45)


def test_wrong_use(valley, tmp_path, photoplan):
    out = tmp_path / "flow.tif"
    table = tmp_path / "outlets.csv"
    table.write_text(f"x,y\n{X0 + 55},{Y0 + 40}\n")
    twice = tmp_path / "twice.csv"
    twice.write_text(f"x,y\n{X0 + 5},{Y0 + 20}\n{X0 + 5.2},{Y0 + 20.1}\n")
    for words, code, text in [
        (("-o", valley), 2, "input"),
        (("-o", out, "--memory", "1KB"), 5, "coarser"),
        (("-o", out, "--outlets", table), 3, "line 2"),
        (("-o", out, "--outlets", twice), 3, "one cell"),
        (("-o", out, "--catchments", tmp_path / "a.shp"), 2, ".gpkg"),
        (("-o", out, "--snap", -1), 2, "snap"),
        (("-o", tmp_path / "a.gpkg", "--catchments", tmp_path / "a.gpkg"), 2, "same file"),
    ]:
        said = photoplan("dtm", "flow", valley, *words)
        assert said.code == code and text in said.err, (words, said)
        assert not out.exists()

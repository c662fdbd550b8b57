"""Volumes, visibility and flow on terrain models with walls, the same commands as on rasters."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import rasterio
import shapely
from products.test_scene_terrain_model import model_of
from tools.command import edit
from tools.dem_file import X0, Y0, write_dem, write_geojson
from tools.small_model import EMPTY, LAYOUT, LINED, WALL, grid_unit, write_units_of

from photoplan.surfaces.mesh import build_faces
from photoplan.surfaces.units import LineElement, Unit


def walled(column: int, row: int) -> Unit | None:
    """Level units; in one of them the ground south-west of the diagonal is lower, down to a wall."""
    if (column, row) == EMPTY:
        return None
    if (column, row) != LINED:
        return grid_unit(LAYOUT, column, row, 8, lambda X, Y: 150.0 + 0 * X)
    left, top = LAYOUT.corner(column, row)
    unit = grid_unit(LAYOUT, column, row, 8, lambda X, Y: 150.0 - WALL * ((X - left) < (top - Y) - 1e-6))
    along = np.linspace(0, 40, 9)
    xyz = np.column_stack([left + along, top - along, np.full(9, 150.0)])
    right = np.full(9, 150.0 - WALL)
    line = LineElement("wall", "breakline", "", xyz, right, np.full(9, 0.05), np.ones(9, bool))
    return dataclasses.replace(unit, faces=build_faces(unit, [line]))


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.gpkg"
    write_units_of(path, LAYOUT, walled, height_system="EPSG:5773")
    return path


@pytest.fixture
def raster(tmp_path):
    """Level ground at the height above the wall."""
    xmin, _, _, ymax = LAYOUT.bounds
    path = write_dem(tmp_path / "level.tif", lambda x, y: 150.0, (33, 25), 5.0, crs="EPSG:32633+5773")
    with rasterio.open(path, "r+") as file:
        file.transform = rasterio.transform.from_origin(xmin - 2.5, ymax + 2.5, 5, 5)
    return path


def test_the_volume_of_a_wall_in_a_model(model, raster, tmp_path, photoplan):
    left, top = LAYOUT.corner(*LINED)
    shape = shapely.transform(shapely.box(left, top - 40, left + 40, top), lambda xy: xy - np.array([X0, Y0]))
    polygon = write_geojson(tmp_path / "unit.geojson", {"unit": shape}, crs="EPSG:32633")
    words = ("--polygon", polygon, "--sigma-a", 0.1, "--json")
    said = photoplan("dtm", "volume", raster, model, *words)
    assert said.code == 0, said.err
    row = json.loads(said.out)["volumes"][0]
    # At the free ends of the wall both sides have the mean height.
    assert row["cut"] == pytest.approx(WALL * 800, rel=5e-3) and row["fill"] == 0
    assert row["sigma_net"] == pytest.approx(math.sqrt(math.pi * 25 * 1600 * (0.1**2 + 0.05**2)), rel=0.1)


def test_a_wall_hides_what_is_behind_it(model, tmp_path, photoplan):
    left, top = LAYOUT.corner(*LINED)
    out = tmp_path / "seen.tif"
    said = photoplan("dtm", "visible", model, "--from", left + 12, top - 30, "--resolution", 0.5, "-o", out)
    assert said.code == 0, said.err
    with rasterio.open(out) as file:
        seen = file.read(1)
        at = lambda x, y: seen[file.index(x, y)]  # noqa: E731
        assert at(left + 12.2, top - 29) == 1 and at(left + 25, top - 18) == 0
        empty = LAYOUT.corner(*EMPTY)
        assert at(empty[0] + 20, empty[1] - 20) == 255


def test_flow_over_a_model(model, tmp_path, photoplan):
    out = tmp_path / "flow.tif"
    said = photoplan("dtm", "flow", model, "--resolution", 2, "-o", out, "--json")
    facts = json.loads(said.out)
    assert facts["area"] == facts["outflow_area"] == pytest.approx(11 * 1600, rel=0.02)


def test_monoplotting_on_a_model_takes_its_standard_deviations(small, tmp_path, photoplan):
    model_of(small.terrain, small.folder / "model.gpkg")
    points = tmp_path / "points.csv"
    points.write_text("x,y\n100,75\n60,100\n")
    tables = []
    for terrain, extra in (("dem.tif", ("--sigma-terrain", 0.1)), ("model.gpkg", ())):
        if terrain == "model.gpkg":
            edit(small.project, "dem.tif", terrain)
        out = tmp_path / f"{terrain}.csv"
        said = photoplan("monoplot", small.project, "one", points, "-o", out, "--json", *extra)
        assert said.code == 0, said.err
        assert json.loads(said.out)["met"] == 2 and json.loads(said.out)["notes"] == []
        tables.append(np.genfromtxt(out, delimiter=",", skip_header=1, usecols=range(2, 8)))
    np.testing.assert_allclose(tables[0][:, :3], tables[1][:, :3], atol=2e-4)
    # The model's posts were given 0.1 m; between them its meshes do not follow the hills.
    assert (np.abs(tables[1][:, 3:] / tables[0][:, 3:] - 1) < 0.05).all()
    assert (tables[0][:, 5] > 0.09).all()

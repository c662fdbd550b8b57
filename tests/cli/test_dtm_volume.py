"""`photoplan dtm volume` from files to figures."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import rasterio
import shapely
from tools.dem_file import write_dem, write_geojson
from tools.events import Told

from photoplan.products.dtm.analyses import VolumeRequest, dtm_volume


@pytest.fixture
def models(tmp_path):
    before = write_dem(tmp_path / "before.tif", lambda x, y: 100.0 + 0.1 * x, (61, 51))
    after = write_dem(tmp_path / "after.tif", lambda x, y: np.where(x < 5, np.nan, 103.0 + 0.02 * y), (61, 51))
    return before, after


def test_volumes_of_polygons_are_exact_and_have_standard_deviations(models, tmp_path, photoplan):
    shapes = {"west": shapely.box(10.2, 5.1, 20.7, 25.3), "east": shapely.box(35.5, 4.0, 50.25, 30.5)}
    polygons = write_geojson(tmp_path / "parts.geojson", shapes)
    said = photoplan(
        "dtm", "volume", *models, "--polygon", polygons, "--sigma-a", 0.1, "--sigma-b", 0.05, "--json", "--bias", 0.01
    )
    assert said.code == 0, said.err
    rows = {row["polygon"]: row for row in json.loads(said.out)["volumes"]}
    for name, shape in shapes.items():
        truth = shape.area * (3 - 0.1 * shape.centroid.x + 0.02 * shape.centroid.y)
        assert rows[name]["net"] == pytest.approx(truth, rel=2e-4)
        assert rows[name]["area"] == pytest.approx(shape.area) and rows[name]["area_without_model"] == 0
        variance = math.pi * shape.area * (0.1**2 + 0.05**2) + (0.01 * shape.area) ** 2
        assert rows[name]["sigma_net"] == pytest.approx(math.sqrt(variance), rel=0.05), "edges make it less"
    assert rows["west"]["cut"] == 0 and rows["east"]["cut"] > rows["east"]["fill"]


def test_whole_overlap_with_holes_and_the_raster_of_differences(models, tmp_path, photoplan):
    raster = tmp_path / "difference.tif"
    said = photoplan("dtm", "volume", *models, "--difference", raster)
    assert said.code == 0 and str(raster) in said.out and "no standard deviation" in said.err
    with rasterio.open(raster) as file:
        found = file.read(1)
        assert file.crs is not None
        x, y = file.xy(10, 40)
    assert found[10, 40] == pytest.approx(3 - 0.1 * (x - 400_000) + 0.02 * (y - 450_000), abs=1e-4)
    assert np.isnan(found[:, :4]).all()
    said = photoplan("dtm", "volume", *models, "--json")
    row = json.loads(said.out)["volumes"][0]
    assert row["area_without_model"] == pytest.approx(5.5 * 51, rel=0.01)
    assert row["sigma_net"] is None


def test_halvings_of_the_cells_add_to_the_total_of_the_counter(tmp_path):
    """A difference that cells do not resolve is halved many times: `3180/120 windows` was printed."""
    before = write_dem(tmp_path / "before.tif", lambda x, y: 100.0 + 0 * x, (61, 51))
    after = write_dem(tmp_path / "after.tif", lambda x, y: 100 + np.sin(9.0 * x) * np.cos(7.0 * y), (61, 51))
    told = Told()
    dtm_volume(VolumeRequest(before, after, tolerance=1e-5, height_system="same", sigma_a=0.1, sigma_b=0.1), told)
    assert told.phases[0] == ("volumes", 0, "windows")
    assert told.units["volumes"] == told.added["volumes"] > 5


def test_wrong_use_is_refused_before_work(models, tmp_path, photoplan):
    before, after = models
    for words, code, text in [
        ((before, after, "--difference", before), 2, "is the input"),
        ((before, after, "--difference", after, "--overwrite"), 2, "is the input"),
        ((before, after, "--resolution", -1), 2, "resolution"),
        ((before, tmp_path / "none.tif"), 3, "none.tif"),
        ((before, after, "--polygon", before), 3, "not a vector file"),
        ((before, after, "--sigma-a", -1, "--sigma-b", 1), 2, "standard deviation"),
    ]:
        said = photoplan("dtm", "volume", *words)
        assert said.code == code and text in said.err, said
    taken = tmp_path / "there.tif"
    taken.write_bytes(b"old")
    said = photoplan("dtm", "volume", before, after, "--difference", taken)
    assert said.code == 2 and taken.read_bytes() == b"old"


def test_fault_02_height_systems_must_be_declared_and_equal(models, tmp_path, photoplan):
    silent = write_dem(tmp_path / "silent.tif", lambda x, y: 100.0, (61, 51), crs="EPSG:31287")
    said = photoplan("dtm", "volume", models[0], silent)
    assert said.code == 3 and "--height-system same" in said.err and "silent.tif" in said.err
    assert photoplan("dtm", "volume", models[0], silent, "--height-system", "same").code == 0
    other = write_dem(tmp_path / "other.tif", lambda x, y: 100.0, (61, 51), crs="EPSG:31287+3855")
    said = photoplan("dtm", "volume", models[0], other, "--height-system", "same")
    assert said.code == 3 and "convert" in said.err


def test_fault_19_polygons_that_cross_themselves_are_named(models, tmp_path, photoplan):
    bow = shapely.Polygon([(10, 10), (20, 20), (20, 10), (10, 20)])
    polygons = write_geojson(tmp_path / "bow.geojson", {"good": shapely.box(1, 1, 2, 2), "bow": bow})
    said = photoplan("dtm", "volume", *models, "--polygon", polygons)
    assert said.code == 3 and "'bow'" in said.err and "'good'" not in said.err


def test_fault_21_models_without_overlap_print_both_extents(models, tmp_path, photoplan):
    far = write_dem(tmp_path / "far.tif", lambda x, y: 100.0, (5, 5))
    with rasterio.open(far, "r+") as file:
        file.transform = rasterio.transform.from_origin(500_000, 450_000, 1, 1)
    said = photoplan("dtm", "volume", models[0], far)
    assert said.code == 3 and "500000" in said.err and "399999.5" in said.err

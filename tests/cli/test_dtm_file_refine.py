"""`photoplan dtm refine`: a finer model inside polygons, through the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin
from tools.command import Here
from tools.recorded import recorded
from tools.small_model import LAYOUT, grid_unit, hills, parts, write_units_of

from photoplan.io.terrain.model import GrossError, ModelReader
from photoplan.project.ground import open_terrain
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.units import LineElement, UnitLayout

FINE = UnitLayout(500_030.0, 5_299_980.0, 20.0, 4, 3)
"""Another chessboard: 80 m × 60 m inside the coarse one."""
BUMP = 3.0
INNER = (500_045.0, 5_299_935.0, 500_095.0, 5_299_965.0)
"""xmin, ymin, xmax, ymax of the polygon."""
BAND = 8.0


def raised(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    return hills(X, Y) + BUMP


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path, Path]:
    paths = tmp_path / "coarse.gpkg", tmp_path / "fine.gpkg", tmp_path / "where.geojson"
    write_units_of(paths[0], LAYOUT, lambda c, r: grid_unit(LAYOUT, c, r, 8), height_system="EPSG:5773")
    write_units_of(paths[1], FINE, lambda c, r: grid_unit(FINE, c, r, 16, raised), height_system="EPSG:5773")
    xmin, ymin, xmax, ymax = INNER
    ring = [[xmin, ymin], [xmax, ymin], [xmax, ymax], [xmin, ymax], [xmin, ymin]]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    paths[2].write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    return paths


def test_fine_inside_coarse_outside_joined_between(
    photoplan: Here, files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    coarse, fine, where = files
    out = tmp_path / "refined.gpkg"
    said = photoplan("dtm", "refine", coarse, fine, "--polygons", where, "--transition", BAND, "-o", out, "--json")
    assert said.code == 0, said.err
    report = json.loads(said.out)
    assert recorded(tmp_path / "refined.run.json", "refine", coarse, fine, where)["settings"]["transition"] == BAND
    assert report["largest_change"] == pytest.approx(BUMP, abs=0.05) and 0 < report["changed"] <= report["units"]
    reader = ModelReader(out)
    surface, before = HybridSurface(reader), HybridSurface(ModelReader(coarse))
    rng = np.random.default_rng(8)
    XY = rng.uniform([500_001, 5_299_881], [500_159, 5_299_999], (4000, 2))
    xmin, ymin, xmax, ymax = INNER
    inwards = np.minimum.reduce([XY[:, 0] - xmin, xmax - XY[:, 0], XY[:, 1] - ymin, ymax - XY[:, 1]])
    z = surface.heights(XY)
    # Outside nothing changes but by the single precision of the posts.
    assert np.abs(z - before.heights(XY))[inwards < 0].max() < 2e-5
    assert np.abs(z - raised(*XY.T))[inwards > BAND + 1.8].max() < 0.01
    t = np.clip(inwards / BAND, 0, 1)
    expected = hills(*XY.T) + BUMP * t * t * (3 - 2 * t)
    assert np.abs(z - expected).max() < 0.1
    assert reader.finest == FINE.side / 16 and reader.header.settings["refined"]["transition"] == BAND
    assert [item["file"] for item in reader.header.inputs] == ["coarse.gpkg", "fine.gpkg", "where.geojson"]
    figures = {(f.column, f.row): f for f in reader.figures()}
    assert figures[1, 1].meshes == 32 and np.isnan(figures[1, 1].variance) and figures[1, 1].points == 11
    assert figures[3, 0].meshes == 8 and figures[3, 0].variance == 4.0


def test_gross_errors_and_lines_of_the_model_that_counts(files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    from dataclasses import replace

    from photoplan.io.terrain.model_write import ModelWriter
    from photoplan.products.dtm.build import RefineRequest, dtm_refine

    inside, outside = (500_070.0, 5_299_950.0, 0.0), (500_010.0, 5_299_890.0, 0.0)

    def with_lists(path: Path, layout: UnitLayout, name: str) -> None:
        before = ModelReader(path)
        units = {(c, r): before.unit(c, r) for c, r in before.units()}
        figures = before.figures()
        xmin, ymin, xmax, ymax = layout.bounds
        xyz = np.array([[xmin + 1, (ymin + ymax) / 2, 150.0], [xmax - 1, (ymin + ymax) / 2, 150.0]])
        line = LineElement(name, "formline", "", xyz, None, np.full(2, 0.1), np.zeros(2, bool))
        gross = [GrossError(f"{name} {where}", "mass", xyz_, 1, 1, 9) for where, xyz_ in
                 (("in", inside), ("out", outside))]  # fmt: skip
        with ModelWriter(path, layout, name, overwrite=True) as writer:
            for f in figures:
                writer.add(units[f.column, f.row], f)
            from photoplan.surfaces.mesh import on_grid

            meshes = np.full((layout.rows, layout.columns), figures[0].meshes)
            header = replace(before.header, layout=layout)
            cut = [on_grid(line, layout, meshes)]
            writer.finish(replace(parts(layout), header=header, lines=cut, gross=gross, suspects=gross, domain=None))

    coarse, fine, where = files
    with_lists(coarse, LAYOUT, "coarse")
    with_lists(fine, FINE, "fine")
    dtm_refine(RefineRequest(coarse, fine, where, tmp_path / "r.gpkg", BAND))
    reader = ModelReader(tmp_path / "r.gpkg")
    for some in (reader.gross(), reader.suspects()):
        assert sorted(g.name for g in some) == ["coarse out", "fine in"]
    xmin, _, xmax, _ = INNER
    for line in reader.lines():
        x = line.xyz[:, 0]
        if line.name == "fine":
            assert xmin - 1e-6 <= x.min() and x.max() <= xmax + 1e-6
        else:
            assert x.max() <= xmin + 1e-6 or xmax - 1e-6 <= x.min()
    assert {line.name for line in reader.lines()} == {"coarse", "fine"}


def test_faults(photoplan: Here, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    coarse, fine, where = files
    options = ("--polygons", where, "--transition", 5)
    said = photoplan("dtm", "refine", coarse, fine, *options, "-o", coarse, "--overwrite")
    assert said.code == 2 and "the output is the input" in said.err
    other = tmp_path / "other.gpkg"
    write_units_of(other, FINE, lambda c, r: grid_unit(FINE, c, r, 4), "EPSG:32632", height_system="EPSG:5773")
    said = photoplan("dtm", "refine", coarse, other, *options, "-o", tmp_path / "o.gpkg")
    assert said.code == 3 and "in EPSG:32632; build both in one CRS" in said.err
    (tmp_path / "far.geojson").write_text(where.read_text().replace("5000", "4000"))
    said = photoplan(
        "dtm", "refine", coarse, fine, "--polygons", tmp_path / "far.geojson", "--transition", 5, "-o",
        tmp_path / "o.gpkg"
    )  # fmt: skip
    assert said.code == 3 and "the polygons touch no unit" in said.err
    said = photoplan("dtm", "refine", coarse, fine, *options, "-o", tmp_path / "o.tif")
    assert said.code == 2 and "ends with .gpkg" in said.err
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(("o.", ".o."))]


def test_fault_02_height_systems(photoplan: Here, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    coarse, _, where = files
    other = tmp_path / "other.gpkg"
    words = ("--polygons", where, "--transition", 5, "-o", tmp_path / "o.gpkg")
    write_units_of(other, FINE, lambda c, r: grid_unit(FINE, c, r, 4), height_system="ellipsoidal")
    said = photoplan("dtm", "refine", coarse, other, *words)
    assert said.code == 3 and "EGM96" in said.err and "ellipsoidal" in said.err
    other.unlink()
    write_units_of(other, FINE, lambda c, r: grid_unit(FINE, c, r, 4))
    said = photoplan("dtm", "refine", coarse, other, *words)
    assert said.code == 3 and "other.gpkg: no height system stated" in said.err
    said = photoplan("dtm", "refine", coarse, other, *words, "--height-system", "same")
    assert said.code == 0 and ModelReader(tmp_path / "o.gpkg").header.height_system == "EPSG:5773"


def ridge(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    return np.asarray(100 + 0.02 * (X - 500_000) + 8 * np.exp(-(((Y - 5_400_500) / 25) ** 2)))


def grid_file(path: Path, left: float, top: float, step: float, columns: int, rows: int) -> Path:
    """A raster whose posts, the middles of its cells, begin at left, top."""
    X, Y = np.meshgrid(left + step * np.arange(columns), top - step * np.arange(rows))
    place = from_origin(left - step / 2, top + step / 2, step, step)
    shape = {"width": columns, "height": rows, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:32632", transform=place, **shape) as file:
        file.write(ridge(X, Y).astype("float32"), 1)
    return path


@pytest.mark.parametrize("ratio", [3, 5, 10])
def test_rasters_are_refined_by_whole_numbers_and_nothing_changes_outside(
    photoplan: Here, tmp_path: Path, ratio: int
) -> None:
    """Behr 1989, section 6.1: a grid of 50 m whose meshes are divided inside a polygon."""
    coarse = grid_file(tmp_path / "coarse.tif", 500_000, 5_401_000, 50.0, 21, 21)
    step = 50.0 / ratio
    fine = grid_file(tmp_path / "fine.tif", 500_150, 5_400_700, step, 14 * ratio + 1, 8 * ratio + 1)
    area = shapely.Polygon([(500_195, 5_400_420), (500_800, 5_400_405), (500_770, 5_400_610), (500_230, 5_400_580)])
    where = tmp_path / "where.geojson"
    geometry = json.loads(shapely.to_geojson(area))
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    content = {"type": "Feature", "properties": {}, "geometry": geometry}
    where.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [content]}))
    out = tmp_path / "refined.gpkg"
    said = photoplan(
        "dtm", "refine", coarse, fine, "--polygons", where, "--transition", 30, "--height-system", "same", "-o", out
    )
    assert said.code == 0, said.err
    reader = ModelReader(out)
    assert reader.finest == pytest.approx(step, abs=1e-9)
    XY = np.random.default_rng(3).uniform([500_001, 5_400_001], [500_999, 5_400_999], (20_000, 2))
    after = HybridSurface(reader).heights(XY)
    before, finer = (open_terrain(path).surface.heights(XY) for path in (coarse, fine))
    outside = ~shapely.contains_xy(area, XY)
    deep = shapely.contains_xy(area.buffer(-30 - 1.5 * step), XY)
    assert np.abs(after - before)[outside].max() < 2e-5  # single precision
    assert np.abs(after - finer)[deep].max() < 2e-5
    assert deep.sum() > 500 and np.abs(before - finer)[deep].max() > 1


def test_a_model_is_refined_by_a_raster(photoplan: Here, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    coarse, _, where = files
    X, Y = np.meshgrid(500_030 + np.arange(81.0), 5_299_980 - np.arange(61.0))
    fine = tmp_path / "fine.tif"
    place = from_origin(500_029.5, 5_299_980.5, 1, 1)
    shape = {"width": 81, "height": 61, "count": 1, "dtype": "float32"}
    with rasterio.open(fine, "w", driver="GTiff", crs="EPSG:32633", transform=place, **shape) as file:
        file.write(raised(X, Y).astype("float32"), 1)
    out = tmp_path / "refined.gpkg"
    words = ("--transition", BAND, "--height-system", "same", "-o", out)
    said = photoplan("dtm", "refine", coarse, fine, "--polygons", where, *words)
    assert said.code == 0, said.err
    XY = np.random.default_rng(1).uniform([500_055, 5_299_945], [500_085, 5_299_955], (200, 2))
    surface = HybridSurface(ModelReader(out))
    assert np.abs(surface.heights(XY) - raised(*XY.T)).max() < 0.02
    assert np.isnan(surface.sigmas(XY)).all()  # a raster states none
    assert np.isfinite(surface.sigmas([(500_010.0, 5_299_890.0)])).all()

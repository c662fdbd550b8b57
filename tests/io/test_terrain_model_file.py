"""Files of terrain models: what is written comes back, at any place, from several threads and processes."""

from __future__ import annotations

import math
import pickle
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.small_model import (
    CRS,
    EMPTY,
    GROSS,
    LAYOUT,
    LINED,
    SUSPECTS,
    figures_of,
    grid_unit,
    hills,
    lines,
    same_unit,
    unit_at,
    wall_unit,
    write_small,
    write_units_of,
)

from photoplan.errors import InputError, PhotoplanError, UsageError
from photoplan.io.terrain.model import ModelReader, check_unit, inflate, is_terrain_model, pack_unit, unit_of
from photoplan.io.terrain.model_write import ModelWriter
from photoplan.surfaces.units import Unit, UnitLayout

PLACES = [(c, r) for r in range(LAYOUT.rows) for c in range(LAYOUT.columns)]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ModelReader:
    reader = write_small(tmp_path_factory.mktemp("model") / "model.gpkg")
    assert reader is not None
    return reader


def test_units_come_back_bit_by_bit(model: ModelReader) -> None:
    for column, row in PLACES:
        assert same_unit(model.unit(column, row), unit_at(column, row)), (column, row)
    assert model.unit(*EMPTY) is None
    assert model.unit(-1, 0) is None
    assert model.unit(0, LAYOUT.rows) is None
    assert sorted(model.units()) == sorted(set(PLACES) - {EMPTY})


def test_arrays_can_be_given_to_kernels_as_they_are(model: ModelReader) -> None:
    """A kernel would be compiled once more for arrays that are not writable or not contiguous."""
    unit = model.unit(*LINED)
    assert unit is not None and unit.faces is not None
    for array in (unit.heights, unit.sigmas, *vars(unit.faces).values()):
        assert array.flags.c_contiguous and array.flags.writeable and array.flags.aligned


def test_ranges_hold_posts_and_vertices(model: ModelReader) -> None:
    for column, row in PLACES:
        unit = unit_at(column, row)
        low, high = model.ranges[row, column]
        if unit is None:
            assert np.isnan([low, high]).all()
            continue
        heights = (unit.heights.astype(float) + unit.datum).ravel()
        if unit.faces is not None:
            heights = np.append(heights, unit.faces.vertices[:, 2])
        assert (low, high) == (heights.min(), heights.max())


def test_figures_lines_gross_border_and_header_come_back(model: ModelReader) -> None:
    for found, (column, row) in zip(model.figures(), PLACES, strict=True):
        expected = figures_of(unit_at(column, row), column, row)
        assert all(
            a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(vars(found).values(), vars(expected).values())
        )
    for line, written in zip(model.lines(), lines(), strict=True):
        assert (line.name, line.kind, line.code) == (written.name, written.kind, written.code)
        for name in ("xyz", "sigmas", "on_grid", "right"):
            a, b = getattr(line, name), getattr(written, name)
            assert a is b is None or np.array_equal(a, b, equal_nan=name != "on_grid")
    assert model.gross() == list(GROSS) and model.suspects() == list(SUSPECTS)
    assert model.domain().bounds == LAYOUT.bounds
    assert model.header.settings == {"filter": 0.1, "reach": None}
    assert model.header.crs == CRS and model.header.height_system == "EPSG:5773"
    assert model.header.family == "gaussian" and model.header.made_by.startswith("photoplan ")
    assert model.finest == 2.5


def test_lines_of_a_part(model: ModelReader) -> None:
    left, top = LAYOUT.corner(*LINED)
    assert [line.name for line in model.lines((left + 1, top - 5, left + 5, top - 1))] == ["wall Ä 7", "edge"]
    assert model.lines((0, 0, 1, 1)) == []


def test_layers_open_in_a_gis(model: ModelReader) -> None:
    """By GDAL, as QGIS does: squares, 3-D lines and points with their attributes, heights as a raster."""
    layers = dict(pyogrio.list_layers(model.path))
    spatial = {name: kind for name, kind in layers.items() if kind is not None}
    assert spatial == {
        "units": "Polygon",
        "lines": "LineString Z",
        "walls_right": "LineString Z",
        "gross_errors": "Point Z",
        "suspects": "Point Z",
        "border": "Polygon",
    }
    info = pyogrio.read_info(model.path, layer="units")
    assert info["features"] == len(PLACES) and info["crs"] == CRS
    assert tuple(info["total_bounds"]) == LAYOUT.bounds
    wall = pyogrio.raw.read(model.path, layer="walls_right")
    assert wall[3][0].tolist() == ["wall Ä 7"]


def test_raster_of_heights(model: ModelReader) -> None:
    """Posts are pixel centres; a unit of finer posts shows those of the base width, an empty one none."""
    with rasterio.open(model.path) as file:
        heights = file.read(1, masked=True)
        assert file.crs == CRS and file.nodata == -9999 and file.units == ("m",)
        rows, columns = np.mgrid[: file.height, : file.width]
        X, Y = file.xy(rows.ravel(), columns.ravel())
        assert file.res == (5.0, 5.0)
    X, Y = np.reshape(X, heights.shape), np.reshape(Y, heights.shape)
    empty = inside(X, Y, EMPTY, -1e-6)
    empty[:, -1] |= inside(X - 1, Y, EMPTY, -1e-6)[:, -1]
    assert np.array_equal(np.ma.getmaskarray(heights), empty)
    plain = ~empty & ~inside(X, Y, LINED, 1e-6)
    assert np.abs(heights - hills(X, Y))[plain].max() < 0.5 / 1024 + 1e-5


def test_raster_of_many_tiles_with_edges_between_units(tmp_path: Path) -> None:
    """Units across the raster's tiles and strips leave no gap: 300 posts along, tiles of 256."""
    layout = UnitLayout(0.0, 1000.0, 10.0, 30, 28)
    reader = write_units_of(tmp_path / "m.gpkg", layout, lambda c, r: grid_unit(layout, c, r, 10, plane, 0.0))
    with rasterio.open(reader.path) as file:
        heights = file.read(1)
    assert heights.shape == (281, 301)
    X, Y = np.meshgrid(np.arange(301.0), 1000 - np.arange(281.0))
    assert np.abs(heights - plane(X, Y)).max() < 1e-3


def test_raster_where_one_of_two_units_has_no_edge(tmp_path: Path) -> None:
    """Posts on the edge of two units: the one that has a height there counts, whichever is written last."""
    layout = UnitLayout(0.0, 0.0, 10.0, 3, 1)

    def unit(column: int, row: int) -> Unit:
        whole = grid_unit(layout, column, row, 10, plane, 0.0)
        heights = whole.heights.copy()
        if column == 1:
            heights[:, [0, -1]] = np.nan
        return replace(whole, heights=heights)

    with rasterio.open(write_units_of(tmp_path / "m.gpkg", layout, unit).path) as file:
        assert not np.ma.getmaskarray(file.read(1, masked=True)).any()


def inside(X: np.ndarray, Y: np.ndarray, unit: tuple[int, int], margin: float) -> np.ndarray:
    """Whether points lie in a unit, or no farther than the margin from it."""
    left, top = LAYOUT.corner(*unit)
    across = np.abs(X - left - LAYOUT.side / 2) < LAYOUT.side / 2 + margin
    return across & (np.abs(Y - top + LAYOUT.side / 2) < LAYOUT.side / 2 + margin)


def plane(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    return 0.25 * X - 0.5 * Y


def test_many_threads_and_a_pickled_copy(model: ModelReader) -> None:
    """With a cache that holds two units, so that every thread reads again and again."""
    small = ModelReader(model.path, cache_bytes=20_000)
    copy = pickle.loads(pickle.dumps(small))
    assert copy.header == small.header and copy._cache.bytes == 0

    def look(number: int) -> bool:
        column, row = PLACES[number * 7 % len(PLACES)]
        source = small if number % 2 else copy
        return same_unit(source.unit(column, row), unit_at(column, row))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(look, range(200)))
    assert 0 < small._cache.bytes <= 20_000


def test_a_model_that_was_replaced_is_noticed(tmp_path: Path) -> None:
    """Units of two models are never mixed: a thread that opens the file anew looks at its identity."""
    path = tmp_path / "m.gpkg"
    old = write_small(path)
    assert old is not None
    with ModelWriter(path, LAYOUT, "other", overwrite=True) as writer:
        for column, row in PLACES:
            writer.add(None, figures_of(None, column, row))
        writer.finish(replace_parts())
    assert old.unit(0, 0) is not None, "the thread that has the old file open goes on with it"
    with ThreadPoolExecutor(1) as pool, pytest.raises(InputError, match="has changed since it was opened"):
        pool.submit(old.unit, 1, 0).result()
    with pytest.raises(InputError, match="has changed since it was opened"):
        pickle.loads(pickle.dumps(old))


def replace_parts() -> object:
    from tools.small_model import parts

    return replace(parts(), lines=(), gross=(), domain=None)


def test_a_model_without_any_surface(tmp_path: Path) -> None:
    reader = write_units_of(tmp_path / "m.gpkg", LAYOUT, lambda c, r: None)
    assert np.isnan(reader.ranges).all() and reader.lines() == [] and reader.gross() == []
    assert reader.domain() is None and "heights" not in reader.layers()


def test_opened_in_a_gis_meanwhile(model: ModelReader, tmp_path: Path) -> None:
    """QGIS switches a GeoPackage to a write-ahead log when it opens it; the model stays readable, in use or after."""
    path = tmp_path / "m.gpkg"
    path.write_bytes(model.path.read_bytes())
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("UPDATE photoplan_terrain SET content = replace(content, 'gaussian', 'seen')")
        db.commit()
        assert path.with_name("m.gpkg-wal").stat().st_size > 0
        reader = ModelReader(path)
        assert same_unit(reader.unit(0, 0), unit_at(0, 0)) and reader.header.family == "seen"
    assert same_unit(ModelReader(path).unit(0, 0), unit_at(0, 0))


def test_what_is_a_model(model: ModelReader, tmp_path: Path) -> None:
    assert is_terrain_model(model.path)
    assert not is_terrain_model(tmp_path)
    assert not is_terrain_model(tmp_path / "absent.gpkg")
    other = tmp_path / "other.gpkg"
    sqlite3.connect(other).execute("CREATE TABLE a (b)").connection.close()
    assert not is_terrain_model(other)
    with pytest.raises(InputError, match=r"other\.gpkg: no terrain model of photoplan \(it has no table"):
        ModelReader(other)
    with pytest.raises(InputError, match="no such terrain model"):
        ModelReader(tmp_path / "absent.gpkg")


class TestWriting:
    def test_units_must_fit_the_layout(self, tmp_path: Path) -> None:
        with ModelWriter(tmp_path / "m.gpkg", LAYOUT, "k") as writer:
            unit = unit_at(0, 0)
            assert unit is not None
            with pytest.raises(UsageError, match="its place in the layout"):
                writer.add(unit, figures_of(unit, 1, 0))
            with pytest.raises(UsageError, match="the layout has 4 × 3 units"):
                writer.add(None, figures_of(None, 4, 0))
            broken = replace(unit, heights=np.full_like(unit.heights, np.inf))
            with pytest.raises(InputError, match="column 0 row 0: an infinite height"):
                writer.add(broken, figures_of(unit, 0, 0))
            assert writer.done() == frozenset()
            with pytest.raises(PhotoplanError, match="12 units were not delivered"):
                writer.finish(replace_parts())  # type: ignore[arg-type]

    def test_only_geopackages(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match=r"ends with \.gpkg"):
            ModelWriter(tmp_path / "m.tif", LAYOUT, "k")

    def test_a_unit_of_holes_is_empty(self, tmp_path: Path) -> None:
        def holes(column: int, row: int) -> Unit | None:
            unit = grid_unit(LAYOUT, column, row, 4)
            return replace(unit, heights=np.full_like(unit.heights, np.nan)) if column == 1 else unit

        reader = write_units_of(tmp_path / "m.gpkg", LAYOUT, holes)
        assert reader.unit(1, 0) is None and reader.unit(0, 0) is not None


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 12), st.integers(0, 2**32 - 1), st.booleans(), st.floats(-1e4, 1e4))
def test_any_unit_survives_packing(meshes: int, seed: int, faces: bool, datum: float) -> None:
    """All bit patterns of floats but infinity, NaN anywhere."""
    layout = UnitLayout(1.0, 2.0, 3.0, 5, 5)
    rng = np.random.default_rng(seed)
    unit = wall_unit(layout, 2, 1, meshes) if faces else grid_unit(layout, 2, 1, meshes)
    heights = rng.integers(0, 2**32, unit.heights.shape, dtype=np.uint32).view(np.float32).copy()
    heights[np.isinf(heights)] = np.nan
    unit = replace(unit, heights=heights, datum=datum)
    packed, size = pack_unit(unit)
    back = unit_of(inflate(packed, size, "unit"), layout, 2, 1)
    check_unit(back, "unit")
    assert same_unit(unit, back)
    assert np.array_equal(
        unit.heights.view(np.uint32)[~np.isnan(heights)], back.heights.view(np.uint32)[~np.isnan(heights)]
    )


def test_smooth_heights_compress(tmp_path: Path) -> None:
    """Bytes ordered by significance: under 60 % of the plain size where heights are smooth (90 % without the order)."""
    layout = UnitLayout(0.0, 0.0, 64.0, 1, 1)
    unit = grid_unit(layout, 0, 0, 64)
    packed, size = pack_unit(unit)
    assert len(packed) < 0.6 * size

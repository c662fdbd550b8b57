"""Opening terrain of either kind: fields, CRSs that cannot be used, files that are no terrain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.small_block import write_terrain
from tools.small_model import LAYOUT, grid_unit, write_small, write_units_of

from photoplan.errors import InputError
from photoplan.project.ground import open_terrain
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.raster import RasterSurface


def test_a_model(tmp_path: Path) -> None:
    write_small(tmp_path / "m.gpkg")
    terrain = open_terrain(tmp_path / "m.gpkg")
    assert isinstance(terrain.surface, HybridSurface) and terrain.model is not None
    assert terrain.bounds == LAYOUT.bounds and terrain.resolution == 2.5
    assert (terrain.crs, terrain.height_system) == ("EPSG:32633", "EPSG:5773")
    same, steps = terrain.in_crs("EPSG:32633")
    assert same is terrain and steps == ()


def test_a_model_under_another_suffix(tmp_path: Path) -> None:
    """What a file is, its first bytes and tables say, not its name."""
    write_small(tmp_path / "m.gpkg")
    (tmp_path / "m.gpkg").rename(tmp_path / "model.sqlite")
    assert open_terrain(tmp_path / "model.sqlite").model is not None


def test_a_raster(tmp_path: Path) -> None:
    terrain = open_terrain(write_terrain(tmp_path / "dem.tif"))
    assert isinstance(terrain.surface, RasterSurface) and terrain.model is None
    assert terrain.resolution == 10 and terrain.height_system is None
    placed, (step,) = terrain.in_crs("EPSG:32632")
    inside = step.source == "EPSG:32632" and placed.crs == "EPSG:32632"
    assert inside and placed.bounds[0] > terrain.bounds[0] + 400_000
    middle = np.add(placed.bounds[:2], placed.bounds[2:]) / 2
    assert np.isfinite(placed.surface.heights(middle))


@pytest.mark.parametrize(
    ("crs", "message"), [("EPSG:4326", "is geographic"), ("EPSG:2263", "a projected CRS in metres")]
)
def test_fault_20_models_in_degrees_or_feet(tmp_path: Path, crs: str, message: str) -> None:
    write_units_of(tmp_path / "m.gpkg", LAYOUT, lambda c, r: grid_unit(LAYOUT, c, r, 2), crs)
    with pytest.raises(InputError, match=message) as error:
        open_terrain(tmp_path / "m.gpkg")
    assert "m.gpkg" in str(error.value)


def test_fault_20_a_raster_without_crs(tmp_path: Path) -> None:
    dem = write_terrain(tmp_path / "dem.tif", crs=None)
    with pytest.raises(InputError, match="state it with `crs` EPSG:nnnn, it is not guessed"):
        open_terrain(dem)
    assert open_terrain(dem, "EPSG:32633").crs == "EPSG:32633"
    with pytest.raises(InputError, match=r"state it as crs = \.\.\."):
        open_terrain(dem, option="as crs = ...")


@pytest.mark.parametrize("content", [b"", b"text", b"SQLite format 3\0" + bytes(5000)])
def test_what_is_no_terrain(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "m.gpkg"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"m\.gpkg: no terrain model of photoplan"):
        open_terrain(path)
    with pytest.raises(InputError, match="no such terrain model"):
        open_terrain(tmp_path / "absent.gpkg")

"""Rasters of one grid as bands of one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from photoplan.errors import UsageError
from photoplan.io.product import write_stacked


def raster(path: Path, left: float, value: int, count: int = 1) -> Path:
    profile = {"driver": "GTiff", "width": 4, "height": 3, "count": count, "dtype": "uint8", "nodata": 0}
    transform = rasterio.Affine(0.5, 0.0, left, 0.0, -0.5, 100.0)
    with rasterio.open(path, "w", crs="EPSG:32633", transform=transform, **profile) as file:
        file.write(np.full((count, 3, 4), value, np.uint8))
    return path


def test_each_raster_is_a_band_over_all_of_them(tmp_path: Path) -> None:
    a, b = raster(tmp_path / "a.tif", 10.0, 7), raster(tmp_path / "b & c.tif", 11.0, 9, 2)
    write_stacked(tmp_path / "all.vrt", {"red": a, "n<ir": b})
    with rasterio.open(tmp_path / "all.vrt") as file:
        assert file.descriptions == ("red", "n<ir 1", "n<ir 2") and file.shape == (3, 6)
        values = file.read()
    assert (values[0] == np.repeat([7, 0], [4, 2])).all() and (values[2] == np.repeat([0, 9], [2, 4])).all()


def test_pixels_that_do_not_lie_over_each_other_are_refused(tmp_path: Path) -> None:
    a, b = raster(tmp_path / "a.tif", 10.0, 7), raster(tmp_path / "b.tif", 10.2, 9)
    with pytest.raises(UsageError, match=r"b\.tif: its pixels do not lie"):
        write_stacked(tmp_path / "all.vrt", {"a": a, "b": b})

"""Terrain grids: heights, voids, units, the bounded cache."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.raster import BlockCache, TerrainReader


def grid(path: Path, heights: np.ndarray, **profile: Any) -> Path:
    extra = {key: profile.pop(key) for key in ("scales", "offsets", "units") if key in profile}
    options = {
        "count": 1,
        "height": heights.shape[0],
        "width": heights.shape[1],
        "dtype": heights.dtype,
        "transform": rasterio.Affine(2, 0, 100, 0, -2, 900),
        "crs": "EPSG:32633",
    }
    with rasterio.open(path, "w", driver="GTiff", **(options | profile)) as file:
        for key, value in extra.items():
            setattr(file, key, value)
        file.write(heights, 1)
    return path


def hills(shape: tuple[int, int] = (300, 500), dtype: Any = np.float32) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (800 + 0.5 * x + y).astype(dtype)


@pytest.mark.parametrize("dtype", ["int16", "uint16", "int32", "float32", "float64"])
@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 128, "blockysize": 64}, {"blockysize": 300}])
def test_windows_and_points(tmp_path: Path, dtype: str, layout: dict[str, Any]) -> None:
    reader = TerrainReader(grid(tmp_path / "a.tif", hills(dtype=dtype), **layout))
    expected = hills(dtype=dtype).astype(np.float32)
    for window in [Window(0, 0, 500, 300), Window(120, 60, 20, 10), Window(499, 299, 1, 1)]:
        found = reader.read(window)
        assert found.dtype == np.float32
        right, bottom = window.stop
        np.testing.assert_array_equal(found, expected[window.row : bottom, window.col : right])
    assert reader.pixel(131, 70) == expected[70, 131]


def test_voids_of_every_kind(tmp_path: Path) -> None:
    heights = hills((20, 30))
    heights[0, 0], heights[0, 1], heights[0, 2], heights[0, 3] = -9999, np.nan, 3.4028235e38, -3.4028235e38
    reader = TerrainReader(grid(tmp_path / "a.tif", heights, nodata=-9999))
    found = reader.read(Window(0, 0, 30, 20))
    assert np.isnan(found[0, :4]).all()
    assert np.isfinite(found).sum() == 20 * 30 - 4


@pytest.mark.parametrize("value", [-9999.0, -32768.0, 12_001.0, 65535.0])
def test_values_that_are_no_heights_are_refused_with_their_count(tmp_path: Path, value: float) -> None:
    heights = hills((20, 30))
    heights[3, 4:7] = value
    path = grid(tmp_path / "a.tif", heights)
    with pytest.raises(InputError, match=rf"a\.tif: 3 values in .* no heights .* {value:g} m; .*declare the nodata"):
        TerrainReader(path).read(Window(0, 0, 5, 5))


def test_scale_offset_and_feet(tmp_path: Path) -> None:
    stored = np.full((4, 5), 12_345, np.int16)
    path = grid(tmp_path / "a.tif", stored, scales=(0.01,), offsets=(500.0,), units=("US survey foot",))
    reader = TerrainReader(path)
    np.testing.assert_allclose(reader.read(Window(0, 0, 5, 4)), 623.45 * 1200 / 3937, rtol=1e-7)
    assert reader.info.metres_per_unit == pytest.approx(0.3048006096, abs=1e-10)
    # 30 000 ft are no height of the Earth in metres, but less than 9 144 m: the limit is asked in metres.
    feet = grid(tmp_path / "b.tif", np.full((4, 5), 29_000, np.int16), units=("ft",))
    assert TerrainReader(feet).pixel(0, 0) == pytest.approx(29_000 * 0.3048)
    with pytest.raises(InputError, match="no heights"):
        TerrainReader(grid(tmp_path / "c.tif", np.full((4, 5), 29_000, np.int16))).pixel(0, 0)


def test_ascii_grid(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    path.write_text(
        "ncols 3\nnrows 2\nxllcorner 100\nyllcorner 200\ncellsize 10\nNODATA_value -9999\n1.5 2.5 3.5\n4.5 -9999 6.5\n"
    )
    reader = TerrainReader(path)
    np.testing.assert_array_equal(reader.read(Window(0, 0, 3, 2)), [[1.5, 2.5, 3.5], [4.5, np.nan, 6.5]])
    assert reader.info.to_map == (105.0, 10.0, 0.0, 215.0, 0.0, -10.0)


def test_refused_grids(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not georeferenced"):
        TerrainReader(grid(tmp_path / "a.tif", hills(), transform=rasterio.Affine.identity()))
    with pytest.raises(InputError, match="type complex64"):
        TerrainReader(grid(tmp_path / "b.tif", hills(dtype=np.complex64)))
    with pytest.raises(UsageError, match="not inside the grid of 500 × 300"):
        TerrainReader(grid(tmp_path / "c.tif", hills())).read(Window(499, 0, 2, 1))


def test_memory_is_bounded_and_the_cache_stays_behind(tmp_path: Path) -> None:
    path = grid(tmp_path / "a.tif", hills((1000, 1000)), tiled=True, blockxsize=128, blockysize=128)
    reader = TerrainReader(path, cache_bytes=300_000)
    for row in range(0, 990, 100):
        for col in range(0, 990, 100):
            reader.read(Window(col, row, 10, 10))
            assert reader._cache.bytes <= 300_000
    assert reader._cache.bytes >= 128 * 128 * 4
    again = pickle.loads(pickle.dumps(reader))
    assert again._cache.bytes == 0
    np.testing.assert_array_equal(again.read(Window(5, 6, 3, 2)), reader.read(Window(5, 6, 3, 2)))


def test_blocks_are_read_once_while_they_are_kept(tmp_path: Path) -> None:
    path = grid(tmp_path / "a.tif", hills(), tiled=True, blockxsize=128, blockysize=128)
    reader = TerrainReader(path)
    first = reader.read(Window(0, 0, 100, 100))
    # The file goes away; what is kept is still there.
    path.unlink()
    np.testing.assert_array_equal(reader.read(Window(0, 0, 100, 100)), first)
    with pytest.raises(InputError, match="no longer there"):
        reader.read(Window(400, 200, 5, 5))


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 40)), max_size=60), st.integers(0, 100))
def test_cache_forgets_the_least_recently_used(asked: list[tuple[int, int]], limit: int) -> None:
    """Against a slow twin: a list of keys in the order of their last use."""
    sizes: dict[int, int] = {}
    cache = BlockCache(limit)
    twin: list[int] = []
    for key, size in asked:
        size = sizes.setdefault(key, size)
        loaded: list[int] = []

        def load(key: int = key, size: int = size, loaded: list[int] = loaded) -> NDArray[Any]:
            loaded.append(key)
            return np.full(size, key, np.uint8)

        loader: Callable[[], NDArray[Any]] = load
        block = cache.get(key, loader)
        assert (block == key).all()
        assert bool(loaded) is (key not in twin)
        if key in twin:
            twin.remove(key)
        if size <= limit:
            twin.append(key)
        while sum(sizes[k] for k in twin) > limit:
            twin.pop(0)
        assert cache.bytes == sum(sizes[k] for k in twin)

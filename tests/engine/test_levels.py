"""Sources much finer than the product: read reduced, never aliased."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tools.arrays import noise, product
from tools.pinhole import Pinhole
from tools.thinned import some
from tools.twin import strict_positions, strict_scales, twin_reduce, twin_resample

from photoplan.engine.execute import ArrayReader, Source, render
from photoplan.geometry.grid import MapGrid, Window, level_size, means, reduced
from photoplan.geometry.pose import Pose
from photoplan.io.raster import RasterReader, best_overview
from photoplan.plan.footprint import Tile
from photoplan.plan.product import compile_tile
from photoplan.surfaces.base import LevelSurface
from photoplan.targets.map import MapTarget


@settings(max_examples=40, deadline=None)
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    level=st.integers(1, 4),
    dtype=st.sampled_from(["uint8", "uint16", "int16", "float32"]),
    masked=st.booleans(),
    seed=st.integers(0, 99),
)
def test_means_are_the_twins(size: tuple[int, int], level: int, dtype: str, masked: bool, seed: int) -> None:
    image = noise(2, size[1], size[0], dtype, seed)
    valid = np.random.default_rng(seed).random(size[::-1]) > 0.4 if masked else None
    want, there = twin_reduce(image, valid, level)
    got, good = means(image, valid, level)
    assert got.shape[1:] == level_size(size, level)[::-1]
    np.testing.assert_array_equal(np.ones_like(there) if good is None else good, there)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6)


def test_windows_of_a_reduced_image_are_cut_from_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    reader = ArrayReader(noise(3, 83, 121, "uint8"), np.random.default_rng(0).random((83, 121)) > 0.5)
    whole, valid = reduced(reader, Window(0, 0, *level_size(reader.size, 2)), 2)
    assert valid is not None
    monkeypatch.setattr("photoplan.geometry.grid.CHUNK", 2000)
    for window in Window(0, 0, *level_size(reader.size, 2)).tiles(9):
        part, good = reduced(reader, window, 2)
        cut = np.s_[window.row : window.stop[1], window.col : window.stop[0]]
        np.testing.assert_array_equal(part, whole[:, cut[0], cut[1]])
        np.testing.assert_array_equal(True if good is None else good, valid[cut])


def coarse(scale: float) -> tuple[Pinhole, MapGrid, LevelSurface]:
    """A camera 100 m above level ground, and a product whose pixels span `scale` of its own."""
    cam = Pinhole(Pose.from_angles((0.1, 0.3, 100), (0.01, -0.02, 0.3)), 1000.0, (900, 700))
    return cam, MapGrid.covering((-30, -20, 30, 20), 0.1 * scale, "EPSG:32615"), LevelSurface(0.0)


@pytest.mark.parametrize("scale", some([4.5, 10.0, 30.0], 1))
@pytest.mark.parametrize("kernel", some(["bilinear", "bicubic", "lanczos3"], 1))
def test_reduced_sources_make_the_same_product_as_whole_ones(scale: float, kernel: str) -> None:
    """Smooth light with detail down to the product's own resolution: means before the kernel hardly show."""
    cam, grid, surface = coarse(scale)
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:700, :900]
    image = np.zeros((700, 900))
    for _ in range(40):
        angle, length = rng.uniform(0, np.pi), scale * rng.uniform(4, 20)
        image += np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / length + rng.uniform(0, 6))
    image = (128 + 100 * image / np.abs(image).max())[None].astype(np.float32)
    plan = product(grid, reduces=True)
    assert {layer.level for layer in compile_tile(plan, plan.tiles[0], {0: cam}, surface).layers} == {
        {4.5: 1, 10.0: 2, 30.0: 3}[scale]
    }
    got = render(plan, plan.tiles[0], [Source(cam, ArrayReader(image))], surface, kernel)
    xy, uvh = strict_positions(MapTarget(grid), grid.window, cam, surface)
    want, good = twin_resample(image, None, xy, kernel, strict_scales(MapTarget(grid), cam, uvh))
    both = got.valid & good
    assert both.mean() > 0.5
    inner = both & np.roll(both, 2, 0) & np.roll(both, -2, 0) & np.roll(both, 2, 1) & np.roll(both, -2, 1)
    # 200 grey values from dark to bright.
    assert np.sqrt(np.mean((got.values[0] - want[0])[inner] ** 2)) < 0.7


@pytest.mark.parametrize("scale", [5.0, 12.0, 30.0])
def test_a_chessboard_of_single_pixels_becomes_grey(scale: float) -> None:
    cam, grid, surface = coarse(scale)
    y, x = np.mgrid[:700, :900]
    image = (((x + y) % 2) * 255)[None].astype(np.uint8)
    got = render(product(grid), Tile(0, grid.window), [Source(cam, ArrayReader(image))], surface, "bicubic")
    assert got.valid.any()
    assert np.abs(got.values[0][got.valid].astype(float) - 127.5).max() <= 3.0


def write(path: Path, image: NDArray[Any], resampling: str | None, **more: Any) -> Path:
    """A tiled GeoTIFF with overviews at 2, 4, 8."""
    profile = {"width": image.shape[2], "height": image.shape[1], "count": len(image), "dtype": image.dtype.name}
    with rasterio.open(
        path, "w", driver="GTiff", tiled=True, blockxsize=128, blockysize=128, **profile, **more
    ) as file:
        file.write(image)
        if resampling:
            file.build_overviews([2, 4, 8], rasterio.enums.Resampling[resampling])
    return path


class Counted:
    """How many pixels are read of a file at full size."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from photoplan.io import raster

        self.pixels = 0
        read = raster.read_pixels

        def counting(info: Any, window: Window, *more: Any, **kept: Any) -> Any:
            self.pixels += 0 if "overview" in kept else window.size
            return read(info, window, *more, **kept)

        monkeypatch.setattr(raster, "read_pixels", counting)


@pytest.mark.parametrize(("resampling", "used"), [("average", True), ("nearest", False), (None, False)])
def test_overviews_are_used_where_they_are_means(
    resampling: str | None, used: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = noise(3, 600, 800, "uint8")
    reader = RasterReader(write(tmp_path / "a.tif", image, resampling))
    for level in (1, 2, 3, 4):
        # Looks at whether overviews are means read some pixels, once.
        best_overview(reader.info, level)
    full = Counted(monkeypatch)
    for level in (1, 2, 3, 4):
        before = full.pixels
        got, valid = reader.read(Window(0, 0, *level_size(reader.size, level)), level)
        assert valid is None
        want, _ = twin_reduce(image, None, level)
        # An overview was made of an overview, and rounded each time.
        assert np.abs(got.astype(int) - want).max() <= level
        assert (full.pixels == before) == used


def test_invalid_pixels_are_left_out_of_means(tmp_path: Path) -> None:
    image = noise(1, 256, 256, "uint8") // 2 + 100
    image[:, 40:120, 40:130] = 7
    reader = RasterReader(write(tmp_path / "a.tif", image, "average", nodata=7))
    want, good = twin_reduce(image, (image != 7).all(axis=0), 2)
    got, valid = reader.read(Window(0, 0, 64, 64), 2)
    inner = np.zeros_like(good)
    inner[12:28, 12:30] = True
    assert valid is not None and not valid[inner].any()
    sure = valid & good
    assert sure.sum() > 3000 and np.abs(got.astype(int) - want)[:, sure].max() <= 2


def test_a_file_is_read_once_however_its_tiles_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A turned image: windows of neighbouring tiles overlap by half, blocks of the reduced image are made once."""
    image = noise(1, 2400, 2000, "uint8")
    reader = RasterReader(write(tmp_path / "a.tif", image, None))
    full = Counted(monkeypatch)
    cam = Pinhole(Pose.from_angles((0, 0, 100), (0.01, 0.02, 0.8)), 2000.0, (2000, 2400))
    grid = MapGrid.covering((-100, -100, 100, 100), 0.5, "EPSG:32615")
    plan = product(grid, side=64)
    for tile in plan.tiles:
        render(plan, tile, [Source(cam, reader)], LevelSurface(0.0), "bicubic")
    assert 0.9 * image.size < full.pixels < 1.2 * image.size

"""Products: what is written, where it lies on the map, how it is stored."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.thinned import some

from photoplan.errors import PhotoplanError, UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.io.disk import BlockCoder, nodata_for
from photoplan.io.product import ProductFacts, ProductFile
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import read_tiff_layouts

GRID = MapGrid(500_000.25, 5_200_000.5, 0.25, 600, 400, "EPSG:32633")
PLACE = GRID.placement


def scene(bands: int, dtype: Any, grid: MapGrid = GRID) -> tuple[np.ndarray, np.ndarray]:
    """Pixels with every value that could trouble, and a validity with a hole, an empty tile and single pixels."""
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (bands, grid.height, grid.width)).astype(dtype)
    valid = np.ones((grid.height, grid.width), bool)
    valid[256:384, 256:384] = False
    valid[5:9, 3:40] = False
    valid[0, 0] = False
    return pixels, valid


def fill(file: ProductFile, pixels: np.ndarray, valid: np.ndarray | None, order: Iterator[int] | None = None) -> None:
    for index in order if order is not None else range(len(file.windows)):
        w = file.windows[index]
        rows, cols = slice(w.row, w.stop[1]), slice(w.col, w.stop[0])
        file.append(index, pixels[:, rows, cols], None if valid is None else valid[rows, cols])


def make(
    path: Path, pixels: np.ndarray, valid: np.ndarray | None, grid: MapGrid = GRID, **options: Any
) -> ProductFacts:
    options = {"run_key": "k", "tile": 128} | options
    with ProductFile(path, grid.placement, len(pixels), pixels.dtype, **options) as file:
        fill(file, pixels, valid)
        return file.complete({"SOURCE": "test"})


@pytest.mark.parametrize("compress", some(["none", "deflate", "zstd", "lzw"], 1, 2))
@pytest.mark.parametrize("nodata", ["auto", "mask"])
@pytest.mark.parametrize(
    ("bands", "dtype"), some([(3, "uint8"), (1, "uint16"), (2, "int16"), (4, "float32"), (5, "uint8")], 0, 2, 3)
)
def test_pixels_and_validity_come_back(tmp_path: Path, compress: str, nodata: Any, bands: int, dtype: str) -> None:
    pixels, valid = scene(bands, dtype)
    facts = make(tmp_path / "a.tif", pixels, valid, compress=compress, nodata=nodata)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.tif"]
    with rasterio.open(tmp_path / "a.tif") as file:
        found, masks = file.read(), file.read_masks()
        assert file.tags()["SOURCE"] == "test"
        assert file.block_shapes[0] == (128, 128)
        assert file.overviews(1) == [2, 4, 8]
        assert file.crs.to_epsg() == 32633
        value = file.nodata
    expected = pixels.copy()
    if nodata == "auto":
        assert value == {"uint8": 0, "uint16": 0, "int16": -32768}.get(dtype) or np.isnan(value)
        if dtype.startswith("uint"):
            expected[expected == 0] = 1
        assert facts.moved_values == (expected != pixels)[:, valid].sum()
    else:
        assert value is None
    np.testing.assert_array_equal(found[:, valid], expected[:, valid])
    np.testing.assert_array_equal(masks > 0, np.broadcast_to(valid, masks.shape))
    assert facts.valid_share == pytest.approx(valid.mean(), abs=1e-12)
    assert (facts.tiles, facts.empty_tiles) == (20, 1)
    assert facts.bytes == (tmp_path / "a.tif").stat().st_size


@pytest.mark.parametrize("overviews", [True, False])
@pytest.mark.parametrize("compress", ["none", "deflate", "jpeg"])
def test_world_position_is_exact_to_the_half_pixel(tmp_path: Path, compress: str, overviews: bool) -> None:
    pixels, _ = scene(1, "uint8")
    make(tmp_path / "a.tif", pixels, None, compress=compress, overviews=overviews)
    info = RasterReader(tmp_path / "a.tif").info
    assert info.to_map is not None
    x0, xx, _, y0, _, yy = info.to_map
    # The grid's own statement of pixel centres, to the last bit.
    np.testing.assert_array_equal(GRID.to_map([[0, 0], [7, 3]]), [[x0, y0], [x0 + 7 * xx, y0 + 3 * yy]])
    with rasterio.open(tmp_path / "a.tif") as file:
        assert tuple(file.bounds) == GRID.bounds
        assert bool(file.overviews(1)) is overviews


def test_jpeg_takes_a_mask_and_colours(tmp_path: Path) -> None:
    y, x = np.mgrid[:400, :600]
    pixels = np.stack([x / 4, y / 4, (x + y) / 6]).astype(np.uint8)
    _, valid = scene(3, "uint8")
    make(tmp_path / "a.tif", pixels, valid, compress="jpeg")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.compression.name, file.photometric.name, file.nodata) == ("jpeg", "ycbcr", None)
        np.testing.assert_array_equal(file.dataset_mask() > 0, valid)
        assert np.abs(file.read().astype(float) - pixels)[:, valid].mean() < 6


def test_fault_22_no_dark_fringe_beside_a_hole_in_jpeg(tmp_path: Path) -> None:
    """A bright field with a ragged hole: black under the mask would ring into the valid pixels."""
    pixels = np.full((3, 400, 600), 240, np.uint8)
    y, x = np.mgrid[:400, :600]
    valid = (x - 303) ** 2 + (y - 203) ** 2 > 101**2
    make(tmp_path / "a.tif", pixels, valid, compress="jpeg", quality=75)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert np.abs(file.read().astype(int) - 240)[:, valid].max() <= 2


def test_names_with_special_characters_touch_no_other_file(tmp_path: Path) -> None:
    others = [".a.tif.part.tif", ".b.tif.plain.tif.msk", "x.tif"]
    for other in others:
        (tmp_path / other).write_text("precious")
    pixels, _ = scene(1, "uint8")
    for name in ("[ab]*.tif", "?.tif", "ü ß.tif"):
        make(tmp_path / name, pixels, None, overwrite=True)
    assert {p.name for p in tmp_path.iterdir()} == {*others, "[ab]*.tif", "?.tif", "ü ß.tif"}


def test_a_black_valid_pixel_stays_valid_for_other_readers(tmp_path: Path) -> None:
    pixels = np.zeros((3, 400, 600), np.uint8)
    facts = make(tmp_path / "a.tif", pixels, None)
    assert facts.moved_values == pixels.size
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.read_masks() == 255).all()
        assert (file.read() == 1).all()
        assert (file.read(out_shape=(3, 100, 150)) == 1).all(), "overviews average valid pixels only"


@pytest.mark.parametrize(
    ("dtype", "nodata", "moved"), [("uint8", 255.0, 254), ("uint8", 7.0, 8), ("int16", -32768, -32767)]
)
def test_nodata_moves_to_the_neighbour_inside_the_type(dtype: str, nodata: float, moved: int) -> None:
    coder = BlockCoder(16, 2, np.dtype(dtype), nodata_for(np.dtype(dtype), nodata, "none"))
    pixels = np.full((2, 16, 16), 5, dtype)
    pixels[0, 1, 1] = nodata
    valid = np.ones((16, 16), bool)
    valid[2, 2] = False
    payload, count = coder.encode(pixels, valid)
    found, ok = coder.decode(bytes(payload), (16, 16))
    assert (count, found[0, 1, 1], found[1, 1, 1], found[0, 2, 2]) == (1, moved, 5, nodata)
    np.testing.assert_array_equal(ok, valid)


@pytest.mark.parametrize("options", [{"compress": "none", "overviews": False}, {"compress": "deflate"}])
def test_empty_tiles_are_not_stored(tmp_path: Path, options: dict[str, Any]) -> None:
    grid = MapGrid(0, 0, 1, 2048, 2048, "EPSG:32633")
    with ProductFile(
        tmp_path / "a.tif", grid.placement, 3, np.dtype("uint8"), run_key="k", tile=256, **options
    ) as file:
        for index in range(64):
            if index == 9:
                file.append(index, np.full((3, 256, 256), 7, np.uint8), None)
            elif index % 2:
                file.append(index, np.zeros((3, 256, 256), np.uint8), np.zeros((256, 256), bool))
            else:
                file.append_empty(index)
        facts = file.complete()
    assert facts.empty_tiles == 63
    assert facts.bytes < 220_000
    assert read_tiff_layouts(tmp_path / "a.tif")[0].present.sum() == 1
    with rasterio.open(tmp_path / "a.tif") as opened:
        found = opened.read()
    assert (found[:, 256:512, 256:512] == 7).all()
    assert (found > 0).sum() == 3 * 256 * 256


def test_the_order_of_tiles_does_not_matter(tmp_path: Path) -> None:
    """Workers finish in any order; the bytes of the product are the same."""
    pixels, valid = scene(3, "uint8")
    for options in ({"compress": "none", "overviews": False}, {"compress": "deflate"}, {"nodata": "mask"}):
        seen = set()
        for seed in range(3):
            path = tmp_path / f"{seed}" / "a.tif"
            path.parent.mkdir(exist_ok=True)
            with ProductFile(path, PLACE, 3, pixels.dtype, run_key="k", tile=128, overwrite=True, **options) as file:
                fill(file, pixels, valid, iter(np.random.default_rng(seed).permutation(20).tolist()))
                file.complete()
            seen.add(path.read_bytes())
        assert len(seen) == 1


def test_a_run_continues_with_its_own_key_only(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    pixels, valid = scene(3, "uint8")
    make(path, pixels, valid)
    undisturbed = path.read_bytes()
    path.unlink()
    with ProductFile(path, PLACE, 3, pixels.dtype, run_key="k", tile=128) as file:
        fill(file, pixels, valid, iter(range(9)))
        with pytest.raises(PhotoplanError, match="11 tiles are missing, the first is 9"):
            file.complete()
    assert not path.exists()
    with ProductFile(path, PLACE, 3, pixels.dtype, run_key="other", tile=128) as file:
        assert not file.finished
        fill(file, pixels, valid, iter(range(9)))
    with ProductFile(path, PLACE, 3, pixels.dtype, run_key="other", tile=128) as file:
        assert file.finished == set(range(9))
        fill(file, pixels, valid, iter(range(9, 20)))
        facts = file.complete({"SOURCE": "test"})
    assert path.read_bytes() == undisturbed
    assert facts.moved_values == (pixels[:, valid] == 0).sum()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dtype": np.dtype("int32")}, "type int32; allowed are uint8"),
        ({"compress": "lzma"}, "compression 'lzma'; allowed are none"),
        ({"compress": "jpeg", "bands": 4}, "JPEG takes one or three bands"),
        ({"nodata": 300}, "whole numbers from 0 to 255"),
        ({"tile": 120}, "a multiple of 16"),
    ],
)
def test_wrong_use_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    options = {"bands": 3, "dtype": np.dtype("uint8"), "run_key": "k"} | change
    with pytest.raises(UsageError, match=message):
        ProductFile(tmp_path / "a.tif", PLACE, **options)


def test_a_tile_of_another_shape_or_type_is_refused(tmp_path: Path) -> None:
    with ProductFile(tmp_path / "a.tif", PLACE, 3, np.dtype("uint8"), run_key="k", tile=256) as file:
        for wrong in (
            np.zeros((3, 256, 256), np.int16),
            np.zeros((1, 256, 256), np.uint8),
            np.zeros((3, 256, 255), np.uint8),
        ):
            with pytest.raises(UsageError, match="tile 0 of shape"):
                file.append(0, wrong)
        with pytest.raises(UsageError, match="tiles 0 to 5"):
            file.append_empty(6)


BIG = """
import sys, numpy as np
from pathlib import Path
from photoplan.geometry.grid import MapGrid
from photoplan.io.product import ProductFile
from photoplan.io.store import peak_memory_bytes
grid = MapGrid(0, 0, 0.1, 9000, 6000, "EPSG:32633")
tile = np.random.default_rng(0).integers(1, 255, (3, 512, 512), dtype=np.uint8)
with ProductFile(Path(sys.argv[1]), grid.placement, 3, np.dtype("uint8"), run_key="k", compress="lzw") as file:
    file.append(0, tile)
    before = peak_memory_bytes()
    for i, w in enumerate(file.windows):
        file.append(i, tile[:, :w.height, :w.width])
    file.complete()
print(peak_memory_bytes() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="memory is measured by the system's own count")
def test_fault_06_memory_does_not_grow_with_the_product(tmp_path: Path) -> None:
    """162 MB of pixels with overviews; GDAL's cache takes 32 MiB, compression and overviews about as much."""
    out = subprocess.run(
        [sys.executable, "-c", BIG, str(tmp_path / "a.tif")], capture_output=True, text=True, check=True
    )
    assert int(out.stdout) < 150 << 20

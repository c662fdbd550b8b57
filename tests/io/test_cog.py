"""Cloud-optimised: small header first, overviews inside, the largest picture's blocks last."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.shutil

from photoplan.errors import PhotoplanError, UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.io import product as product_module
from photoplan.io.disk import CogOptions, write_cog
from photoplan.io.product import ProductFile
from photoplan.io.raster_info import TiffLayout, read_tiff_layout, read_tiff_layouts

GRID = MapGrid(0, 0, 1, 1500, 1100, "EPSG:32633")
PLACE = GRID.placement


def product(path: Path, **options: Any) -> list[TiffLayout]:
    tile = np.random.default_rng(1).integers(1, 250, (3, 256, 256), dtype=np.uint8)
    with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k", tile=256, **options) as file:
        for index in np.random.default_rng(2).permutation(len(file.windows)).tolist():
            window = file.windows[index]
            if index != 7:
                file.append(index, tile[:, : window.height, : window.width])
            else:
                file.append_empty(index)
        file.complete()
    return read_tiff_layouts(path)


@pytest.mark.parametrize(
    "options",
    [
        {"compress": "none", "overviews": False},
        {"compress": "none", "overviews": True},
        {"compress": "none", "overviews": False, "nodata": "mask"},
        {"compress": "deflate"},
        {"compress": "zstd", "nodata": "mask"},
        {"compress": "jpeg"},
    ],
    ids=str,
)
def test_structure(tmp_path: Path, options: dict[str, Any]) -> None:
    """The rules of a cloud-optimised GeoTIFF (OGC 21-026), read from the bytes and not through GDAL."""
    layouts = product(tmp_path / "a.tif", **options)
    pictures = [layout for layout in layouts if layout.samples == 3]
    first_block = min(int(layout.offsets[layout.counts > 0].min()) for layout in layouts)
    # All directories and block tables stand before the first block.
    for layout in layouts:
        assert layout.directory < first_block
        for place in (layout.offsets_array, layout.counts_array):
            assert place.position + place.count * np.dtype(place.dtype).itemsize <= first_block
    # Tiled, from large to small, halved each time.
    sizes = np.array([layout.size for layout in pictures])
    wanted = np.array([1500, 1100]) / 2 ** np.arange(len(pictures))[:, None]
    assert (np.abs(sizes - wanted) < 1).all()
    assert len(pictures) == (4 if options.get("overviews", True) else 1)
    assert all(layout.block == (256, 256) for layout in pictures)
    # Blocks of the overviews stand before the blocks of the picture, the smallest first; in row order.
    starts = []
    for layout in reversed(pictures):
        offsets = layout.offsets[layout.counts > 0].astype(np.int64)
        assert (np.diff(offsets) > 0).all()
        starts += [int(offsets[0]), int(offsets[-1])]
    assert starts == sorted(starts)
    assert not pictures[0].present[0].ravel()[7]


def test_plain_products_have_the_size_of_their_pixels(tmp_path: Path) -> None:
    layout = product(tmp_path / "a.tif", compress="none", overviews=False)[0]
    assert layout.compression == 1
    assert (tmp_path / "a.tif").stat().st_size < 29 * 256 * 256 * 3 + 4096
    assert {int(count) for count in layout.counts} == {0, 256 * 256 * 3}


def test_overviews_are_averages_of_valid_pixels(tmp_path: Path) -> None:
    grid = MapGrid(0, 0, 1, 512, 256, "EPSG:32633")
    pixels = np.random.default_rng(4).integers(1, 250, (1, 256, 512)).astype(np.float32)
    valid = np.random.default_rng(5).random((256, 512)) > 0.3
    with ProductFile(tmp_path / "a.tif", grid.placement, 1, np.dtype("float32"), run_key="k", tile=256) as file:
        for index, window in enumerate(file.windows):
            cols = slice(window.col, window.stop[0])
            file.append(index, pixels[:, :, cols], valid[:, cols])
        file.complete()
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as opened:
        found = opened.read(1)
    masked = np.ma.array(pixels[0], mask=~valid).reshape(128, 2, 256, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(found, masked.filled(np.nan), rtol=1e-6)


@pytest.mark.parametrize("options", [{"compress": "none", "overviews": False}, {"nodata": "mask"}], ids=str)
def test_fault_24_products_over_4_gb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]) -> None:
    """The large form of TIFF, forced on a small product: the same pixels, positions of eight bytes."""
    product(tmp_path / "small.tif", **options)
    monkeypatch.setattr(product_module, "_BIG", 0)
    layouts = product(tmp_path / "big.tif", **options)
    if options.get("compress") == "none":
        assert (tmp_path / "big.tif").read_bytes()[2] == 43
        assert np.dtype(layouts[0].offsets_array.dtype).itemsize == 8
    with rasterio.open(tmp_path / "small.tif") as small, rasterio.open(tmp_path / "big.tif") as big:
        np.testing.assert_array_equal(small.read(), big.read())
        np.testing.assert_array_equal(small.dataset_mask(), big.dataset_mask())


@pytest.mark.parametrize("big", ["NO", "YES"])
@pytest.mark.parametrize("order", ["LITTLE", "BIG"])
@pytest.mark.parametrize("interleave", ["pixel", "band"])
def test_layout_reads_what_gdal_wrote(tmp_path: Path, big: str, order: str, interleave: str) -> None:
    """The directory reader against GDAL's own block table and the raw bytes."""
    path = tmp_path / "a.tif"
    pixels = np.random.default_rng(6).integers(0, 60_000, (2, 70, 90)).astype(np.uint16)
    profile = {"count": 2, "height": 70, "width": 90, "dtype": "uint16", "tiled": True, "blockxsize": 32}
    profile |= {"blockysize": 16, "bigtiff": big, "endianness": order, "interleave": interleave}
    with rasterio.open(path, "w", driver="GTiff", **profile) as file:
        file.write(pixels)
    layout = read_tiff_layout(path)
    assert (layout.size, layout.samples, layout.bits, layout.block) == ((90, 70), 2, 16, (32, 16))
    assert (layout.grid, layout.planar) == ((3, 5), interleave == "band")
    with rasterio.open(path) as file:
        for band in (1, 2):
            index = (band - 1) * 15 * layout.planar + 1 * 3 + 2
            wanted = file.get_tag_item("BLOCK_OFFSET_2_1", "TIFF", bidx=band)
            assert int(layout.offsets[index]) == int(wanted)
    raw = path.read_bytes()[int(layout.offsets[0]) :][: 32 * 16 * 2 * (1 if layout.planar else 2)]
    block = np.frombuffer(raw, "<u2" if order == "LITTLE" else ">u2").reshape(16, 32, -1)
    np.testing.assert_array_equal(block[..., 0], pixels[0, :16, :32])


def test_wrong_options_are_named() -> None:
    for options, message in [
        ({"compress": "rar"}, "compression 'rar'"),
        ({"tile": 64}, "from 128 to 4096"),
        ({"quality": 0}, "quality 0"),
    ]:
        with pytest.raises(UsageError, match=message):
            CogOptions(**options)  # type: ignore[arg-type]


def test_what_gdal_grumbles_about_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    product(tmp_path / "a.tif", compress="none", overviews=False)
    copy = rasterio.shutil.copy
    monkeypatch.setattr(rasterio.shutil, "copy", lambda *a, **k: copy(*a, **(k | {"nonsense": 1, "quality": "many"})))
    with pytest.raises(PhotoplanError, match="could not write it cleanly"):
        write_cog(tmp_path / "a.tif", tmp_path / "b.tif", CogOptions(), np.dtype("uint8"))


#: Bytes of a value by TIFF's types (TIFF 6.0, and 13, 16 to 18 of BigTIFF).
TYPES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}


def tags_of(path: Path) -> list[dict[int, tuple[int, int, bytes]]]:
    """Type, count and bytes of every tag of every directory, read as a strict reader does."""
    data = path.read_bytes()
    order = {b"II": "<", b"MM": ">"}[data[:2]]
    big = struct.unpack(order + "H", data[2:4])[0] == 43
    size, width, entry, count_as = (8, "Q", 20, "Q") if big else (4, "I", 12, "H")
    at = struct.unpack(order + width, data[8:16] if big else data[4:8])[0]
    found = []
    while at:
        step = struct.calcsize(order + count_as)
        number = struct.unpack(order + count_as, data[at : at + step])[0]
        tags = {}
        for k in range(number):
            start = at + step + k * entry
            tag, kind = struct.unpack(order + "HH", data[start : start + 4])
            count = struct.unpack(order + width, data[start + 4 : start + 4 + size])[0]
            place = start + 4 + size
            if count * TYPES[kind] > size:
                place = struct.unpack(order + width, data[place : place + size])[0]
            assert place + count * TYPES[kind] <= len(data), (tag, "beyond the file")
            assert tag > max(tags, default=0), (tag, "out of order or twice")
            tags[tag] = kind, count, data[place : place + count * TYPES[kind]]
        found.append(tags)
        end = at + step + number * entry
        at = struct.unpack(order + width, data[end : end + size])[0]
    return found


@pytest.mark.parametrize(
    "options", [{"compress": "none", "overviews": False}, {"compress": "deflate", "nodata": "mask"}], ids=str
)
def test_strict_readers_have_nothing_to_complain_of(tmp_path: Path, options: dict[str, Any]) -> None:
    """Directories by the letter of TIFF 6.0: tags in order, known types, values within the file, texts that end."""
    product(tmp_path / "a.tif", **options)
    for number, tags in enumerate(tags_of(tmp_path / "a.tif")):
        assert {256, 257, 258, 259, 262, 277, 322, 323, 324, 325} <= set(tags)
        assert (254 in tags) or number == 0
        assert tags[324][1] == tags[325][1]
        for tag, (kind, count, value) in tags.items():
            assert count > 0, tag
            if kind == 2:
                assert value.endswith(b"\0") and value.isascii(), (tag, value)

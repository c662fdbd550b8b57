"""Hostile and damaged rasters: refused from their header or at the read, by name, and quickly."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from tools.effort import at_most
from tools.thinned import some

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io import raster as raster_pixels
from photoplan.io.files import RasterLimits, check_plain_file
from photoplan.io.raster import RasterReader, TerrainReader
from photoplan.io.raster_info import read_info, read_tiff_layout

SIDE = 256
ALL = Window(0, 0, SIDE, SIDE)


def picture(bands: int = 3) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    noise = np.random.default_rng(5).normal(0, 6, (bands, SIDE, SIDE))
    return np.clip(120 + 80 * np.sin(x / 20) + 40 * np.cos(y / 9) + noise, 1, 254).astype(np.uint8)


FORMATS = {
    "plain.tif": ("GTiff", {"tiled": False, "blockysize": 16}),
    "tiles.tif": ("GTiff", {"tiled": True, "blockxsize": 64, "blockysize": 64}),
    "deflate.tif": (
        "GTiff",
        {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate", "predictor": 2},
    ),
    "lzw.tif": ("GTiff", {"compress": "lzw", "blockysize": 16}),
    "zstd.tif": ("GTiff", {"compress": "zstd", "tiled": True, "blockxsize": 64, "blockysize": 64}),
    "jpeg.tif": ("GTiff", {"compress": "jpeg", "photometric": "ycbcr", "interleave": "pixel", "blockysize": 16}),
    "a.jpg": ("JPEG", {}),
    "progressive.jpg": ("JPEG", {"progressive": True}),
    "a.png": ("PNG", {}),
    "a.jp2": ("JP2OpenJPEG", {"reversible": "YES", "quality": 100}),
    "a.bmp": ("BMP", {}),
}


def write(path: Path, name: str) -> Path:
    driver, options = FORMATS[name]
    pixels = picture()
    profile = {"count": 3, "height": SIDE, "width": SIDE, "dtype": "uint8"}
    with rasterio.open(path / name, "w", driver=driver, **(profile | options)) as file:
        file.write(pixels)
    return path / name


class TestFault09Disguise:
    """A source is what its bytes say; nothing leads to the network or to other files."""

    @pytest.mark.parametrize(
        "text",
        [
            "/vsicurl/http://localhost/a.tif",
            "/vsizip/a.zip/a.tif",
            "//vsimem/a.tif",
            "\\vsimem\\a.tif",
            "http://localhost/a.tif",
            "s3://bucket/a.tif",
            "file:///etc/hostname",
            'NETCDF:"a.nc":band',
            "GTIFF_DIR:1:a.tif",
            "JP2:a.jp2",
            "<VRTDataset rasterXSize='1' rasterYSize='1'/>",
            '{"type": "gdal_virtual"}',
            "",
        ],
    )
    def test_fault_09_names_that_are_no_files(self, text: str) -> None:
        with pytest.raises(InputError, match=r"not followed|document|empty"):
            RasterReader(text)  # type: ignore[arg-type]

    @pytest.mark.parametrize("name", ["a.tif", "a.jpg", "a.vrt"])
    def test_fault_09_virtual_raster_under_another_name(self, tmp_path: Path, name: str) -> None:
        source = write(tmp_path, "tiles.tif")
        vrt = tmp_path / name
        with rasterio.open(source) as file:
            rasterio.shutil.copy(file, tmp_path / "made.vrt", driver="VRT")
        (tmp_path / "made.vrt").replace(vrt)
        with rasterio.open(vrt) as file:
            assert file.driver == "VRT", "GDAL itself would follow it"
        with pytest.raises(InputError, match=r"XML document.*virtual raster"):
            RasterReader(vrt)
        np.testing.assert_array_equal(RasterReader(vrt, allow_remote=True).read(ALL)[0], picture())

    def test_fault_09_mask_and_overviews_beside_lead_nowhere(self, tmp_path: Path) -> None:
        source = write(tmp_path, "tiles.tif")
        for suffix in (".msk", ".ovr"):
            side = source.with_name(source.name + suffix)
            side.write_text("<VRTDataset rasterXSize='1' rasterYSize='1'/>")
            with pytest.raises(InputError, match=f"tiles.tif{suffix}: a mask or overview file .* must be a TIFF"):
                read_info(source)
            side.unlink()
        aux = source.with_name("tiles.tif.aux.xml")
        aux.write_text(
            '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/http://localhost/x</MDI>'
            "</Metadata></PAMDataset>"
        )
        with pytest.raises(InputError, match=r"aux\.xml: leads to other files"):
            read_info(source)

    def test_fault_09_overview_file_named_inside_the_tiff(self, tmp_path: Path) -> None:
        source = write(tmp_path, "tiles.tif")
        with rasterio.open(source, "r+") as file:
            file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE="/vsicurl/http://localhost/x")
        source.with_name("tiles.tif.aux.xml").unlink(missing_ok=True)
        with pytest.raises(InputError, match="metadata lead to other files"):
            read_info(source)

    @pytest.mark.parametrize("kind", ["folder", "pipe", "absent", "empty", "text"])
    def test_fault_09_things_that_are_no_rasters(self, tmp_path: Path, kind: str) -> None:
        path = tmp_path / "a.tif"
        if kind == "folder":
            path.mkdir()
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "empty":
            path.touch()
        elif kind == "text":
            path.write_text("hello")
        expected = {
            "folder": "not a plain file",
            "pipe": "not a plain file",
            "absent": "no such file",
            "empty": "is empty",
            "text": "not a raster",
        }[kind]
        with pytest.raises(InputError, match=expected):
            RasterReader(path)

    def test_a_colon_in_a_folder_is_a_name_like_any_other(self, tmp_path: Path) -> None:
        path = tmp_path / "a:b.tif"
        path.write_bytes(b"x")
        assert check_plain_file(path) == path


def tiff_header(width: int, height: int, samples: int = 3, *, compression: int = 1, tile: int = 0) -> bytes:
    """A classic TIFF with one strip or tile of a few bytes and a header that promises `width` × `height`."""
    tags = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, compression), (262, 3, 1), (277, 3, samples)]
    tags += [(273, 4, 8), (278, 4, height), (279, 4, 64)] if not tile else []
    tags += [(322, 4, tile), (323, 4, tile), (324, 4, 8), (325, 4, 64)] if tile else []
    entries = b"".join(struct.pack("<HHII", code, kind, 1, value) for code, kind, value in sorted(tags))
    return b"II*\x00" + struct.pack("<I", 72) + bytes(64) + struct.pack("<H", len(tags)) + entries + bytes(4)


def png_header(width: int, height: int) -> bytes:
    """A complete PNG of grey zeros in one compressed stream, as small as such a picture gets."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


class TestFault07Bombs:
    """Headers that promise more than can be meant, refused in under a second."""

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (tiff_header(2_000_000_000, 2_000_000_000), "promises 2000000000 × 2000000000 pixels"),
            (tiff_header(1_000_000, 1_000_000, compression=8), "promises 1000000 × 1000000 pixels"),
            (tiff_header(60_000, 60_000, compression=8), "one block of 60000 × 60000"),
            (tiff_header(30_000, 30_000, compression=8, tile=30_000), "one block of 30000 × 30000"),
            (tiff_header(0, 5), "0 × 5"),
            (tiff_header(4_000_000_000, 1, compression=8), "one block of 4000000000 × 1"),
            (png_header(60_000, 60_000), "times what is stored"),
            (
                b"BM" + struct.pack("<IIIIiiHHIIIIII", 10**6, 0, 54, 40, 10**6, 10**6, 1, 24, 0, 0, 0, 0, 0, 0),
                "more than the limit|cannot be opened",
            ),
        ],
        ids=["exa", "tera", "strip", "tile", "nothing", "line", "png", "bmp"],
    )
    def test_fault_07_refused_from_the_header(self, tmp_path: Path, content: bytes, message: str) -> None:
        path = tmp_path / "bomb.tif"
        path.write_bytes(content)
        with at_most(1), pytest.raises(InputError, match=message) as error:
            RasterReader(path)
        assert "bomb.tif" in str(error.value)

    def test_fault_07_sparse_file_of_a_petabyte(self, tmp_path: Path) -> None:
        path = tmp_path / "sparse.tif"
        profile = {
            "width": 4_000_000,
            "height": 4_000_000,
            "count": 1,
            "dtype": "uint8",
            "sparse_ok": True,
            "tiled": True,
            "blockxsize": 4096,
            "blockysize": 4096,
            "bigtiff": "YES",
        }
        with rasterio.open(path, "w", driver="GTiff", **profile):
            pass
        with at_most(1):
            with pytest.raises(InputError, match="more than the limit"):
                RasterReader(path)
            with pytest.raises(InputError, match="more than the limit"):
                TerrainReader(path)

    def test_fault_07_a_legitimate_sparse_file_passes(self, tmp_path: Path) -> None:
        path = tmp_path / "sparse.tif"
        profile = {
            "width": 100_000,
            "height": 100_000,
            "count": 1,
            "dtype": "uint8",
            "sparse_ok": True,
            "tiled": True,
            "blockxsize": 512,
            "blockysize": 512,
            "nodata": 0,
        }
        with rasterio.open(path, "w", driver="GTiff", **profile):
            pass
        assert path.stat().st_size < 1_000_000
        valid = RasterReader(path).read(Window(5000, 5000, 10, 10))[1]
        assert valid is not None
        assert not valid.any()

    def test_fault_07_limits_are_explicit(self, tmp_path: Path) -> None:
        path = write(tmp_path, "plain.tif")
        with pytest.raises(InputError, match="more than the limit of 1e\\+03"):
            RasterReader(path, limits=RasterLimits(max_pixels=1000))
        with pytest.raises(InputError, match="must be positive"):
            RasterLimits(max_pixels=-1)


class TestFault08Damage:
    """Cut-off and changed files end in an error with file, band and window; never in zeros."""

    @pytest.mark.parametrize("name", FORMATS)
    @pytest.mark.parametrize("share", some([0.02, 0.3, 0.7, 0.95, 0.99], 0, 2, 4))
    def test_fault_08_cut_off(self, tmp_path: Path, name: str, share: float) -> None:
        path = write(tmp_path, name)
        raw = path.read_bytes()
        np.testing.assert_allclose(RasterReader(path).read(ALL)[0].astype(int), picture(), atol=60)
        path.write_bytes(raw[: int(len(raw) * share)])
        with pytest.raises(InputError, match=name):
            RasterReader(path).read(ALL)

    @pytest.mark.parametrize("name", ["plain.tif", "deflate.tif", "lzw.tif", "zstd.tif", "jpeg.tif", "a.png", "a.jp2"])
    def test_fault_08_the_last_byte_is_missing(self, tmp_path: Path, name: str) -> None:
        path = write(tmp_path, name)
        path.write_bytes(path.read_bytes()[:-1])
        with pytest.raises(InputError, match=name):
            RasterReader(path).read(ALL)

    @pytest.mark.parametrize("name", ["deflate.tif", "a.png", "lzw.tif", "jpeg.tif", "a.jpg", "progressive.jpg"])
    def test_fault_08_a_run_of_changed_bytes(self, tmp_path: Path, name: str) -> None:
        """A hundred bytes in the middle become 0xFF: what every checksum and decoder can notice."""
        path = write(tmp_path, name)
        raw = bytearray(path.read_bytes())
        middle = len(raw) // 2
        raw[middle : middle + 100] = b"\xff" * 100
        path.write_bytes(raw)
        with pytest.raises(InputError, match=rf"{name}: .*window col 0 row 0 {SIDE} × {SIDE}"):
            RasterReader(path).read(ALL)

    def test_fault_08_the_band_is_named_and_good_windows_are_read(self, tmp_path: Path) -> None:
        path = write(tmp_path, "deflate.tif")
        layout = read_tiff_layout(path)
        # Tile in row 1, column 2 (64 pixels each).
        block = 1 * layout.grid[0] + 2
        raw = bytearray(path.read_bytes())
        start = int(layout.offsets[block])
        raw[start : start + 40] = b"\x00" * 40
        path.write_bytes(raw)
        reader = RasterReader(path)
        with pytest.raises(InputError, match=r"deflate\.tif: band (\d|all), window col 130 row 70 10 × 10: .*damaged"):
            reader.read(Window(130, 70, 10, 10))
        good = Window(0, 130, SIDE, SIDE - 130)
        np.testing.assert_array_equal(reader.read(good)[0], picture()[:, 130:])

    def test_fault_08_every_flipped_bit_of_a_deflate_block_is_seen(self, tmp_path: Path) -> None:
        """GDAL alone lets many of them pass as data: it does not look at the blocks' checksums."""
        path = write(tmp_path, "deflate.tif")
        layout = read_tiff_layout(path)
        raw = path.read_bytes()
        rng = np.random.default_rng(11)
        for i in range(20):
            changed = bytearray(raw)
            block = int(rng.integers(len(layout.offsets)))
            place = int(layout.offsets[block]) + int(rng.integers(2, int(layout.counts[block])))
            changed[place] ^= 1 << int(rng.integers(8))
            # A name of its own: what was found whole is not looked at again.
            path = tmp_path / f"{i}.tif"
            path.write_bytes(changed)
            with pytest.raises(InputError, match="damaged"):
                RasterReader(path).read(ALL)

    def test_fault_08_zeros_inside_a_deflate_block_are_seen(self, tmp_path: Path) -> None:
        path = write(tmp_path, "deflate.tif")
        layout = read_tiff_layout(path)
        raw = bytearray(path.read_bytes())
        middle = int(layout.offsets[5]) + int(layout.counts[5]) // 2
        raw[middle : middle + 200] = bytes(200)
        path.write_bytes(raw)
        with pytest.raises(InputError, match=r"deflate\.tif: .*damaged"):
            RasterReader(path).read(ALL)

    def test_fault_08_a_directory_that_lies(self, tmp_path: Path) -> None:
        path = write(tmp_path, "plain.tif")
        layout = read_tiff_layout(path)
        raw = bytearray(path.read_bytes())
        dtype = np.dtype(layout.offsets_array.dtype)
        place = layout.offsets_array.position + 3 * dtype.itemsize
        raw[place : place + dtype.itemsize] = np.array(len(raw) + 5, dtype).tobytes()
        path.write_bytes(raw)
        with pytest.raises(InputError, match=r"1 of 16 blocks lie beyond its end.*row 48"):
            RasterReader(path)

    def test_fault_08_ascii_grid_cut_off(self, tmp_path: Path) -> None:
        path = tmp_path / "a.asc"
        head = "ncols 5\nnrows 4\nxllcorner 0\nyllcorner 0\ncellsize 2\nNODATA_value -9999\n"
        path.write_text(head + "\n".join(["1 2 3 4 5"] * 2))
        with pytest.raises(InputError, match=r"a\.asc"):
            TerrainReader(path).read(Window(0, 0, 5, 4))


@pytest.mark.parametrize(
    ("dtype", "predictor"), [("float32", 1), ("float32", 3), ("float64", 3), ("int16", 2), ("float32", 2)]
)
class TestHeightsAreNotDecodedTwice:
    """A block of one band is compared with its checksum by its pixels; only what does not agree is decoded again."""

    def heights(self, path: Path, dtype: str, predictor: int) -> np.ndarray:
        values = np.random.default_rng(3).normal(400, 30, (128, 192)).round(1).astype(dtype)
        profile = {"width": 192, "height": 128, "count": 1, "dtype": dtype, "compress": "deflate"}
        place = {"crs": "EPSG:32633", "transform": rasterio.Affine(2, 0, 4e5, 0, -2, 5e6)}
        tiles = {"tiled": True, "blockxsize": 64, "blockysize": 64, "predictor": predictor}
        with rasterio.open(path, "w", **profile, **place, **tiles) as file:
            file.write(values, 1)
        return values

    def test_whole_blocks(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dtype: str, predictor: int) -> None:
        path = tmp_path / "heights.tif"
        values = self.heights(path, dtype, predictor)
        info = read_info(path)
        monkeypatch.setattr(raster_pixels, "_whole", None)
        for window in Window(0, 0, 192, 128).tiles(64):
            got, _ = raster_pixels.read_pixels(info, window)
            np.testing.assert_array_equal(got[0], values[window.slices(Window(0, 0, 192, 128))])

    def test_flipped_bits(self, tmp_path: Path, dtype: str, predictor: int) -> None:
        self.heights(tmp_path / "heights.tif", dtype, predictor)
        raw, layout = (tmp_path / "heights.tif").read_bytes(), read_tiff_layout(tmp_path / "heights.tif")
        rng = np.random.default_rng(5)
        for i in range(12):
            changed = bytearray(raw)
            changed[int(layout.offsets[1]) + int(rng.integers(2, int(layout.counts[1])))] ^= 1 << int(rng.integers(8))
            path = tmp_path / f"{i}.tif"
            path.write_bytes(changed)
            with pytest.raises(InputError, match="damaged"):
                raster_pixels.read_pixels(read_info(path), Window(64, 0, 64, 64))

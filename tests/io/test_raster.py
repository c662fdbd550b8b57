"""Source images by windows: values, validity, positions, formats."""

from __future__ import annotations

import os
import pickle
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io import raster as raster_module
from photoplan.io.disk import close_handles, not_georeferenced
from photoplan.io.raster import DecodedPicture, RasterReader, decoded_picture, not_nodata
from photoplan.io.raster_info import read_info

WINDOW = Window(3, 5, 20, 11)


def make(path: Path, pixels: np.ndarray, driver: str = "GTiff", **profile: Any) -> Path:
    """Write a small raster; profile as rasterio takes it, with `colours`, `mask`, `tags` beside it."""
    colours, mask, palette = profile.pop("colours", None), profile.pop("mask", None), profile.pop("palette", None)
    options = {"count": len(pixels), "height": pixels.shape[1], "width": pixels.shape[2], "dtype": pixels.dtype}
    with rasterio.open(path, "w", driver=driver, **(options | profile)) as file:
        if colours:
            file.colorinterp = colours
        if palette:
            file.write_colormap(1, palette)
        file.write(pixels)
        if mask is not None:
            file.write_mask(mask)
    return path


def scene(bands: int = 3, dtype: Any = np.uint8, shape: tuple[int, int] = (40, 50)) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.integers(1, 250, (bands, *shape)).astype(dtype)


def part(pixels: np.ndarray, window: Window = WINDOW) -> np.ndarray:
    right, bottom = window.stop
    return pixels[..., window.row : bottom, window.col : right]


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "deflate"}])
def test_windows_are_the_pixels_of_the_file(tmp_path: Path, dtype: str, layout: dict[str, Any]) -> None:
    pixels = scene(4, dtype)
    path = make(tmp_path / "a.tif", pixels, photometric="MINISBLACK", **layout)
    reader = RasterReader(path)
    assert (reader.size, reader.bands, reader.dtype) == ((50, 40), 4, np.dtype(dtype))
    for window in [WINDOW, Window(0, 0, 50, 40), Window(49, 39, 1, 1)]:
        found, valid = reader.read(window)
        assert valid is None
        np.testing.assert_array_equal(found, part(pixels, window))
        assert found.dtype == dtype


@pytest.mark.parametrize("window", [Window(0, 0, 51, 1), Window(-1, 0, 2, 2), Window(0, 39, 5, 2), Window(1, 1, 0, 3)])
def test_a_window_outside_is_refused(tmp_path: Path, window: Window) -> None:
    reader = RasterReader(make(tmp_path / "a.tif", scene()))
    with pytest.raises(UsageError, match="not inside the raster of 50 × 40"):
        reader.read(window)


def test_readers_pickle_and_are_read_from_threads(tmp_path: Path) -> None:
    pixels = scene()
    reader = pickle.loads(
        pickle.dumps(
            RasterReader(make(tmp_path / "a.tif", pixels, tiled=True, blockxsize=16, blockysize=16, compress="lzw"))
        )
    )
    wrong: list[str] = []

    def work(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(50):
            window = Window(int(rng.integers(40)), int(rng.integers(30)), 10, 10)
            if not np.array_equal(reader.read(window)[0], part(pixels, window)):
                wrong.append(str(window))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_handles_close_and_a_replaced_file_is_read_anew(tmp_path: Path) -> None:
    path = make(tmp_path / "a.tif", scene())
    reader = RasterReader(path)
    before = reader.read(WINDOW)[0]
    other = make(tmp_path / "b.tif", 251 - scene())
    other.replace(path)
    np.testing.assert_array_equal(reader.read(WINDOW)[0], 251 - before)
    close_handles()
    descriptors = [link.readlink().name for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert "a.tif" not in descriptors


def test_info_refers_to_pixel_centres(tmp_path: Path) -> None:
    transform = rasterio.Affine(0.5, 0.1, 1000.0, 0.2, -0.4, 2000.0)
    info = read_info(make(tmp_path / "a.tif", scene(), transform=transform, crs="EPSG:32633", nodata=0))
    x0, xx, xy, y0, yx, yy = info.to_map or ()
    # The centre of pixel (col, row) is at (col + 1/2, row + 1/2) of GDAL's corner system.
    for col, row in [(0, 0), (7, 3)]:
        expected = transform @ (col + 0.5, row + 0.5)
        assert (x0 + xx * col + xy * row, y0 + yx * col + yy * row) == pytest.approx(expected, abs=1e-9)
    assert info.crs is not None
    assert "UTM zone 33N" in info.crs
    assert info.nodata == 0
    assert read_info(make(tmp_path / "b.tif", scene())).to_map is None


def test_pixel_is_point_names_the_same_places(tmp_path: Path) -> None:
    """A file that says AREA_OR_POINT=Point stores centres; GDAL moves it, so nothing moves here."""
    transform = rasterio.Affine(10.0, 0, 500.0, 0, -10.0, 900.0)
    area = make(tmp_path / "area.tif", scene(), transform=transform, crs="EPSG:32633")
    point = tmp_path / "point.tif"
    with rasterio.open(area) as source:
        profile = source.profile
        with rasterio.open(point, "w", **profile) as target:
            target.update_tags(AREA_OR_POINT="Point")
            target.write(source.read())
    with rasterio.open(point) as file:
        assert file.tags()["AREA_OR_POINT"] == "Point"
    # The tie point of the tag itself is half a pixel further in, so the file really says something else.
    assert point.read_bytes() != area.read_bytes()
    assert read_info(point).to_map == read_info(area).to_map == (505.0, 10.0, 0.0, 895.0, 0.0, -10.0)


def test_compound_reference_system_and_unit(tmp_path: Path) -> None:
    info = read_info(make(tmp_path / "a.tif", scene(1), crs="EPSG:32633+5773", transform=rasterio.Affine.scale(2)))
    assert (info.height_system, info.metres_per_unit) == ("EPSG:5773", 1.0)
    feet = read_info(make(tmp_path / "b.tif", scene(1), crs="EPSG:2263+6360", transform=rasterio.Affine.scale(2)))
    assert feet.metres_per_unit == pytest.approx(1200 / 3937, rel=1e-12)
    plain = read_info(make(tmp_path / "c.tif", scene(1), crs="EPSG:32633", transform=rasterio.Affine.scale(2)))
    assert (plain.height_system, plain.band_unit, plain.metres_per_unit) == (None, None, None)


class TestFault22Validity:
    """Nodata, alpha, mask, not-a-number: a pixel is used only when every statement says so."""

    def test_fault_22_statements_that_disagree(self, tmp_path: Path) -> None:
        pixels = scene(4)
        pixels[:3, 5, 3] = 0  # nodata in all colours
        pixels[0, 5, 4] = 0  # one black band is still a colour
        pixels[3] = 255
        pixels[3, 6, 3] = 0  # transparent
        pixels[3, 6, 4] = 1  # hardly visible, but not transparent
        mask = np.full((40, 50), 255, np.uint8)
        mask[7, 3] = 0
        colours = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False):
            path = make(tmp_path / "a.tif", pixels, nodata=0, colours=colours, mask=mask, photometric="RGB")
        assert path.with_name("a.tif.msk").exists()
        reader = RasterReader(path)
        assert reader.bands == 3
        found, valid = reader.read(WINDOW)
        assert valid is not None
        expected = np.ones((11, 20), bool)
        expected[0, 0] = expected[1, 0] = expected[2, 0] = False
        np.testing.assert_array_equal(valid, expected)
        np.testing.assert_array_equal(found, part(pixels[:3]))

    @pytest.mark.parametrize("internal", [True, False])
    def test_fault_22_mask_inside_and_beside(self, tmp_path: Path, internal: bool) -> None:
        mask = np.full((40, 50), 255, np.uint8)
        mask[6, 5:9] = 0
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal):
            path = make(tmp_path / "a.tif", scene(), mask=mask)
        assert path.with_name("a.tif.msk").exists() is not internal
        info = read_info(path)
        assert info.has_mask
        valid = RasterReader(path).read(WINDOW)[1]
        assert valid is not None
        np.testing.assert_array_equal(valid, part(mask) > 0)
        assert RasterReader(path).read(Window(0, 10, 50, 20))[1] is None

    def test_fault_22_not_a_number_in_one_band(self, tmp_path: Path) -> None:
        pixels = scene(3, np.float32)
        pixels[1, 5, 3], pixels[2, 5, 4], pixels[:, 5, 5] = np.nan, np.inf, -9999
        valid = RasterReader(make(tmp_path / "a.tif", pixels, nodata=-9999)).read(WINDOW)[1]
        assert valid is not None
        assert not valid[0, :3].any()
        assert valid.sum() == 20 * 11 - 3

    @pytest.mark.parametrize("nodata", [-9999.0, 0.5, 256.0])
    def test_fault_22_nodata_that_the_type_cannot_hold_is_never_met(self, nodata: float) -> None:
        pixels = np.stack([np.arange(256, dtype=np.uint8).reshape(16, 16)] * 3)  # -9999 wrapped to a byte is 241
        assert not_nodata(pixels, nodata) is None
        valid = not_nodata(pixels, 241.0)
        assert valid is not None
        assert valid.sum() == 255

    def test_fault_22_blocks_that_were_never_written(self, tmp_path: Path) -> None:
        """A hole in a sparse file reads as zeros; without a nodata value they are not taken for black."""
        path = tmp_path / "a.tif"
        profile = {
            "width": 50,
            "height": 40,
            "count": 2,
            "dtype": "uint8",
            "sparse_ok": True,
            "tiled": True,
            "blockxsize": 16,
            "blockysize": 16,
        }
        with rasterio.open(path, "w", driver="GTiff", **profile) as file:
            file.write(np.full((2, 16, 16), 9, np.uint8), window=rasterio.windows.Window(16, 0, 16, 16))
        info = read_info(path)
        assert info.missing_blocks == 11
        assert any("never written" in text for text in info.warnings)
        found, valid = RasterReader(path).read(Window(10, 4, 30, 20))
        assert valid is not None
        expected = np.zeros((20, 30), bool)
        expected[:12, 6:22] = True
        np.testing.assert_array_equal(valid, expected)
        assert (found[:, expected] == 9).all()


class TestFault24Formats:
    """Every usual kind of pixels is read correctly or refused by its name."""

    @pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.jp2", "a.bmp"])
    def test_fault_24_formats_go_by_content(self, tmp_path: Path, name: str) -> None:
        driver = {"jpg": "JPEG", "png": "PNG", "jp2": "JP2OpenJPEG", "bmp": "BMP"}[name[2:]]
        lossless = {"quality": 100, "reversible": "YES"} if driver == "JP2OpenJPEG" else {}
        pixels = np.broadcast_to(np.arange(50, dtype=np.uint8) * 4, (3, 40, 50)).copy()
        path = make(tmp_path / name, pixels, driver, **lossless)
        disguised = path.replace(tmp_path / "b.tif")
        info = read_info(disguised)
        assert (info.driver, info.bands) == (driver, 3)
        found, valid = RasterReader(disguised).read(WINDOW)
        assert valid is None
        assert np.abs(found.astype(int) - part(pixels)).max() <= (3 if driver == "JPEG" else 0)

    def test_fault_24_twelve_bits(self, tmp_path: Path) -> None:
        pixels = scene(1, np.uint16) * 16
        path = make(tmp_path / "a.tif", pixels, nbits=12)
        assert read_info(path).bits == 12
        np.testing.assert_array_equal(RasterReader(path).read(WINDOW)[0], part(pixels))

    def test_fault_24_palette_is_expanded(self, tmp_path: Path) -> None:
        index = (scene(1) % 5).astype(np.uint8)
        palette = {i: (10 * i, 200 - i, 7, 255) for i in range(4)} | {4: (1, 2, 3, 0)}
        path = make(tmp_path / "a.png", index, "PNG", palette=palette)
        reader = RasterReader(path)
        assert (reader.bands, reader.dtype) == (3, np.uint8)
        found, valid = reader.read(WINDOW)
        table = np.array([palette[i] for i in range(5)], np.uint8)
        np.testing.assert_array_equal(found, np.moveaxis(table[part(index)[0]][..., :3], -1, 0))
        np.testing.assert_array_equal(valid, part(index)[0] != 4)

    @pytest.mark.parametrize("kind", ["tiff", "jpeg"])
    def test_fault_24_cmyk_is_refused_by_name(self, tmp_path: Path, kind: str) -> None:
        if kind == "tiff":
            path = make(tmp_path / "a.tif", scene(4), photometric="CMYK")
        else:
            path = make(tmp_path / "a.jpg", scene(4), "JPEG")
        with pytest.raises(InputError, match=r"a\.(tif|jpg): CMYK.*convert"):
            RasterReader(path)

    def test_fault_24_one_bit_is_refused_by_name(self, tmp_path: Path) -> None:
        path = make(tmp_path / "a.tif", scene(1) % 2, nbits=1)
        with pytest.raises(InputError, match="1-bit image"):
            RasterReader(path)

    @pytest.mark.parametrize("dtype", ["int32", "uint32", "float64", "complex64", "int8"])
    def test_fault_24_types_are_refused_by_name(self, tmp_path: Path, dtype: str) -> None:
        path = make(tmp_path / "a.tif", scene(1, dtype))
        with pytest.raises(InputError, match=f"type {dtype}; allowed are uint8"):
            RasterReader(path)

    def test_fault_24_exif_rotation_is_reported_and_not_applied(self, tmp_path: Path) -> None:
        path = make(tmp_path / "a.jpg", scene(), "JPEG")
        before = RasterReader(path).read(WINDOW)[0]
        raw = path.read_bytes()
        # EXIF: little-endian TIFF header, one tag (0x0112 orientation, SHORT, 6 = turn right).
        tiff = (
            b"II*\x00\x08\x00\x00\x00" + b"\x01\x00" + b"\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00" + b"\0" * 4
        )
        body = b"Exif\x00\x00" + tiff
        path.write_bytes(raw[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + raw[2:])
        reader = RasterReader(path)
        assert reader.size == (50, 40)
        assert reader.info.orientation == 6
        assert any("used as stored" in text for text in reader.info.warnings)
        np.testing.assert_array_equal(reader.read(WINDOW)[0], before)

    def test_fault_24_sides_over_32767_and_over_4_gb(self, tmp_path: Path) -> None:
        """Both at once, by a sparse BigTIFF with two written tiles."""
        path = tmp_path / "a.tif"
        side = 70_000
        profile = {
            "width": side,
            "height": side,
            "count": 1,
            "dtype": "uint8",
            "sparse_ok": True,
            "tiled": True,
            "blockxsize": 512,
            "blockysize": 512,
            "bigtiff": "YES",
        }
        block = scene(1, shape=(368, 368))
        with rasterio.open(path, "w", driver="GTiff", **profile) as file:
            file.write(block, window=rasterio.windows.Window(side - 368, side - 368, 368, 368))
        reader = RasterReader(path)
        found, valid = reader.read(Window(side - 300, side - 200, 300, 200))
        assert valid is None
        np.testing.assert_array_equal(found, block[:, -200:, -300:])

    def test_fault_24_inverted_grey_is_said(self, tmp_path: Path) -> None:
        path = make(tmp_path / "a.tif", scene(1), photometric="MINISWHITE")
        assert any("white is stored as zero" in text for text in RasterReader(path).info.warnings)
        np.testing.assert_array_equal(RasterReader(path).read(WINDOW)[0], part(scene(1)))


def test_a_real_drone_image(block: Path) -> None:
    path = next(iter(sorted(block.rglob("*.jpg"))))
    reader = RasterReader(path)
    found, valid = reader.read(Window(100, 50, 64, 32))
    with rasterio.open(path) as file:
        expected = file.read(window=rasterio.windows.Window(100, 50, 64, 32))
    assert valid is None
    np.testing.assert_array_equal(found, expected)


@pytest.mark.skipif(os.name != "posix", reason="pictures are decoded once where files can be nameless")
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "rgba.png", "deep.png"])
def test_large_pictures_are_decoded_once(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Same pixels as from the file, in any order of windows, and the decoder runs once."""
    bands, dtype = {"a.jpg": (3, "uint8"), "a.png": (3, "uint8"), "rgba.png": (4, "uint8"), "deep.png": (1, "uint16")}[
        name
    ]
    pixels = scene(bands, dtype, (400, 500))
    path = make(tmp_path / name, pixels, "JPEG" if name.endswith("jpg") else "PNG")
    if bands == 4:
        pixels[3] = 255
        pixels[3, :50] = 0
        path = make(tmp_path / name, pixels, "PNG")
    direct = [RasterReader(path).read(window) for window in Window(0, 0, 500, 400).tiles(150)]
    monkeypatch.setattr(raster_module, "_SMALL", 1000)
    calls = []
    read = raster_module._from_file
    monkeypatch.setattr(raster_module, "_from_file", lambda *a: (calls.append(a), read(*a))[1])
    reader = RasterReader(path)
    tiles = list(Window(0, 0, 500, 400).tiles(150))
    for i in reversed(range(len(tiles))):
        found, valid = reader.read(tiles[i])
        np.testing.assert_array_equal(found, direct[i][0])
        assert (valid is None) is (direct[i][1] is None)
        if valid is not None:
            np.testing.assert_array_equal(valid, direct[i][1])
    assert len(calls) == 1
    # A look at the upper border reads that alone.
    top = RasterReader(make(tmp_path / f"other_{name}", pixels, "JPEG" if name.endswith("jpg") else "PNG"))
    found, _ = top.read(Window(100, 0, 40, 50))
    np.testing.assert_array_equal(found, direct[0][0][:, :50, 100:140])
    # Whether an alpha band is a mask is seen in the middle, too.
    assert len(calls) == (3 if bands == 4 else 2)
    assert calls[-1] == (top.info, Window(100, 0, 40, 50))


def test_threads_share_one_decoding() -> None:
    made = []

    def make_one() -> DecodedPicture:
        made.append(1)
        return DecodedPicture((300, 200), 2, np.dtype("uint8"), lambda w: np.full((2, w.height, w.width), 7, np.uint8))

    found: list[int] = []
    work = lambda: found.append(int(decoded_picture(("threads",), make_one).read(Window(3, 4, 10, 10)).sum()))  # noqa: E731
    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(made), found) == (1, [7 * 200] * 8)
    for other in range(3):
        decoded_picture((other,), make_one)
    decoded_picture(("threads",), make_one)
    assert len(made) == 5, "the two used last are kept"


@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_usual_nodata_values_that_are_not_declared_are_refused(tmp_path: Path, dtype: str) -> None:
    pixels = scene(2, dtype)
    pixels[0, 8, 9] = -9999  # in one band alone it is a value
    assert part(pixels).min() == -9999
    kept, _ = RasterReader(make(tmp_path / "one.tif", pixels)).read(WINDOW)
    assert np.array_equal(kept, part(pixels))
    pixels[1, 8, 9] = -9999
    if dtype == "float32":
        pixels[:, 9, 9] = np.nan
    reader = RasterReader(make(tmp_path / "both.tif", pixels))
    with pytest.raises(InputError, match=r"both\.tif: 1 pixels in window .* are -9999, .*gdal_edit -a_nodata -9999"):
        reader.read(WINDOW)
    assert reader.read(Window(20, 20, 10, 10))[1] is None
    _, valid = RasterReader(make(tmp_path / "declared.tif", pixels, nodata=-9999)).read(WINDOW)
    assert valid is not None and not valid[8 - WINDOW.row, 9 - WINDOW.col]
    mask = np.full(pixels.shape[1:], 255, np.uint8)
    mask[8, 9] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        masked = make(tmp_path / "masked.tif", pixels, mask=mask)
    assert RasterReader(masked).read(WINDOW)[1] is not None


def test_silence_about_georeferences_may_nest() -> None:
    """It hung for ever, waiting for itself."""

    def nested() -> None:
        with not_georeferenced(), not_georeferenced():
            pass

    thread = threading.Thread(target=nested, daemon=True)
    thread.start()
    thread.join(5)
    assert not thread.is_alive()

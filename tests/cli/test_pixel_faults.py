"""Pixels of every kind: the correct product, or a refusal by name."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from tools.command import OPTIONS, Here, refused
from tools.small_block import X0, Y0, Z0, Block, make_project, texture, write_image, write_terrain


class TestFaults22And24Pixels:
    @pytest.mark.parametrize("kind", ["nodata", "alpha", "mask", "all"])
    def test_fault_22_no_dark_fringes(self, photoplan: Here, small: Block, kind: str) -> None:
        """A bright image with an invalid part: whatever says so, no valid pixel of the product is darker than it."""
        pixels = np.full((3, 150, 200), 200, np.uint8)
        bad = np.zeros((150, 200), bool)
        bad[40:90, 70:130] = True
        pixels[:, bad] = 0
        options: dict[str, object] = {"nodata": 0} if kind in ("nodata", "all") else {}
        if kind in ("alpha", "all"):
            pixels = np.concatenate([pixels, np.where(bad, 0, 255)[None].astype(np.uint8)])
            if kind == "all":
                # Statements that disagree: alpha forgets the left half.
                pixels[3, :, :100] = 255
            options["photometric"] = "RGB"
        write_image(small.images[0], pixels, **options)
        if kind in ("alpha", "all"):
            with rasterio.open(small.images[0], "r+") as file:
                file.colorinterp = [*file.colorinterp[:3], rasterio.enums.ColorInterp.alpha]
        if kind == "mask":
            with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(small.images[0], "r+") as file:
                file.write_mask(~bad)
        said = photoplan("ortho", small.project, *OPTIONS, "--images", "one", "--resolution", "0.8")
        assert said.code == 0, said.err
        with rasterio.open(small.folder / "products" / "one_ortho.tif") as file:
            assert file.count == 3
            product, valid = file.read(), file.dataset_mask() > 0
        inside = valid[80:200, 120:260]
        assert 0.2 < 1 - inside.mean() < 0.7
        assert (product[:, valid] == 200).all()

    @pytest.mark.parametrize(
        ("dtype", "top", "options"),
        [
            ("uint16", 4095, {"nbits": 12}),
            pytest.param("uint16", 65535, {}, marks=pytest.mark.slow),
            ("int16", 32767, {}),
            pytest.param("float32", 1.0, {}, marks=pytest.mark.slow),
        ],
        ids=["12-bit", "16-bit", "int16", "float"],
    )
    def test_fault_24_more_than_8_bits(
        self, photoplan: Here, small: Block, dtype: str, top: float, options: dict[str, object]
    ) -> None:
        """The same texture in another type gives the same product in that type, to the type's own rounding."""
        wide = texture().astype(float) / 255 * top
        write_image(small.images[0], wide.astype(dtype), **options)
        words = ["ortho", small.project, *OPTIONS, "--images", "one", "--kernel", "bilinear"]
        assert photoplan(*words).code == 0
        path = small.folder / "products" / "one_ortho.tif"
        with rasterio.open(path) as file:
            assert file.dtypes == (dtype,) * 3
            made, valid = file.read().astype(float), file.dataset_mask() > 0
        write_image(small.images[0], texture())
        assert photoplan(*words, "--overwrite").code == 0
        with rasterio.open(path) as file:
            plain = file.read().astype(float)
        # The wide texture was cut to whole numbers, the plain product was rounded to 8 bit, the wide one to its own.
        step = 0 if dtype == "float32" else 255 / top
        assert valid.mean() > 0.7
        assert np.abs(made / top * 255 - plain)[:, valid].max() <= 0.501 + 1.5 * step

    def test_fault_24_a_palette_becomes_colours(self, photoplan: Here, small: Block) -> None:
        index = (texture(bands=1) // 86).astype(np.uint8)
        write_image(small.images[0], index, photometric="palette")
        colours = {0: (200, 30, 40, 255), 1: (20, 210, 50, 255), 2: (10, 60, 220, 255)}
        with rasterio.open(small.images[0], "r+") as file:
            file.write_colormap(1, colours)
        assert photoplan("ortho", small.project, *OPTIONS, "--images", "one", "--kernel", "nearest").code == 0
        with rasterio.open(small.folder / "products" / "one_ortho.tif") as file:
            made = file.read()[:, file.dataset_mask() > 0]
        assert {tuple(c) for c in np.unique(made, axis=1).T} == {c[:3] for c in colours.values()}

    @pytest.mark.parametrize(
        ("dtype", "options", "message"),
        [
            ("uint8", {"nbits": 1}, "1-bit image"),
            ("float64", {}, "pixels of type float64; allowed are uint8, uint16, int16, float32"),
            ("uint32", {}, "pixels of type uint32"),
            ("uint8", {"photometric": "CMYK"}, "CMYK"),
        ],
        ids=["1-bit", "double", "uint32", "cmyk"],
    )
    def test_fault_24_refused_by_name(
        self, photoplan: Here, small: Block, dtype: str, options: dict[str, object], message: str
    ) -> None:
        bands = 4 if "photometric" in options else 1
        write_image(small.images[0], (texture(bands=bands) // 128).astype(dtype), **options)
        said = refused(photoplan, small.project, image="one")
        assert f"{small.images[0]}: " in said
        assert message in said

    def test_fault_24_a_side_over_32767(self, photoplan: Here, small: Block) -> None:
        """A line of 40,000 pixels: grey values tell their own column, also beyond what 16 bits can count."""
        columns = np.broadcast_to(np.arange(40_000, dtype=np.float32), (60, 40_000))[None]
        write_image(small.images[0], columns, tiled=True, blockxsize=256, blockysize=64, compress="deflate")
        small.camera.write_text(
            "small:\n  type: pinhole\n  im_size: [40000, 60]\n  focal_len: 40000\n  sensor_size: [40000, 60]\n"
        )
        small.orientation.write_text(f"name,x,y,z,omega,phi,kappa\none,{X0 + 60},{Y0},{Z0},0,0,0\n")
        for other in small.images[1:]:
            other.unlink()
        write_terrain(small.terrain, np.full((60, 64), 100.0))
        make_project(small)
        said = photoplan("ortho", small.project, "--resolution", "0.05", "--kernel", "bilinear")
        assert said.code == 0, said.err
        with rasterio.open(small.folder / "products" / "one_ortho.tif") as file:
            made = file.read(1)
            row, col = np.nonzero(np.isfinite(made))
            X = file.bounds.left + (col + 0.5) * 0.05
        assert X.max() - X.min() > 299
        # 300 m above ground a pixel of 1/40,000 is 7.5 mm, and the middle of the line is at 19,999.5. Ground pixels of
        # 50 mm are means of some seven columns, fewer at both ends.
        inner = np.abs(X - X0 - 60) < 149.5
        np.testing.assert_allclose(made[row, col][inner], (19_999.5 + (X - X0 - 60) / 0.0075)[inner], atol=0.5)

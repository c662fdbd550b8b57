"""`photoplan restore` with a filter: results, kinds of pixels, faults, interruption."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage
from tools.command import Here
from tools.huge_tiff import write_huge_tiff
from tools.small_block import texture, write_image

from photoplan.project.steps import load_filter, save_filter
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter

WEIGHTS = np.array([[0.02, -0.15, 0.01], [-0.2, 1.62, -0.14], [0.03, -0.16, -0.03]])


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "weights.csv"
    path.write_text("# general, sum 1\n" + "\n".join(",".join(map(str, row)) for row in WEIGHTS) + "\n")
    return path


def restored(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with rasterio.open(path) as file:
        return file.read(), file.dataset_mask() > 0


def twin(image: np.ndarray) -> np.ndarray:
    """Inner pixels by scipy, as floats."""
    return np.stack([ndimage.convolve(band.astype(float), WEIGHTS) for band in image])[:, 2:-2, 2:-2]


class TestResults:
    def test_paths_on_stdout_talk_on_stderr(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        image = write_image(tmp_path / "scan.tif", texture(seed=1))
        said = photoplan("restore", image, "--filter", weights, "--workers", 1)
        assert said.code == 0, said.err
        result = tmp_path / "restored" / "scan_restored.tif"
        assert said.out.splitlines() == [str(result)]
        gain = np.sqrt((WEIGHTS**2).sum())
        assert said.err.splitlines()[0] == f"filter 3 × 3, 1 kernel, sum 1: noise grows {gain:.3g} times"
        assert sorted(p.name for p in result.parent.iterdir()) == [
            "scan_restored.png",
            "scan_restored.run.json",
            "scan_restored.tif",
        ]
        pixels, valid = restored(result)
        assert valid.all()
        exact = twin(texture(seed=1))
        assert np.abs(pixels[:, 2:-2, 2:-2] - np.clip(exact, 0, 255)).max() <= 0.501
        record = json.loads((result.parent / "scan_restored.run.json").read_text())
        assert {Path(each["path"]).name for each in record["inputs"]} == {"scan.tif", "weights.csv"}
        assert record["filter"]["kernels"][0]["values"] == WEIGHTS.tolist()

    def test_clipped_pixels_are_counted_and_advised_on(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        pixels = np.where(texture(seed=1) > 127, 250, 3).astype(np.uint8)
        image = write_image(tmp_path / "scan.tif", pixels)
        said = photoplan("restore", image, "--filter", weights, "--json", "--no-quicklook")
        (facts,) = json.loads(said.out)["images"]
        inner = np.rint(twin(pixels))
        assert sum(facts["clipped_below"]) >= (inner < 0).sum() > 100
        assert sum(facts["clipped_above"]) >= (inner > 255).sum() > 100
        assert "were clipped; --dtype float32 keeps all values, --dtype uint16 those above 255" in said.err
        words = ["restore", image, "--filter", weights, "--output", tmp_path / "float", "--dtype", "float32"]
        said = photoplan(*words, "--json")
        assert json.loads(said.out)["images"][0]["clipped_share"] == 0
        values, _ = restored(tmp_path / "float" / "scan_restored.tif")
        assert values.dtype == np.float32
        np.testing.assert_allclose(values[:, 2:-2, 2:-2], twin(pixels), atol=1e-3)

    def test_the_image_keeps_its_place_names_and_metadata(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        image = tmp_path / "scan.tif"
        place = rasterio.Affine(0.4, 0.1, 500_000, 0.12, -0.41, 5_400_000)
        write_image(image, texture(bands=4), crs="EPSG:32633", transform=place, photometric="MINISBLACK")
        names = ("red", "green", "blue", "near infrared")
        with rasterio.open(image, "r+") as file:
            file.descriptions = names
            colour = rasterio.enums.ColorInterp
            file.colorinterp = [colour.red, colour.green, colour.blue, colour.undefined]
            file.update_tags(
                TIFFTAG_XRESOLUTION="1200", TIFFTAG_YRESOLUTION="1200", TIFFTAG_RESOLUTIONUNIT="2", EXIF_Make="Wild"
            )
        assert photoplan("restore", image, "--filter", weights, "--band", 4, "--band", 1).code == 0
        with rasterio.open(tmp_path / "restored" / "scan_restored.tif") as file:
            assert file.transform.almost_equals(place)
            assert file.crs.to_epsg() == 32633
            assert file.descriptions == names
            assert [c.name for c in file.colorinterp] == ["red", "green", "blue", "undefined"]
            assert file.tags()["TIFFTAG_XRESOLUTION"] == "1200" and file.tags()["EXIF_Make"] == "Wild"
            pixels = file.read()
        before = texture(bands=4)
        assert np.array_equal(pixels[1:3], before[1:3])
        assert not np.array_equal(pixels[0], before[0]) and not np.array_equal(pixels[3], before[3])

    @pytest.mark.parametrize("kind", ["nodata", "alpha", "mask"])
    def test_fault_22_invalid_pixels_stay_invalid(
        self, photoplan: Here, tmp_path: Path, weights: Path, kind: str
    ) -> None:
        """A bright image with a hole: no valid pixel is darker than it, and the hole is where it was."""
        bad = np.zeros((150, 200), bool)
        bad[40:90, 70:130] = True
        pixels = np.full((3, 150, 200), 200, np.uint8)
        pixels[:, bad] = 0
        image = tmp_path / "scan.tif"
        if kind == "alpha":
            pixels = np.concatenate([pixels, np.where(bad, 0, 255)[None].astype(np.uint8)])
            write_image(image, pixels, photometric="RGB", alpha="YES")
        else:
            write_image(image, pixels, **({"nodata": 0} if kind == "nodata" else {}))
        if kind == "mask":
            with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(image, "r+") as file:
                file.write_mask(~bad)
        assert photoplan("restore", image, "--filter", weights).code == 0
        with rasterio.open(tmp_path / "restored" / "scan_restored.tif") as file:
            assert file.count == 3
            assert file.nodata == (0 if kind == "nodata" else None)
            made, valid = file.read(), file.dataset_mask() > 0
        assert np.array_equal(valid, ~bad)
        assert (made[:, valid] == 200).all()

    def test_several_images_of_which_one_fails(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        good = write_image(tmp_path / "good.tif", texture())
        bad = tmp_path / "bad.tif"
        bad.write_bytes(b"no picture")
        said = photoplan("restore", good, bad, "--filter", weights)
        assert said.code == 4
        assert said.out.splitlines() == [str(tmp_path / "restored" / "good_restored.tif")]
        assert str(bad) in said.err
        assert photoplan("restore", bad, "--filter", weights).code == 3

    def test_a_dry_run_writes_nothing(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        image = write_image(tmp_path / "scan.tif", texture())
        before = sorted(tmp_path.iterdir())
        said = photoplan("restore", image, "--filter", weights, "--dry-run", "--json")
        (row,) = json.loads(said.out)["images"]
        assert (row["size"], row["tiles"], row["dtype"]) == ([200, 150], 1, "uint8")
        assert sorted(tmp_path.iterdir()) == before


class TestFault24Pixels:
    @pytest.mark.parametrize(
        ("dtype", "top", "options"),
        [
            ("uint16", 4095, {"nbits": 12}),
            pytest.param("uint16", 65535, {}, marks=pytest.mark.slow),
            pytest.param("int16", 32767, {}, marks=pytest.mark.slow),
            ("float32", 1.0, {}),
        ],
        ids=["12-bit", "16-bit", "int16", "float"],
    )
    def test_fault_24_more_than_8_bits(
        self, photoplan: Here, tmp_path: Path, weights: Path, dtype: str, top: float, options: dict[str, object]
    ) -> None:
        pixels = (texture().astype(float) / 255 * top).astype(dtype)
        image = write_image(tmp_path / "scan.tif", pixels, **options)
        assert photoplan("restore", image, "--filter", weights).code == 0
        made, _ = restored(tmp_path / "restored" / "scan_restored.tif")
        assert made.dtype == dtype
        apart = np.abs(made[:, 2:-2, 2:-2] - twin(pixels)).max()
        assert apart <= (1e-6 if dtype == "float32" else 0.52)

    def test_fault_24_a_palette_becomes_colours(self, photoplan: Here, tmp_path: Path) -> None:
        index = (texture(bands=1) // 86).astype(np.uint8)
        image = write_image(tmp_path / "scan.tif", index, photometric="palette")
        colours = {0: (200, 30, 40, 255), 1: (20, 210, 50, 255), 2: (10, 60, 220, 255)}
        with rasterio.open(image, "r+") as file:
            file.write_colormap(1, colours)
        nothing = tmp_path / "one.txt"
        nothing.write_text("1\n")
        assert photoplan("restore", image, "--filter", nothing).code == 0
        made, _ = restored(tmp_path / "restored" / "scan_restored.tif")
        assert {tuple(c) for c in np.unique(made.reshape(3, -1), axis=1).T} == {c[:3] for c in colours.values()}

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
        self, photoplan: Here, tmp_path: Path, weights: Path, dtype: str, options: dict[str, object], message: str
    ) -> None:
        bands = 4 if "photometric" in options else 1
        image = write_image(tmp_path / "scan.tif", (texture(bands=bands) // 128).astype(dtype), **options)
        said = photoplan("restore", image, "--filter", weights)
        assert said.code == 3
        assert str(image) in said.err and message in said.err
        assert not list((tmp_path / "restored").glob("*.tif"))

    @pytest.mark.slow
    def test_fault_24_a_side_over_32767(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        columns = np.broadcast_to(np.arange(40_000, dtype=np.float32), (8, 40_000))[None]
        image = write_image(tmp_path / "line.tif", columns, tiled=True, blockxsize=256, blockysize=64)
        assert photoplan("restore", image, "--filter", weights, "--no-quicklook").code == 0
        made, _ = restored(tmp_path / "restored" / "line_restored.tif")
        # A ramp stays a ramp, shifted by the filter's first moment: what lies left has the weights' last columns.
        shift = float((WEIGHTS.sum(0) * [1, 0, -1]).sum())
        np.testing.assert_allclose(made[0, :, 1:-1], columns[0, :, 1:-1] + shift, atol=0.02)

    def test_fault_24_over_4_gigabytes(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        """72,000 × 72,000 pixels are planned as tiles, without reading any."""
        block = np.random.default_rng(0).integers(0, 255, (512, 512, 1), dtype=np.uint8)
        image = write_huge_tiff(tmp_path / "huge.tif", block, (72_000, 72_000))
        said = photoplan("restore", image, "--filter", weights, "--dry-run", "--json")
        assert said.code == 0, said.err
        assert json.loads(said.out)["images"][0]["tiles"] == 141 * 141


class TestFaults:
    def test_fault_08_a_truncated_image(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        image = write_image(tmp_path / "scan.tif", np.tile(texture(), (1, 4, 4)), tiled=True, compress="deflate")
        content = image.read_bytes()
        image.write_bytes(content[: len(content) // 2])
        said = photoplan("restore", image, "--filter", weights)
        assert said.code == 3
        assert str(image) in said.err
        assert not (tmp_path / "restored" / "scan_restored.tif").exists()

    def test_fault_08_a_flipped_bit(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        image = write_image(tmp_path / "scan.tif", np.tile(texture(), (1, 4, 4)), tiled=True, compress="deflate")
        content = bytearray(image.read_bytes())
        content[len(content) * 2 // 3] ^= 0x55
        image.write_bytes(content)
        said = photoplan("restore", image, "--filter", weights)
        assert said.code == 3
        assert "window col" in said.err
        assert not (tmp_path / "restored" / "scan_restored.tif").exists()

    def test_fault_13_outputs_that_exist(self, photoplan: Here, tmp_path: Path, weights: Path) -> None:
        image = write_image(tmp_path / "scan.tif", texture())
        folder = tmp_path / "restored"
        folder.mkdir()
        for name in ("scan_restored.tif", "scan_restored.png", "scan_restored.run.json"):
            (folder / name).write_text("precious")
            said = photoplan("restore", image, "--filter", weights)
            assert said.code == 2
            assert f"{name}: exists already" in said.err
            assert (folder / name).read_text() == "precious"
            (folder / name).unlink()
        assert photoplan("restore", image, "--filter", weights).code == 0
        assert photoplan("restore", image, "--filter", weights).code == 2
        assert photoplan("restore", image, "--filter", weights, "--overwrite").code == 0

    @pytest.mark.parametrize("which", ["image", "filter"])
    def test_fault_13_an_input_under_a_results_name(
        self, photoplan: Here, tmp_path: Path, weights: Path, which: str
    ) -> None:
        image = write_image(tmp_path / "scan.tif", texture())
        source = image if which == "image" else weights
        before = source.read_bytes()
        (tmp_path / "restored").mkdir()
        (tmp_path / "restored" / "scan_restored.tif").hardlink_to(source)
        said = photoplan("restore", image, "--filter", weights, "--overwrite")
        assert said.code == 2
        assert f"the output is the input {source}" in said.err
        assert source.read_bytes() == before

    def test_two_images_of_one_name_in_two_folders_get_two_products(
        self, photoplan: Here, tmp_path: Path, weights: Path
    ) -> None:
        (tmp_path / "other").mkdir()
        images = [write_image(tmp_path / part / "scan.tif", texture()) for part in (".", "other")]
        said = photoplan("restore", *images, "--filter", weights)
        assert said.code == 0, said.err
        assert len(list(tmp_path.rglob("*scan_restored.tif"))) == 2
        assert photoplan("restore", images[0], images[0], "--filter", weights).code == 2

    @pytest.mark.parametrize(
        ("words", "code", "message"),
        [
            (["--memory", "100MB"], 2, "MiB are needed for one tile"),
            (["--dtype", "uint32"], 2, "--dtype 'uint32' must be same, float32 or uint16"),
            (["--compress", "zip"], 2, "compression 'zip'"),
            (["--band", "4"], 3, "band 4 is asked for; the image has 3"),
            (["--linearisation", "gamma.txt"], 3, "gamma.txt"),
            (["--dtype", "float32", "--compress", "jpeg"], 3, "compression jpeg takes one or three of uint8"),
        ],
    )
    def test_wrong_use(
        self, photoplan: Here, tmp_path: Path, weights: Path, words: list[str], code: int, message: str
    ) -> None:
        image = write_image(tmp_path / "scan.tif", texture())
        said = photoplan("restore", image, "--filter", weights, *words)
        assert (said.code, said.out) == (code, "")
        assert message in said.err


class TestFilterFiles:
    @pytest.mark.drawn
    def test_info_prints_and_plots_a_filter(self, photoplan: Here, tmp_path: Path) -> None:
        kernels = (FilterKernel(WEIGHTS, (10.0, 20.0)), FilterKernel(WEIGHTS * 2, (90.0, 20.0)))
        path = save_filter(
            tmp_path / "f.toml", RestorationFilter(kernels, (100, 50), "two places", {"condition": "A < Z/2"})
        )
        picture = tmp_path / "f.png"
        said = photoplan("info", path, "--plot", picture)
        assert said.code == 0, said.err
        assert "two places" in said.out and "A < Z/2" in said.out
        assert "all bands at 90, 20: 3 × 3, general, sum 2, noise gain 3.3" in said.out
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert photoplan("info", path, "--plot", picture).code == 2
        assert photoplan("info", path, "--plot", path, "--overwrite").code == 2
        assert load_filter(path).description == "two places"

"""Mosaics: one orthophoto of many images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from scipy.ndimage import binary_dilation, uniform_filter
from tools.command import Here
from tools.small_block import CRS, NAMES, SIZE, X0, Y0, Block, make_project, texture, write_image
from tools.thinned import some
from tools.town import write_town

BOUNDS = (500_180, 5_300_100, 500_540, 5_300_300)
OPTIONS = ("--bounds", *BOUNDS, "--resolution", 1, "--tile", 128, "--no-quicklook")


def made(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read()


@pytest.fixture
def mosaic(small: Block, capsys: pytest.CaptureFixture[str]) -> tuple[Block, Here, dict]:  # type: ignore[type-arg]
    photoplan = Here(capsys)
    said = photoplan("mosaic", small.project, *OPTIONS, "--sources", "--json")
    assert said.code == 0, said.err
    (told,) = json.loads(said.out)["products"]
    return small, photoplan, told


def test_every_pixel_is_that_of_the_orthophoto_of_its_image(mosaic) -> None:  # type: ignore[no-untyped-def]
    block, photoplan, told = mosaic
    folder = block.folder / "products"
    assert photoplan("ortho", block.project, *OPTIONS).code == 0
    pixels, owner = made(folder / "mosaic.tif"), made(folder / "mosaic_sources.tif")[0]
    assert told["images"] == sorted(NAMES) and set(np.unique(owner)) == {0, 1, 2, 3}
    want = np.zeros_like(pixels)
    for row, name in enumerate(told["images"], 1):
        want[:, owner == row] = made(folder / f"{name}_ortho.tif")[:, owner == row]
    np.testing.assert_array_equal(pixels, want)
    assert (pixels[:, owner > 0] > 0).all()
    assert told["valid_share"] == pytest.approx((owner > 0).mean(), abs=1e-6)
    # Everything that is no pixel of an image is told: hidden, or in no image.
    assert told["hidden_m2"] + told["outside_m2"] == pytest.approx((owner == 0).sum(), abs=1e-6)
    assert sum(told["painted_m2"].values()) == pytest.approx((owner > 0).sum())


def test_one_image_paints_a_region_and_not_single_pixels(mosaic) -> None:  # type: ignore[no-untyped-def]
    block, _, _ = mosaic
    regions = block.folder / "products" / "mosaic_seams.gpkg"
    meta, _, wkb, values = pyogrio.raw.read(regions)
    columns = dict(zip(meta["fields"], values))
    shapes = shapely.from_wkb(wkb)
    assert meta["crs"] == CRS and set(columns["image"]) == set(NAMES)
    np.testing.assert_allclose(columns["area_m2"], shapely.area(shapes))
    assert sum(shapely.get_num_geometries(shapes)) <= 9


def test_edited_regions_are_followed(mosaic, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    block, photoplan, told = mosaic
    folder = block.folder / "products"
    again = photoplan(
        "mosaic", block.project, *OPTIONS, "--sources", "--seams", folder / "mosaic_seams.gpkg", "--name", "b"
    )
    assert again.code == 0, again.err
    np.testing.assert_array_equal(made(folder / "b_sources.tif"), made(folder / "mosaic_sources.tif"))
    middle = shapely.box(500_330, 5_300_180, 500_380, 5_300_220)
    drawn = tmp_path / "drawn.gpkg"
    write(drawn, [middle], ["three"])
    assert photoplan("mosaic", block.project, *OPTIONS, "--sources", "--seams", drawn, "--name", "c").code == 0
    before, after = (made(folder / f"{name}_sources.tif")[0] for name in ("mosaic", "c"))
    inside = np.zeros(before.shape, bool)
    inside[80:120, 150:200] = True
    row = told["images"].index("three") + 1
    assert (after[inside] == row).all() and (before[inside] != row).any()
    np.testing.assert_array_equal(after[~inside], before[~inside])


def write(path: Path, shapes: list[object], images: list[str]) -> None:
    pyogrio.raw.write(path, shapely.to_wkb(np.array(shapes)), [np.array(images, object)], ["image"],
                      layer="regions", driver="GPKG", geometry_type="Polygon", crs=CRS)  # fmt: skip


def test_fault_19_regions_that_cannot_be_meant(
    small: Block, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    photoplan = Here(capsys)
    box = shapely.box(500_330, 5_300_180, 500_380, 5_300_220)
    bow = shapely.Polygon([(500_330, 5_300_180), (500_380, 5_300_220), (500_380, 5_300_180), (500_330, 5_300_220)])
    for shape, image, told in ((box, "nine", "'nine', which is not in the mosaic"), (bow, "one", "cross themselves")):
        write(tmp_path / "drawn.gpkg", [shape], [image])
        said = photoplan("mosaic", small.project, *OPTIONS, "--seams", tmp_path / "drawn.gpkg")
        assert said.code == 3 and told in said.err
        (tmp_path / "drawn.gpkg").unlink()
    said = photoplan("mosaic", small.project, *OPTIONS, "--seams", tmp_path / "none.gpkg")
    assert said.code == 3 and "none.gpkg" in said.err
    assert not (small.folder / "products").exists()


def test_a_preferred_image_and_the_weights(mosaic) -> None:  # type: ignore[no-untyped-def]
    block, photoplan, told = mosaic
    folder = block.folder / "products"
    said = photoplan("mosaic", block.project, *OPTIONS, "--sources", "--prefer", "three", "--name", "p", "--json")
    (first,) = json.loads(said.out)["products"]
    assert first["painted_m2"]["three"] > told["painted_m2"]["three"] + 1000
    assert (made(folder / "p_sources.tif") > 0).sum() == (made(folder / "mosaic_sources.tif") > 0).sum()
    for words, text in (
        (("--score", "slant=x"), "NAME=WEIGHT"),
        (("--score", "slant=-1"), "weight slant=-1"),
        (("--prefer", "nine"), "'nine' is not in the project"),
        (("--images", "one,two", "--prefer", "three"), "not among the images of the mosaic"),
    ):
        wrong = photoplan("mosaic", block.project, *OPTIONS, "--name", "x", *words)
        assert wrong.code == 2 and text in wrong.err


@pytest.mark.slow
def test_a_plan_of_a_mosaic_gives_the_same_bytes(mosaic, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    block, photoplan, _ = mosaic
    plan = tmp_path / "plan.gpkg"
    assert photoplan("mosaic", block.project, *OPTIONS, "--sources", "--plan", plan).code == 0
    assert pyogrio.read_info(plan, layer="footprints")["features"] == 3
    assert photoplan("run", plan, "--output", tmp_path / "again", "--no-quicklook").code == 0
    for name in ("mosaic.tif", "mosaic_sources.tif"):
        assert (tmp_path / "again" / name).read_bytes() == (block.folder / "products" / name).read_bytes()


def test_the_record_names_every_image(mosaic) -> None:  # type: ignore[no-untyped-def]
    block, photoplan, told = mosaic
    record = json.loads((block.folder / "products" / "mosaic.run.json").read_text())
    assert [image["name"] for image in record["images"]] == told["images"]
    assert all(len(image["projection_centre"]) == 3 and image["gsd_m"] > 0 for image in record["images"])
    assert len(record["inputs"]) == 4
    assert photoplan("mosaic", block.project, *OPTIONS).code == 2


def test_fault_12_files_of_two_mosaics_do_not_meet(mosaic) -> None:  # type: ignore[no-untyped-def]
    block, photoplan, _ = mosaic
    before = (block.folder / "products" / "mosaic_sources.tif").read_bytes()
    said = photoplan("mosaic", block.project, *OPTIONS, "--name", "mosaic_sources")
    assert said.code == 2 and "mosaic_sources.tif exists" in said.err
    assert (block.folder / "products" / "mosaic_sources.tif").read_bytes() == before
    text = block.project.read_text()
    block.project.write_text(text.replace('name = "one"', 'name = "THREE"'))
    said = photoplan("mosaic", block.project, *OPTIONS, "--name", "other")
    assert said.code == 0, said.err  # names that differ in capitals alone have stems of their own


@pytest.mark.parametrize("kind", some(["nodata", "mask"], 0))
def test_fault_22_no_dark_fringes_at_holes_seams_and_hidden_ground(
    small: Block, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """Bright images, one with a hole; objects hide ground in all: no valid pixel is darker than the images."""
    for path in small.images:
        pixels = np.full((3, SIZE[1], SIZE[0]), 200, np.uint8)
        hole = np.zeros(pixels.shape[1:], bool)
        if path == small.images[0]:
            hole[40:90, 70:130] = True
            pixels[:, hole] = 0
        write_image(path, pixels, **({"nodata": 0} if kind == "nodata" else {}))
        if kind == "mask":
            with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
                file.write_mask(~hole)
    make_project(small)
    town = write_town(small.project, (X0, Y0), 100.0, CRS)
    said = Here(capsys)("mosaic", town, *OPTIONS, "--sources", "--json")
    assert said.code == 0, said.err
    (told,) = json.loads(said.out)["products"]
    pixels, owner = (made(small.folder / "products" / name) for name in ("mosaic.tif", "mosaic_sources.tif"))
    assert (pixels[:, owner[0] > 0] == 200).all() and not pixels[:, owner[0] == 0].any()
    assert told["hidden_m2"] > 100 and told["outside_m2"] > 500


def test_images_of_different_kinds_are_named(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    write_image(small.images[1], texture(bands=1))
    make_project(small)
    said = Here(capsys)("mosaic", small.project, *OPTIONS)
    assert said.code == 3 and "'two' has 1 bands of uint8" in said.err and "'one' has 3 bands" in said.err


def test_feathered_images_pass_into_each_other(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """Images of one grey value each: no step at seams, nothing else changes, and tiles join."""
    for path, grey in zip(small.images, (60, 120, 200)):
        write_image(path, np.full((3, SIZE[1], SIZE[0]), grey, np.uint8))
    photoplan, folder = Here(capsys), small.folder / "products"
    plain = ["mosaic", small.project, *OPTIONS, "--sources"]
    assert photoplan(*plain).code == 0
    assert photoplan(*plain, "--feather", 40, "--name", "soft").code == 0
    assert photoplan(*plain, "--feather", 40, "--name", "whole", "--tile", 512).code == 0
    hard, soft = (made(folder / f"{name}.tif")[0].astype(int) for name in ("mosaic", "soft"))
    sources = made(folder / "soft_sources.tif")[0]
    np.testing.assert_array_equal(sources, made(folder / "mosaic_sources.tif")[0])
    np.testing.assert_array_equal(soft, made(folder / "whole.tif")[0])
    painted = (sources[:, 1:] > 0) & (sources[:, :-1] > 0)
    # In the last rows the borders of two images cross: they have nothing in common there.
    steps = [np.where(painted, np.abs(np.diff(each, axis=1)), 0)[:185].max() for each in (hard, soft)]
    assert steps[0] >= 60 and steps[1] <= 16
    seams = painted & (sources[:, 1:] != sources[:, :-1])
    # Seams beyond the bounds count, too.
    away = np.pad(np.ones((156, 316), bool), 22)
    for row, col in np.argwhere(seams | np.pad(np.diff(sources, axis=0) != 0, ((0, 1), (0, 0)))[:, 1:]):
        away[max(row - 22, 0) : row + 23, max(col - 22, 0) : col + 23] = False
    np.testing.assert_array_equal(soft[away], hard[away])
    assert away.any() and (soft != hard).any()
    said = photoplan(*plain, "--feather", -1, "--name", "x")
    assert said.code == 2 and "--feather" in said.err


def test_bands_keep_fine_detail_and_pass_coarse_over_the_width(
    small: Block, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images of one grey value each, with noise of their own: no step at seams, and noise as strong as elsewhere."""
    random = np.random.default_rng(2)
    for path, grey in zip(small.images, (80, 120, 170)):
        noise = random.normal(grey, 12, (3, SIZE[1], SIZE[0]))
        write_image(path, np.clip(np.rint(noise), 1, 255).astype(np.uint8))
    photoplan, folder = Here(capsys), small.folder / "products"
    plain = ["mosaic", small.project, *OPTIONS]
    assert photoplan(*plain, "--sources", "--name", "hard").code == 0
    assert photoplan(*plain, "--feather", 48, "--name", "mean").code == 0
    assert photoplan(*plain, "--feather", 48, "--blend", "multiband", "--name", "bands").code == 0
    said = photoplan(*plain, "--feather", 48, "--blend", "multiband", "--name", "whole", "--tile", 512)
    assert said.code == 0, said.err
    hard, mean, bands = (made(folder / f"{name}.tif").astype(float) for name in ("hard", "mean", "bands"))
    # Anchors of other tiles are known to hundredths of a pixel.
    apart = np.abs(bands - made(folder / "whole.tif"))
    assert apart.max() <= 1 and (apart > 0).mean() < 0.01
    sources = made(folder / "hard_sources.tif")[0]
    seam = np.zeros(sources.shape, bool)
    seam[:, 1:] = (sources[:, 1:] != sources[:, :-1]) & (sources[:, 1:] > 0) & (sources[:, :-1] > 0)
    near, far = (binary_dilation(seam, iterations=n) for n in (14, 60))
    strip = near & ~binary_dilation(seam, iterations=4) & (np.abs(mean - hard).max(axis=0) > 2)
    strip[185:] = False
    strong = [np.std((each - uniform_filter(each, (0, 3, 3)))[:, strip]) for each in (hard, mean, bands)]
    assert strip.sum() > 500 and strong[1] < 0.85 * strong[0] and strong[2] > 0.97 * strong[0]
    smooth = [np.abs(np.diff(uniform_filter(each, (0, 9, 9)))) for each in (hard, bands)]
    steps = [each[:, :185][:, seam[:185, 1:]].mean() for each in smooth]
    assert steps[1] < 0.6 * steps[0]
    np.testing.assert_array_equal(bands[:, ~far & (sources > 0)], hard[:, ~far & (sources > 0)])
    said = photoplan(*plain, "--blend", "multiband", "--name", "x")
    assert said.code == 2 and "--feather" in said.err

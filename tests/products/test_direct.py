"""The direct method: pixels of the image carried to the ground, gaps between them, nothing twice."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
import shapely
from products.test_object_products import BRIDGE, GROUND, pixels_of, rendered, town  # noqa: F401
from products.test_true_ortho import HOUSE, colour
from scipy.ndimage import binary_erosion
from tools.command import Here
from tools.small_block import X0, Y0, Block

from photoplan.io.project.file import load_project
from photoplan.products.orthophoto.plan import plan_orthophotos, render

BOUNDS = (X0 - 60, Y0 - 40, X0 + 60, Y0 + 40)
ONE = ("--images", "one", "--bounds", *BOUNDS, "--no-quicklook", "--json")


def made(block: Block, photoplan: Here, folder: str, *words: object) -> tuple[np.ndarray, np.ndarray, dict]:  # type: ignore[type-arg]
    said = photoplan("ortho", block.project, *ONE, "--output", block.folder / folder, *words)
    assert said.code == 0, said.err
    with rasterio.open(block.folder / folder / "one_ortho.tif") as file:
        return file.read().astype(float), file.read_masks(1) > 0, json.loads(said.out)["products"][0]


def test_what_comes_down_in_a_pixel_is_its_nearest_and_between_there_are_gaps(small: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    """Ground pixels of half the image's: about three of four get nothing, the others the grey value as it is."""
    photoplan = Here(capsys)
    fine = ("--resolution", 0.75)
    direct, hit, told = made(small, photoplan, "a", *fine, "--method", "direct", "--tile", 128)
    nearest, there, _ = made(small, photoplan, "b", *fine, "--kernel", "nearest", "--hidden", "nodata")
    assert there.all() and 0.2 < hit.mean() < 0.3
    np.testing.assert_array_equal(direct[:, hit], nearest[:, hit])
    assert told["gaps_m2"] == pytest.approx((~hit).sum() * 0.75**2) and told["hidden_m2"] == 0
    whole, *_ = made(small, photoplan, "c", *fine, "--method", "direct", "--tile", 256)
    np.testing.assert_array_equal(whole, direct)
    # Nearest places of a smooth texture are near enough to be averaged.
    filled, full, told = made(small, photoplan, "d", *fine, "--method", "direct", "--fill", 3, "--tile", 128)
    other, *_ = made(small, photoplan, "e", *fine, "--method", "direct", "--fill", 3, "--tile", 256)
    np.testing.assert_array_equal(filled, other)
    smooth, *_ = made(small, photoplan, "f", *fine, "--kernel", "bilinear")
    assert full.all() and told["gaps_m2"] == 0 and np.array_equal(filled[:, hit], direct[:, hit])
    assert np.sqrt(np.mean((filled - smooth) ** 2)) < 0.35 * np.sqrt(np.mean((nearest - smooth) ** 2)) + 4


def test_coarser_pixels_are_means_without_gaps(small: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    direct, hit, told = made(small, photoplan, "a", "--resolution", 4, "--method", "direct")
    area, *_ = made(small, photoplan, "b", "--resolution", 4, "--kernel", "bilinear")
    assert hit.all() and told["gaps_m2"] == 0
    assert np.corrcoef(direct.ravel(), area.ravel())[0, 1] > 0.98
    plan = plan_orthophotos(load_project(small.project), ["one"], resolution=4.0, bounds=BOUNDS, method="direct")
    values, valid = render(plan, "one")
    assert valid.all() and np.array_equal(values, direct)


def test_no_ray_goes_through_a_house_and_walls_are_not_painted(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]  # noqa: F811
    photoplan = Here(capsys)
    town.project.write_text(town.project.read_text() + '\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n')
    words = ("ortho", town.project, "--images", "two", "--resolution", 2, "--no-quicklook", "--true")
    assert photoplan(*words, "--method", "direct").code == 0
    pixels, valid, XY = pixels_of(town.folder / "products" / "two_ortho.tif")
    assert photoplan(*words, "--kernel", "bilinear", "--output", town.folder / "indirect").code == 0
    _, seen, _ = pixels_of(town.folder / "indirect" / "two_ortho.tif")
    # Half a pixel at the borders of what is hidden, and of the image.
    assert (valid & ~seen).mean() < 0.005 and (seen & ~valid).mean() < 0.01
    on = shapely.contains(shapely.union(BRIDGE, shapely.Polygon(HOUSE.outline)), shapely.points(XY))
    edges = shapely.union(BRIDGE.boundary, shapely.Polygon(HOUSE.outline).boundary)
    # Pixels of the image on the border of what hides ground show both.
    clear = valid & binary_erosion(seen, iterations=2) & ~shapely.dwithin(edges, shapely.points(XY), 5.0)
    truth = colour(np.c_[XY.reshape(-1, 2), np.full(on.size, GROUND)], on.ravel()).reshape(on.shape)
    assert np.sqrt(np.mean((pixels - truth)[clear & on] ** 2)) < 8
    # Beside what leans over the ground, too: nothing of a wall or a roof lies there.
    assert (clear & ~on).sum() > 5000 and np.abs((pixels - truth)[clear & ~on]).max() < 40


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--method", "slow"), "method 'slow' must be one of indirect, direct"),
        (("--fill", 3), "--fill 3 must be from 0 to 32 pixels, and requires --method direct"),
        (("--method", "direct", "--fill", 99), "--fill 99"),
        (("--method", "direct", "--hidden", "mark"), "paints no hidden ground"),
        (("--method", "direct", "--accuracy"), "--accuracy"),
    ],
)
def test_what_it_cannot_do(small: Block, capsys, words: tuple[object, ...], text: str) -> None:  # type: ignore[no-untyped-def]
    said = Here(capsys)("ortho", small.project, *ONE, "--resolution", 2, *words)
    assert said.code == 2 and text in said.err, said.err

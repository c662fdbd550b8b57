"""Orthophotos that know which ground their image cannot see."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.small_block import X0, Y0, Z0, Block, make_project, write_image, write_terrain

WALL = 100.0


@pytest.fixture
def walled(small: Block) -> Block:
    """A vertical image of a plain at 100 m, with a wall from 65 to 85 m in the east that is 100 m higher."""
    for other in small.images[1:]:
        other.unlink(missing_ok=True)
    rng = np.random.default_rng(0)
    with rasterio.open(small.images[0]) as file:
        shape = file.shape
    write_image(small.images[0], rng.integers(1, 255, (3, *shape), dtype=np.uint8))
    small.orientation.write_text(f"name,x,y,z,omega,phi,kappa\none,{X0},{Y0},{Z0},0,0,0\n")
    with rasterio.open(small.terrain) as file:
        heights = np.full(file.shape, 100.0)
        heights[:, [60 < x - X0 < 90 for x in file.xy(0, np.arange(file.width))[0]]] += WALL
    write_terrain(small.terrain, heights)
    make_project(small)
    return small


def test_hidden_ground_is_left_empty_or_marked(walled: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    folder = walled.folder / "products"
    seen = photoplan("ortho", walled.project, "--output", folder / "show", "--no-quicklook", "--json")
    bare = photoplan(
        "ortho", walled.project, "--output", folder / "nodata", "--no-quicklook", "--json", "--hidden", "nodata"
    )
    mark = photoplan(
        "ortho", walled.project, "--output", folder / "mark", "--no-quicklook", "--json", "--hidden", "mark"
    )
    told = [json.loads(each.out)["products"][0] for each in (seen, bare, mark)]
    assert told[0]["hidden_m2"] is None
    assert told[1]["hidden_m2"] == told[2]["hidden_m2"] > 0
    pixels = {}
    for name in ("show", "nodata", "mark"):
        with rasterio.open(folder / name / "one_ortho.tif") as file:
            pixels[name], area = file.read(), file.res[0] ** 2
            east = file.xy(0, np.arange(file.width))[0]
    with rasterio.open(folder / "mark" / "one_ortho_hidden.tif") as file:
        hidden, there = file.read(1) == 1, file.read(1) != 255
    np.testing.assert_array_equal(pixels["mark"], pixels["show"])
    np.testing.assert_array_equal(pixels["nodata"], np.where(hidden, 0, pixels["show"]))
    assert told[1]["hidden_m2"] == pytest.approx(hidden.sum() * area)
    # From the upper edge to where the line over it comes down to the plain.
    end = 85 * (Z0 - 100) / (Z0 - 100 - WALL)
    away = np.array(east) - X0
    inside = there.all(axis=0)
    assert hidden[:, inside & (away > 87) & (away < end - 2)].all()
    assert not hidden[:, inside & ((away < 83) | (away > end + 2))].any()


def test_a_project_states_what_becomes_of_hidden_ground(walled: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    walled.project.write_text(walled.project.read_text().replace("[ortho]", '[ortho]\nhidden = "mark"'))
    said = photoplan("ortho", walled.project, "--no-quicklook")
    assert said.code == 0 and str(walled.folder / "products" / "one_ortho_hidden.tif") in said.out.splitlines()
    again = photoplan("ortho", walled.project, "--no-quicklook")
    assert again.code == 2 and "overwrite" in again.err
    wrong = photoplan("ortho", walled.project, "--hidden", "away")
    assert wrong.code == 2 and "show, nodata, mark" in wrong.err


def test_a_plan_file_knows_of_hidden_ground(walled: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    plan = walled.folder / "plan.gpkg"
    assert photoplan("ortho", walled.project, "--hidden", "nodata", "--plan", plan).code == 0
    assert photoplan("run", plan, "--no-quicklook").code == 0
    direct = walled.folder / "direct"
    assert photoplan("ortho", walled.project, "--hidden", "nodata", "--output", direct, "--no-quicklook").code == 0
    with rasterio.open(walled.folder / "products" / "one_ortho.tif") as a, rasterio.open(direct / "one_ortho.tif") as b:
        np.testing.assert_array_equal(a.read(), b.read())

"""Water in views: what lies lower, or has no height, is covered by a level that rays meet as the earth has it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from tools.command import inside
from tools.thinned import some

LEVEL, SIDE, MESH = 100.0, 160, 25.0
BLUE = (112, 150, 184)


@pytest.fixture(scope="module")
def island(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cone of 300 m in a sea that has no heights but for shallows, 4 km wide; a post in it is far below."""
    y, x = np.mgrid[:SIDE, :SIDE]
    heights = 400 - 6.0 * np.hypot(x - 80, y - 70)
    heights[heights < 60] = np.nan
    heights[70, 80] = -50.0
    path = tmp_path_factory.mktemp("island") / "island.tif"
    place = {"crs": "EPSG:32633", "transform": from_origin(500_000, 5_300_000, MESH, MESH), "nodata": float("nan")}
    with rasterio.open(path, "w", driver="GTiff", width=SIDE, height=SIDE, count=1, dtype="float32", **place) as file:
        file.write(heights.astype(np.float32), 1)
    return path


def camera(*more: object) -> tuple[object, ...]:
    return (
        "--from",
        502_000,
        5_296_100,
        "--altitude",
        160,
        "--azimuth",
        0,
        "--pitch",
        -4,
        "--size",
        80,
        60,
        "-q",
        *more,
    )


def matrix(island: Path, out: Path, *more: object) -> np.ndarray:
    said = inside("view", "matrix", island, *camera(*more), "-o", out)
    assert said.code == 0, said.err
    with rasterio.open(out) as file:
        return file.read()


@pytest.mark.parametrize("curvature", some(["none", "bend"], 1))
def test_rays_end_on_the_ground_or_on_the_water_whichever_comes_first(
    island: Path, tmp_path: Path, curvature: str
) -> None:
    earth = ("--curvature", curvature, "--refraction", 0)
    dry = matrix(island, tmp_path / "dry.tif", *earth)
    wet = matrix(island, tmp_path / "wet.tif", *earth, "--water", LEVEL)
    water = wet[2] == LEVEL
    assert 0.2 < water.mean() < 0.7
    # What is no water is the ground or the sky that was there before; no ground is lower than the water.
    np.testing.assert_array_equal(wet[:, ~water], dry[:, ~water])
    assert np.nanmin(wet[2]) == LEVEL
    assert np.isnan(dry[2][water]).any() and (dry[3][water] > wet[3][water]).any()
    # Each place of water lies on the ray of its pixel, by plain geometry: the ray falls, the earth falls away.
    focal = 40 / np.tan(np.radians(30.0))
    v, u = np.nonzero(water)
    across, down = (u - 39.5) / focal, (29.5 - v) / focal
    pitch = np.radians(-4.0)
    level, rise = np.cos(pitch) - down * np.sin(pitch), np.sin(pitch) + down * np.cos(pitch)
    slope = rise / np.hypot(level, across)
    s = np.hypot(wet[0][water] - 502_000, wet[1][water] - 5_296_100)
    bend = 0.0 if curvature == "none" else 1 / (2 * 6.38e6)
    np.testing.assert_allclose(160 + slope * s + bend * s**2, LEVEL, atol=0.01)
    np.testing.assert_allclose(wet[7:, water], 0, atol=1e-12)  # level


def test_water_has_its_colour_where_nothing_shows_it(island: Path, tmp_path: Path) -> None:
    wet = matrix(island, tmp_path / "m.tif", "--water", LEVEL)
    words = camera("--water", LEVEL, "--samples", 1, "-o", tmp_path / "p.png")
    assert inside("view", island, *words).code == 0
    with rasterio.open(tmp_path / "p.png") as file:
        picture = file.read()
    water = wet[2] == LEVEL
    assert (picture[:, water] == np.array(BLUE)[:, None]).all()
    assert not (picture[:, ~water] == np.array(BLUE)[:, None]).all(axis=0).any()
    assert json.loads((tmp_path / "p.run.json").read_text())["view"]["water_m"] == LEVEL
    # The same from the matrix; and rasters lie over the water.
    words = ("--matrix", tmp_path / "m.tif", "--water", LEVEL, "-o", tmp_path / "q.png", "-q")
    assert inside("view", island, *words).code == 0
    with rasterio.open(tmp_path / "q.png") as file:
        np.testing.assert_array_equal(file.read(), picture)
    words = camera("--water", LEVEL, "--samples", 1, "--water-colour", 1, 2, 3, "-o", tmp_path / "r.png")
    assert inside("view", island, *words, "--content", "shade", "--content", map_of(island, tmp_path)).code == 0
    with rasterio.open(tmp_path / "r.png") as file:
        painted = file.read()[:, water]
    red = (painted == np.array([250, 20, 20])[:, None]).all(axis=0)
    assert 0.2 < red.mean() < 0.9 and (painted[:, ~red] == np.array([1, 2, 3])[:, None]).all(axis=0).any()


def map_of(island: Path, folder: Path) -> Path:
    """A red raster over the western half."""
    with rasterio.open(island) as file:
        profile = file.profile | {"count": 3, "dtype": "uint8", "nodata": None, "width": SIDE // 2}
    with rasterio.open(folder / "red.tif", "w", **profile) as file:
        file.write(np.broadcast_to(np.array([250, 20, 20], np.uint8)[:, None, None], (3, SIDE, SIDE // 2)))
    return folder / "red.tif"


def test_commands_that_ask_for_the_ground_know_the_water(island: Path, tmp_path: Path) -> None:
    said = inside("view", "pick", island, *camera("--water", LEVEL, "--ground", 501_800, 5_297_000, "--json"))
    (point,) = json.loads(said.out)["picked"]
    assert point["H"] == LEVEL and point["seen"]
    said = inside(
        "view", "area", island, *camera("--water", LEVEL, "--resolution", 50, "--json"), "-o", tmp_path / "a.tif"
    )
    told = json.loads(said.out)
    assert told["area"] == pytest.approx((SIDE * MESH) ** 2) and told["visible_area"] > 0.1 * told["area"]
    for level, why in (("nan", "a height in metres"), (1e6, "heights lie between")):
        said = inside("view", island, *camera("--water", level, "-o", tmp_path / "no.png"))
        assert said.code == 2 and "water" in said.err and why in said.err, said.err

"""Sharpness in the score of a mosaic: sharp images are chosen before blurred ones, whatever noise and contrast."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
from scipy.ndimage import gaussian_filter, map_coordinates
from tools.command import Here
from tools.small_block import NAMES, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain

AWAY = (-60.0, 0.0, 60.0)
OPTIONS = ("--resolution", 1.5, "--tile", 128, "--no-quicklook", "--json")
#: Not so sharp that half a pixel between two images makes a difference.
GROUND = gaussian_filter(np.random.default_rng(5).normal(size=(420, 420)), 0.8)


@pytest.fixture
def block(small: Block) -> Block:
    """Three vertical images of one level ground: the first is noisy and of half the contrast, the second blurred."""
    col, row = np.meshgrid(np.arange(SIZE[0]) - (SIZE[0] - 1) / 2, np.arange(SIZE[1]) - (SIZE[1] - 1) / 2)
    rng = np.random.default_rng(1)
    for path, name, dx in zip(small.images, NAMES, AWAY):
        seen = map_coordinates(GROUND / GROUND.std(), [210 + row, 210 + col + dx / 1.5], order=3)
        if name == "two":
            seen = gaussian_filter(seen, 1.2)
        pixels = 125 + (15 * seen + rng.normal(0, 3, seen.shape) if name == "one" else 30 * seen)
        write_image(path, np.clip(np.rint(pixels), 1, 255).astype(np.uint8)[None])
    lines = [f"{name},{X0 + dx},{Y0},{Z0},0,0,0" for name, dx in zip(NAMES, AWAY)]
    small.orientation.write_text("\n".join(["name,x,y,z,omega,phi,kappa", *lines, ""]))
    write_terrain(small.terrain, np.full((60, 64), 100.0))
    make_project(small)
    return small


def test_sharp_images_are_chosen(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    told = {}
    for name, score in (("plain", "slant=1"), ("sharp", "sharpness=5")):
        said = photoplan("mosaic", block.project, *OPTIONS, "--score", score, "--name", name)
        assert said.code == 0, said.err
        record = json.loads((block.folder / "products" / f"{name}.run.json").read_text())
        told[name] = {image["name"]: image["blur"] for image in record["images"]}
        assert ("'two' shows least of the fine detail" in said.err) == (name == "sharp")
    assert set(told["plain"].values()) == {0.0}
    assert told["sharp"]["two"] > 0.4 and max(told["sharp"]["one"], told["sharp"]["three"]) < 0.1
    said = photoplan("mosaic", block.project, *OPTIONS, "--name", "a", "--sources", "--score", "sharpness=5")
    painted = json.loads(said.out)["products"][0]["painted_m2"]
    # The others show all that the middle image shows, but for what lies within three pixels of their borders.
    assert painted.get("two", 0.0) < 0.02 * sum(painted.values())
    said = photoplan("mosaic", block.project, *OPTIONS, "--name", "b", "--sources")
    free = json.loads(said.out)["products"][0]["painted_m2"]
    assert free["two"] > 0.12 * sum(free.values())
    words = (*OPTIONS[:-1], "--name", "a", "--sources", "--score", "sharpness=5")
    assert photoplan("mosaic", block.project, *words, "--plan", block.folder / "p.gpkg").code == 0
    assert photoplan("run", block.folder / "p.gpkg", "--output", block.folder / "c", "--no-quicklook").code == 0
    with rasterio.open(block.folder / "products" / "a.tif") as a, rasterio.open(block.folder / "c" / "a.tif") as c:
        np.testing.assert_array_equal(a.read(), c.read())

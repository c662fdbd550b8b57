"""Sharpness in the score of a mosaic: sharp images are chosen before blurred ones, whatever noise and contrast."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
from scipy.ndimage import gaussian_filter, map_coordinates
from tools.command import Here
from tools.small_block import NAMES, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain

from photoplan.products.orthophoto.sharpness import _energies, blur_of

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


def test_images_and_ground_are_told_apart() -> None:
    """Sums of both with gaps, single patches that are far off; what shares no ground with others counts as sharp."""
    rng = np.random.default_rng(0)
    blur, ground = np.array([0.0, 0.3, 1.2, 0.7, 0.1]), rng.normal(size=60)
    quotients = ground[:, None] - blur + rng.normal(0, 0.02, (60, 5))
    quotients[rng.random(quotients.shape) < 0.4] = np.nan
    quotients[rng.integers(0, 60, 8), rng.integers(0, 5, 8)] += 5
    alone = np.full((60, 1), np.nan)
    alone[7] = -9.0
    found = blur_of(np.concatenate([quotients, alone], axis=1))
    np.testing.assert_allclose(found, [*blur, 0.0], atol=0.05)
    assert (blur_of(np.full((3, 2), np.nan)) == 0).all()


def test_fine_detail_goes_with_blur_by_the_filters_response() -> None:
    """White noise has equal power at all frequencies: energies are integrals of the squared responses."""
    grey = np.random.default_rng(3).normal(size=(712, 712))
    w = 2 * np.pi * np.fft.fftfreq(512)
    one = (6 + 8 * np.cos(w) + 2 * np.cos(2 * w)) / 16
    smooth = one[:, None] * one
    for sigma in (0.0, 1.2):
        lens = np.exp(-(sigma**2) * (w[:, None] ** 2 + w**2))
        want = [(lens * (1 - smooth) ** 2).mean(), (lens * (smooth - smooth**2) ** 2).mean()]
        blurred = gaussian_filter(grey, sigma, truncate=8) if sigma else grey
        np.testing.assert_allclose(_energies(blurred).mean(axis=(1, 2)), want, rtol=0.03)

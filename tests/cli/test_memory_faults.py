"""Inputs far larger than the memory that a run may take."""

from __future__ import annotations

import os

import numpy as np
import pytest
import rasterio
from tools.command import Here, peak_of
from tools.huge_tiff import write_huge_tiff
from tools.small_block import X0, Y0, Z0, Block, make_project

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs the peak memory of a child")

LIMIT = 600 * 2**20
SIDE = 40_000


@pytest.fixture
def huge(small: Block) -> Block:
    """Two images of 40,000 × 40,000 × 3 bytes: 4.8 GB each in memory, a pixel of 7.5 mm on the ground."""
    for path in small.images:
        path.unlink()
    noise = np.random.default_rng(1).integers(60, 200, (256, 256, 3), dtype=np.uint8)
    write_huge_tiff(small.images[0], noise, (SIDE, SIDE))
    write_huge_tiff(small.images[1], noise, (SIDE, SIDE))
    small.camera.write_text(
        f"c:\n  type: pinhole\n  im_size: [{SIDE}, {SIDE}]\n  focal_len: 1\n  sensor_size: [1, 1]\n"
    )
    lines = [f"one,{X0 + 60},{Y0},{Z0},1,-2,30", f"two,{X0 + 160},{Y0},{Z0},0,1,-40"]
    small.orientation.write_text("\n".join(["name,x,y,z,omega,phi,kappa", *lines, ""]))
    make_project(small)
    return small


@pytest.mark.parametrize(
    ("verb", "side"),
    [
        ("ortho", 30),
        pytest.param("ortho", 75, marks=pytest.mark.slow),
        pytest.param("mosaic", 75, marks=pytest.mark.slow),
    ],
)
def test_fault_06_an_image_far_larger_than_memory(huge: Block, verb: str, side: int) -> None:
    """A sixteenth of it, 300 MB, falls on one tile: that is cut into parts, and each pixel is a mean of a thousand."""
    bounds = [X0 + 95 - side, Y0 - 40, X0 + 95, Y0 - 40 + side]
    words = [verb, huge.project, "--images", "one", "--resolution", "0.25", "--bounds", *bounds]
    said, peak = peak_of(*words, "--memory", "600MB", "--workers", 2)
    assert said.code == 0, said
    assert peak < LIMIT
    with rasterio.open(huge.folder / "products" / ("one_ortho.tif" if verb == "ortho" else "mosaic.tif")) as file:
        made, valid = file.read().astype(float), file.dataset_mask() > 0
    assert valid.all()
    # Noise from 60 to 199 has the mean 129.5; means of some 1100 pixels spread by 40/33.
    assert abs(made.mean() - 129.5) < 1
    assert made.std() < 3


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["seams", "balance"])
def test_fault_06_whole_images_far_larger_than_memory(huge: Block, verb: str) -> None:
    """Both are read to their last pixel; of bars, since a mean of noise is the same everywhere."""
    bars = np.broadcast_to(np.where(np.arange(256) < 128, 60, 160).astype(np.uint8)[:, None, None], (256, 256, 3))
    for path in huge.images[:2]:
        write_huge_tiff(path, bars, (SIDE, SIDE))
    words = [verb, huge.project, "--resolution", "1", "--no-picture", "--memory", "600MB", "--workers", 2]
    said, peak = peak_of(*words)
    assert said.code == 0, said
    assert peak < LIMIT


@pytest.mark.parametrize("verb", ["seams", "balance"])
def test_fault_06_what_does_not_suffice_is_refused(small: Block, verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = Here(capsys)(verb, small.project, "--memory", "100MB")
    assert said.code == 2 and "at least" in said.err and "MiB are needed" in said.err
    assert not (small.folder / "products").exists() and not (small.folder / "balance").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("ortho", "--images", "one", "--resolution", "0.5"),
        pytest.param(("ortho", "--images", "one", "--resolution", "2", "--hidden", "nodata"), marks=pytest.mark.slow),
        pytest.param(("mosaic", "--resolution", "0.5"), marks=pytest.mark.slow),
    ],
    ids=["ortho", "hidden, posts finer than pixels", "mosaic"],
)
def test_fault_06_terrain_far_larger_than_memory(small: Block, words: tuple[str, ...]) -> None:
    """Posts of 0.25 m over 10 km × 10 km: 6.4 GB in memory, of which an image sees some megabytes."""
    u, v = np.meshgrid(np.arange(256), np.arange(256))
    waves = (100 + 2 * np.sin(2 * np.pi * u / 256) * np.cos(2 * np.pi * v / 256)).astype(np.float32)
    place = (32633, X0 - 5000, Y0 + 5000, 0.25)
    write_huge_tiff(small.terrain, waves[..., None], (SIDE, SIDE), place)
    verb, *options = words
    said, peak = peak_of(verb, small.project, *options, "--memory", "600MB", "--workers", 2)
    assert said.code == 0, said
    assert peak < LIMIT
    with rasterio.open(small.folder / "products" / ("one_ortho.tif" if verb == "ortho" else "mosaic.tif")) as file:
        assert (file.dataset_mask() > 0).mean() > (0.7 if verb == "ortho" else 0.6)

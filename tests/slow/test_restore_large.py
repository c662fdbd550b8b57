"""Images far larger than the memory that their restoration may take."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import peak_of
from tools.huge_tiff import write_huge_tiff

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="needs the peak memory of a child")]

LIMIT = 500 * 2**20
SIDE = 24_576


def test_fault_06_an_image_larger_than_memory(tmp_path: Path) -> None:
    """24,576 × 24,576 pixels, 576 MiB: noise grows as computed, the constant part stays."""
    noise = np.random.default_rng(1).integers(100, 140, (512, 512, 1), dtype=np.uint8)
    image = write_huge_tiff(tmp_path / "huge.tif", noise, (SIDE, SIDE))
    small = write_huge_tiff(tmp_path / "small.tif", noise, (512, 512))
    weights = tmp_path / "weights.csv"
    weights.write_text("0,-0.2,0\n-0.2,1.8,-0.2\n0,-0.2,0\n")
    words = ["restore", image, "--filter", weights, "--memory", "500MB", "--workers", 2, "--compress", "none", "--json"]
    # Compiling the kernels, once on a machine, takes memory of its own.
    peak_of("restore", small, "--filter", weights, "--compress", "none", "--output", tmp_path / "first")
    said, peak = peak_of(*words)
    assert said.code == 0, said
    print(f"peak memory {peak / 2**20:.0f} MiB (≤ {LIMIT / 2**20:.0f}) for {SIDE**2 / 2**20:.0f} MiB of pixels")
    assert peak < LIMIT
    (facts,) = json.loads(said.out)["images"]
    with rasterio.open(facts["path"]) as file:
        made = file.read(1, window=rasterio.windows.Window(12_000, 12_000, 1000, 1000)).astype(float)
    assert abs(made.mean() - noise.mean()) < 0.1
    assert abs(made.std() / noise.std() / facts["noise_gain"] - 1) < 0.02

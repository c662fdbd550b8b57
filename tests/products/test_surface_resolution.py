"""What a surface resolves and how well: resolution times error, as Kirk et al. (2021) compare matchers by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage
from tools.command import inside
from tools.facet_scene import GSD, waves, write_scene
from tools.small_block import X0, Y0

#: Side of the fine grid of the truth, pixels of the images.
FINE = 0.5


@pytest.mark.slow
@pytest.mark.parametrize("images", [2, 5])
def test_resolution_times_error(images: int, tmp_path: Path) -> None:
    """Hills from 4 to 80 pixels long. Resolution: full width at half maximum of the Gaussian by which the truth is
    smoothed to be most like what was found; error: what then remains, pixels of parallax; asked: 2 square pixels."""
    lengths = GSD * np.geomspace(4, 80, 60)
    relief = waves(31, lengths, lengths / 80.0)
    scene = write_scene(tmp_path, images, seed=3, relief=relief)
    bounds = (X0 - 18, Y0 - 24, X0 + 18, Y0 + 24)
    words = ["--resolution", 1.0, "--bounds", *bounds, "--workers", 1, "--no-quicklook", "-q"]
    said = inside("surface", scene.path, *words, "--output", tmp_path / "made")
    assert said.code == 0, said.err
    with rasterio.open(tmp_path / "made" / "surface.tif") as file:
        found, to_map = file.read(1).astype(float), file.transform
    step, border = FINE * GSD, 12.0
    X, Y = np.meshgrid(
        np.arange(bounds[0] - border, bounds[2] + border, step),
        np.arange(bounds[3] + border, bounds[1] - border, -step),
    )
    true = scene.heights(X, Y)
    rows, columns = np.mgrid[: found.shape[0], : found.shape[1]]
    x, y = to_map @ (columns + 0.5, rows + 0.5)
    at = [(Y[0, 0] - y) / step, (x - X[0, 0]) / step]
    best = (np.inf, 0.0)
    for width in np.arange(0.5, 20, 0.25):
        smooth = ndimage.gaussian_filter(true, width / FINE / 2.3548)
        error = (found - ndimage.map_coordinates(smooth, at, order=3))[4:-4, 4:-4]
        best = min(best, (float(np.sqrt(np.mean((error - error.mean()) ** 2))), width))
    error, width = best[0] / scene.height_of_a_pixel, best[1]
    spread = true.std() / scene.height_of_a_pixel
    print(
        f"{images} images: resolution {width} px, error {error:.3f} px (hills {spread:.2f}), "
        f"product {width * error:.2f}"
    )
    assert width * error < 0.5

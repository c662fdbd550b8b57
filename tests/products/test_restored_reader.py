"""Windows of an image that is restored while it is read are those of the restored file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.small_block import write_image
from tools.thinned import some

from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.products.restore import RestoreRequest, restore_images
from photoplan.project.steps import SteppedReader, restored
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter

SIZE = (700, 560)


def sharpening() -> RestorationFilter:
    values = np.random.default_rng(1).normal(size=(7, 5)) * 0.05
    values[3, 2] += 1 - values.sum()
    return RestorationFilter((FilterKernel(values),))


@pytest.mark.parametrize("kind", some(["plain", "nodata", "mask", "float32", "int16"], 1, 4))
def test_any_window_is_that_of_the_file(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(2)
    pixels = rng.integers(60, 140, (2, SIZE[1], SIZE[0])).astype(kind if kind in ("float32", "int16") else np.uint8)
    bad = rng.random(pixels.shape[1:]) < 0.02
    bad[200:260, 300:] = True
    image = tmp_path / "image.tif"
    if kind == "plain":
        write_image(image, pixels)
    elif kind == "mask":
        write_image(image, pixels)
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(image, "r+") as file:
            file.write_mask(~bad)
    else:
        # A value in the middle: restored pixels come upon it, and must not vanish.
        nodata = np.nan if kind == "float32" else 100
        pixels[:, ~bad] = np.where(pixels[:, ~bad] == 100, 101, pixels[:, ~bad])
        pixels[:, bad] = nodata
        write_image(image, pixels, nodata=nodata)
    file = RasterReader(restore_images(RestoreRequest((image,), sharpening(), tmp_path / "out")).images[0].path)
    reader = restored(SteppedReader(RasterReader(image)), sharpening())
    assert (reader.size, reader.bands, reader.dtype) == (file.size, file.bands, file.dtype)
    windows = [Window(0, 0, *SIZE), Window(690, 550, 10, 10), Window(299, 190, 3, 30), Window(0, 259, 700, 1)]
    for _ in range(12):
        col, row = rng.integers(0, SIZE[0] - 40), rng.integers(0, SIZE[1] - 40)
        windows.append(Window(int(col), int(row), int(rng.integers(1, 41)), int(rng.integers(1, 41))))
    for window in windows:
        (made, valid), (stored, known) = reader.read(window), file.read(window)
        valid = np.ones(made.shape[1:], bool) if valid is None else valid
        known = np.ones(made.shape[1:], bool) if known is None else known
        assert np.array_equal(valid, known)
        assert np.array_equal(made[:, valid], stored[:, valid])
    assert np.array_equal(file.read(windows[0])[1] if kind != "plain" else ~bad, ~bad)

"""A finished product is opened again and compared with what was computed, before it gets its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.windows
from numpy.typing import NDArray

from photoplan.errors import PhotoplanError
from photoplan.geometry.grid import Window
from photoplan.io.gdal import gdal_settings, open_raster
from photoplan.io.tiff_layout import read_tiff_layouts

_SIDE = 16
_LOSSY = 16.0
"""Difference in grey values of means over 16 × 16 pixels up to which a tile compressed with losses counts as the one
that was computed: compression changes fine detail and noise, means hardly."""


def check_product(
    path: Path,
    profile: dict[str, Any],
    samples: Sequence[Window],
    expected: Callable[[Window], tuple[NDArray[Any], NDArray[np.bool_]]],
    *,
    lossy: bool,
    overviews: bool,
    driver: str = "COG",
) -> None:
    """Compare a file with what it must hold."""
    if driver == "COG":
        read_tiff_layouts(path)
    with open_raster(path, "GTiff" if driver == "COG" else driver) as dataset, gdal_settings():
        for name in ("width", "height", "count", "transform"):
            if getattr(dataset, name) != profile[name]:
                raise PhotoplanError(f"{path}: {name} is {getattr(dataset, name)}, not {profile[name]}")
        if dataset.dtypes[0] != profile["dtype"]:
            raise PhotoplanError(f"{path}: pixels are {dataset.dtypes[0]}, not {profile['dtype']}")
        if profile["crs"] is not None and (
            dataset.crs is None or dataset.crs.to_epsg() != rasterio.crs.CRS.from_user_input(profile["crs"]).to_epsg()
        ):
            raise PhotoplanError(f"{path}: the reference system {profile['crs']} was not kept")
        if overviews and not dataset.overviews(1):
            raise PhotoplanError(f"{path}: the overviews are missing")
        for factor in dataset.overviews(1):
            shape = -(-dataset.height // factor), -(-dataset.width // factor)
            if shape[0] * shape[1] <= 1 << 20:
                dataset.read(1, out_shape=shape)
        for window in samples:
            _compare(path, dataset, window, *expected(window), lossy=lossy)


def _compare(
    path: Path, dataset: Any, window: Window, wanted: NDArray[Any], seen: NDArray[np.bool_], *, lossy: bool
) -> None:
    """Compare one window of a file with what was computed."""
    area = rasterio.windows.Window(window.col, window.row, window.width, window.height)
    pixels, valid = dataset.read(window=area), (dataset.read_masks(window=area) > 0).any(axis=0)
    good = np.array_equal(valid, seen)
    if good and lossy:
        good = float(np.abs(_block_means(pixels * valid) - _block_means(wanted * valid)).max()) <= _LOSSY
    elif good:
        good = np.array_equal(pixels[:, valid], wanted[:, valid], equal_nan=pixels.dtype.kind == "f")
    if not good:
        raise PhotoplanError(f"{path}: {window} is not what was computed; the disk or a library is at fault, run again")


def _block_means(pixels: NDArray[Any]) -> NDArray[np.float64]:
    """Means over blocks of 16 × 16 pixels, shape (bands, rows, columns) of blocks; the last ones are smaller."""
    rows, cols = (np.arange(0, length, _SIDE) for length in pixels.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(pixels.astype(np.float64), rows, axis=1), cols, axis=2)
    heights = np.diff([*rows, pixels.shape[1]])
    widths = np.diff([*cols, pixels.shape[2]])
    return np.asarray(sums / (heights[:, None] * widths))

"""Images that are in memory as a whole, written as TIFF; the name holds the old or the whole new file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray

from photoplan.errors import PhotoplanError, UsageError
from photoplan.io.disk import disk_error, library_error
from photoplan.io.gdal import GDAL_ERRORS, gdal_settings
from photoplan.io.naming import give_name, scratch

_TYPES = ("uint8", "uint16", "int16", "float32")


def write_whole_image(path: Path, values: NDArray[Any], tags: Mapping[str, str] | None = None) -> None:
    """Write an image without place on the map and without nodata: every value is a value."""
    bands = values[None] if values.ndim == 2 else values
    if bands.ndim != 3 or bands.dtype.name not in _TYPES:
        raise UsageError(f"{path}: pixels of type {bands.dtype}, shape {values.shape}; allowed are {', '.join(_TYPES)}")
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": bands.shape[2],
        "height": bands.shape[1],
        "count": bands.shape[0],
        "dtype": bands.dtype.name,
        "compress": "deflate",
        "predictor": 3 if bands.dtype.kind == "f" else 2,
        "bigtiff": "IF_SAFER",
    }
    if min(bands.shape[1:]) >= 256:
        profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256}
    try:
        with scratch(path.parent) as folder:
            part = folder / "part.tif"
            with gdal_settings(GDAL_PAM_ENABLED=False), rasterio.open(part, "w", **profile) as dataset:
                dataset.write(bands)
                dataset.update_tags(**dict(tags or {}))
            _check(part, bands, path)
            give_name(part, path)
    except OSError as error:
        raise disk_error(path, error) from error
    except GDAL_ERRORS as error:
        raise library_error(path, error) from error


def _check(part: Path, bands: NDArray[Any], path: Path) -> None:
    """Read the file again: a late error of the disk would show in its last block."""
    with gdal_settings(), rasterio.open(part) as dataset:
        last = dataset.read(window=rasterio.windows.Window(0, bands.shape[1] - 1, bands.shape[2], 1))
    if not np.array_equal(last[:, 0], bands[:, -1], equal_nan=bands.dtype.kind == "f"):
        raise PhotoplanError(f"{path}: the last line was not kept on the disk; run the command again")

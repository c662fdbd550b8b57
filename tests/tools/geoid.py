"""A geoid of one undulation, as PROJ finds it: the grid of EGM96 over half a degree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

UNDULATION = 47.0
"""Metres."""
_COUNT, _PITCH = 50, 0.01


def write_geoid(folder: Path, crs: str, middle: tuple[float, float], ends_there: bool = False) -> None:
    """The grid around a place of a CRS, or west of it. Those that a process looked for once it remembers."""
    lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*middle)
    west = lon - (_COUNT - 0.5 if ends_there else _COUNT / 2) * _PITCH
    corner = from_origin(west, lat + _COUNT / 2 * _PITCH, _PITCH, _PITCH)
    profile = {"width": _COUNT, "height": _COUNT, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(folder / "us_nga_egm96_15.tif", "w", driver="GTiff", transform=corner, **profile) as file:
        file.write(np.full((1, _COUNT, _COUNT), UNDULATION, np.float32))
        file.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        file.set_band_description(1, "geoid_undulation")

"""Rational polynomials that an image file holds itself: tags of TIFF, metadata of other formats."""

from __future__ import annotations

from pathlib import Path

import rasterio

from photoplan.cameras.rpc import RationalFunctions
from photoplan.io.camera.rpc.model import stated
from photoplan.io.gdal import gdal_settings, not_georeferenced
from photoplan.io.raster_info import read_info

FORM = "tags of the image file"


def read(path: Path) -> RationalFunctions | None:
    """Polynomials of an image file; None if it holds none.

    Files beside it are not looked at: what decides a product is named.
    """
    driver = read_info(path).driver
    alone = gdal_settings(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR")
    with not_georeferenced(), alone, rasterio.open(path, driver=driver, sharing=False) as image:
        values = image.tags(ns="RPC")
    return stated(values, f"{path}: RPC") if values else None

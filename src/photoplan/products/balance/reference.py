"""A reference for colours: an orthophoto or mosaic that exists, usually of coarser pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.map import MapProjection
from photoplan.engine.base import Source
from photoplan.engine.execute import render
from photoplan.errors import InputError
from photoplan.geometry.crs import crs_step, same_crs
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.image_form import placement_of
from photoplan.io.raster import RasterReader
from photoplan.plan.compile import AnchorRule
from photoplan.plan.product import ProductPlan
from photoplan.plan.tiles import Tile, Tiles
from photoplan.surfaces.level import LevelSurface
from photoplan.targets.map import MapTarget

_KERNEL, _TOLERANCE = "bilinear", 0.1


@dataclass(frozen=True, eq=False)
class Reference:
    """A raster on the map."""

    path: Path
    source: Source
    pixel: float
    """Side of its pixels, units of its CRS."""

    def pixels(self, grid: MapGrid, window: Window) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
        """What it holds for a window of the map, (bands, height, width), and where; None: nothing."""
        rule = AnchorRule.of(_KERNEL, _TOLERANCE)
        plan = ProductPlan("reference", ("reference",), MapTarget(grid), rule, Tiles.every(grid.window, 512))
        made = render(plan, Tile(0, window), (self.source,), LevelSurface(0.0), _KERNEL)
        if made.values is None or made.valid is None:
            return None
        return made.values.astype(np.float32), made.valid


def open_reference(path: Path, grid: MapGrid, bands: int, dtype: np.dtype[Any]) -> Reference:
    """A reference for images of some bands and type, compared on a map.

    Raises
    ------
    InputError
        It has other bands or another type of pixels, or lies nowhere on the map.
    """
    reader = RasterReader(path)
    if reader.bands != bands or reader.dtype != dtype:
        raise InputError(
            f"{path}: {reader.bands} bands of {reader.dtype}; a reference has those of the images, {bands} of {dtype}: "
            "choose and scale its bands before, for instance with gdal_translate"
        )
    placement = placement_of(reader.info)
    if placement.transform is None or placement.crs is None:
        raise InputError(f"{path}: no georeference or no CRS; a reference is a raster on the map")
    carry = None if same_crs(placement.crs, grid.crs) else crs_step(grid.crs, placement.crs, grid.bounds)
    a, b = placement.coefficients[:2]
    return Reference(path, Source(MapProjection(placement, carry), reader), float(np.hypot(a, b)))

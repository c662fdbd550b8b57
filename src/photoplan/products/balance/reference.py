"""A reference for colours: an orthophoto or mosaic that exists, usually of coarser pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
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


@dataclass(frozen=True)
class Reference:
    """A raster on the map; small, and pickles: it is opened when it is asked for pixels."""

    path: Path
    crs: str
    bounds: tuple[float, float, float, float]
    """CRS and bounds of the map."""
    pixel: float
    """Side of its pixels, units of its CRS."""

    def pixels(self, grid: MapGrid, window: Window) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
        """What it holds for a window of the map, (bands, height, width), and where; None: nothing."""
        rule = AnchorRule.of(_KERNEL, _TOLERANCE)
        plan = ProductPlan(
            name="reference",
            sources=("reference",),
            target=MapTarget(grid),
            rule=rule,
            tiles=Tiles.every(grid.window, 512),
        )
        made = render(plan, Tile(0, window), (_source(self),), LevelSurface(0.0), _KERNEL)
        if made.values is None or made.valid is None:
            return None
        return made.values.astype(np.float32), made.valid


def open_reference(path: Path, grid: MapGrid, bands: int, dtype: np.dtype[Any]) -> Reference:
    """A reference for images of some bands and type, compared on a map."""
    reader = RasterReader(path)
    if reader.bands != bands or reader.dtype != dtype:
        raise InputError(
            f"{path}: {reader.bands} bands of {reader.dtype}; a reference has those of the images, {bands} of {dtype}: "
            "choose and scale its bands before, for instance with gdal_translate"
        )
    placement = placement_of(reader.info)
    if placement.transform is None or placement.crs is None:
        raise InputError(f"{path}: no georeference or no CRS; a reference is a raster on the map")
    assert grid.crs is not None, "overlaps are sampled on the map"
    a, b = placement.coefficients[:2]
    return Reference(path, grid.crs, grid.bounds, float(np.hypot(a, b)))


@lru_cache(maxsize=4)
def _source(reference: Reference) -> Source:
    reader = RasterReader(reference.path)
    placement = placement_of(reader.info)
    assert placement.crs is not None
    apart = not same_crs(placement.crs, reference.crs)
    carry = crs_step(reference.crs, placement.crs, reference.bounds, placement.middle[0]) if apart else None
    return Source(MapProjection(placement, carry), reader)

"""Images in memory, and scenes small enough for the slow twin."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import MapGrid
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Tiles
from photoplan.plan.product import ProductPlan
from photoplan.targets.map import MapTarget


def product(
    grid: MapGrid, side: int = 512, names: tuple[str, ...] = ("image",), owners: Any = None, **rule: Any
) -> ProductPlan:
    """A plan that has every tile of a grid."""
    cut = AnchorRule(**({"tolerance": 0.02, "radius": 3} | rule))
    tiles = Tiles.every(grid.window, side, len(names))
    return ProductPlan("image_ortho", names, MapTarget(grid), cut, tiles, owners)


def noise(bands: int, rows: int, cols: int, dtype: str, seed: int = 0) -> NDArray[Any]:
    """Grey values over the whole range of a type."""
    rng = np.random.default_rng(seed)
    if dtype == "float32":
        return rng.normal(0, 1, (bands, rows, cols)).astype(np.float32)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, (bands, rows, cols), dtype=dtype, endpoint=True)

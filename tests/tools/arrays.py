"""Images in memory, and scenes small enough for the slow twin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.levels import reduced
from photoplan.plan.compile import AnchorRule
from photoplan.plan.product import ProductPlan, Tile
from photoplan.targets.map import MapTarget


@dataclass(frozen=True, eq=False)
class ArrayReader:
    """A source image in memory; counts nothing, keeps nothing."""

    image: NDArray[Any]
    valid: NDArray[np.bool_] | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.image.shape[2], self.image.shape[1]

    @property
    def bands(self) -> int:
        return int(self.image.shape[0])

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.image.dtype

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        if level:
            return reduced(self, window, level)
        assert window & Window(0, 0, *self.size) == window, "read outside the image"
        part = np.s_[window.row : window.stop[1], window.col : window.stop[0]]
        return self.image[:, part[0], part[1]], None if self.valid is None else self.valid[part]


def product(
    grid: MapGrid, side: int = 512, names: tuple[str, ...] = ("image",), owners: Any = None, **rule: Any
) -> ProductPlan:
    """A plan that has every tile of a grid."""
    cut = AnchorRule(**({"tolerance": 0.02, "radius": 3} | rule))
    tiles = tuple(Tile(i, w, tuple(range(len(names)))) for i, w in enumerate(grid.window.tiles(side)))
    return ProductPlan("image_ortho", names, MapTarget(grid), side, cut, tiles, owners)


def noise(bands: int, rows: int, cols: int, dtype: str, seed: int = 0) -> NDArray[Any]:
    """Grey values over the whole range of a type."""
    rng = np.random.default_rng(seed)
    if dtype == "float32":
        return rng.normal(0, 1, (bands, rows, cols)).astype(np.float32)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, (bands, rows, cols), dtype=dtype, endpoint=True)

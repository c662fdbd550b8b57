"""A product before its pixels: grid, tiles, and how each tile is compiled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera
from photoplan.geometry.grid import Window
from photoplan.plan.anchors import Anchors
from photoplan.plan.compile import AnchorRule, compile_anchors
from photoplan.surfaces.base import Surface
from photoplan.targets.base import Target


@dataclass(frozen=True, order=True)
class Tile:
    """A part of a product that is one task."""

    index: int
    """Its place among all tiles of the product, row by row: also the empty ones are counted."""
    window: Window
    """Its pixels in the product."""


@dataclass(frozen=True, eq=False)
class CompiledTile:
    """Relief, anchors and owner of a tile: all that the engine needs besides pixels."""

    window: Window
    """Its pixels in the product."""
    relief: NDArray[np.float32]
    """h of each pixel, shape (height, width); NaN where there is no surface."""
    anchors: Anchors | None
    """Where its pixels lie in the source; None if it holds none of the image."""
    owner: int
    """Which source paints it: 1-based, 0 = none."""


@dataclass(frozen=True)
class ProductPlan:
    """One product of one source."""

    name: str
    """Name of the product, and of its file without the extension."""
    image: str
    """Name of the source image in the project."""
    target: Target
    """The product's own coordinates."""
    tile_side: int
    """Side of a tile, target pixels."""
    rule: AnchorRule
    """How finely tiles are cut."""
    tiles: tuple[Tile, ...]
    """Tiles that can hold a part of the image; all others stay empty."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.target.window.width, self.target.window.height

    @property
    def tile_count(self) -> int:
        """Number of tiles, the empty ones included."""
        across, down = (-(-s // self.tile_side) for s in self.size)
        return across * down


def compile_tile(product: ProductPlan, window: Window, camera: Camera, surface: Surface) -> CompiledTile:
    """Relief and anchors of a window of a product. Pure: the same inputs give the same bytes.

    Parameters
    ----------
    product : ProductPlan
    window : Window
        A tile of the product, or a part of one.
    camera, surface : Camera, Surface
        Those of the product's image and project.
    """
    relief = surface.relief(product.target, window)
    anchors = compile_anchors(camera, product.target, window, relief, product.rule)
    return CompiledTile(window, relief, anchors, 0 if anchors is None else 1)

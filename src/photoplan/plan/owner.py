"""Which source paints which pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection
from photoplan.errors import UsageError
from photoplan.plan.ground import TileGround
from photoplan.plan.visibility import hidden_pixels
from photoplan.surfaces.base import Surface


@dataclass(frozen=True, eq=False)
class Share:
    """Who paints the pixels of a tile."""

    owner: NDArray[np.uint16] | None
    """Row of the table of sources, plus one, for every pixel, shape (height, width); 0: no source. None: there is one
    source, and it paints whatever it shows."""
    hidden: NDArray[np.bool_] | None = None
    """Pixels that lie in images, but that no source sees, painted or not; None: nobody has asked."""
    clear: Mapping[int, NDArray[np.bool_]] = field(default_factory=dict)
    """By row, of the sources that paint at least: pixels that they see, and away from their border and from what they
    do not see."""


class Ownership(Protocol):
    """A rule that gives every pixel of a product to one source, before any pixel moves.

    What a pixel gets depends on the pixel alone, never on the window in which it is asked for, so that tiles join.
    """

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """Who paints each pixel of a tile."""
        ...


@dataclass(frozen=True, eq=False)
class GivenOwners:
    """Owners that somebody has drawn: a raster over the whole product."""

    raster: NDArray[np.uint16]
    """Row of the table of sources, plus one; 0: nobody. Shape (height, width) of the product."""

    def __post_init__(self) -> None:
        if self.raster.ndim != 2 or self.raster.dtype != np.uint16:
            raise UsageError(f"owners of shape {self.raster.shape} and type {self.raster.dtype}; a raster of uint16")

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """The part of the raster that lies in the tile's window."""
        target, window = ground.target, ground.window
        right, bottom = window.stop
        if window & target.window != window or self.raster.shape != (target.window.height, target.window.width):
            raise UsageError(f"owners of shape {self.raster.shape} do not cover {window} of {target.window}")
        return Share(np.ascontiguousarray(self.raster[window.row : bottom, window.col : right]))


@dataclass(frozen=True)
class InSight:
    """One source, and a look at which pixels it sees."""

    paints_hidden: bool = False
    """Whether it paints those too that something hides, with what hides them."""

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """The only source paints what it sees, or all."""
        ((row, camera),) = cameras.items()
        hidden = hidden_pixels(camera, ground, surface)
        return Share(None if self.paints_hidden else np.where(hidden, 0, row + 1).astype(np.uint16), hidden)

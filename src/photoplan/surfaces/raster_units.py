"""Computing units over a raster of heights: its posts as they are, in squares of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.units import Unit, UnitLayout

#: Meshes along a unit's side at most.
MESHES = 64
#: Posts are square if their distances along X and Y differ by no more than this part.
_SQUARE = 1e-9


@dataclass(frozen=True, eq=False)
class RasterUnits:
    """A source of computing units (`UnitSource`) whose posts are the posts of a raster; their sigmas are unknown."""

    surface: RasterSurface
    """In the raster's own CRS."""

    def __post_init__(self) -> None:
        dx, dy = self.surface.mesh
        if abs(dx - dy) > _SQUARE * max(dx, dy):
            raise InputError(
                f"raster with posts {dx:.10g} m × {dy:.10g} m apart; make its cells square with gdalwarp -tr"
            )
        if min(self.surface.grid.size) < 2:
            raise InputError(f"raster of {self.surface.grid.size} posts; at least 2 × 2 are needed")

    @property
    def meshes(self) -> int:
        """Meshes along a unit's side."""
        return min(MESHES, max(self.surface.grid.size) - 1)

    @property
    def layout(self) -> UnitLayout:
        """Where the units lie: the first post is the corner of the first unit."""
        columns, rows = (-(-(count - 1) // self.meshes) for count in self.surface.grid.size)
        return UnitLayout(*self.surface.origin, side=self.meshes * self.finest, columns=columns, rows=rows)

    @property
    def finest(self) -> float:
        """Distance of posts, metres."""
        return self.surface.mesh[0]

    @cached_property
    def ranges(self) -> NDArray[np.float64]:
        """Bounds of the heights of every unit, shape (rows, columns, 2); NaN for empty units."""
        layout = self.layout
        column, row = np.meshgrid(np.arange(layout.columns), np.arange(layout.rows))
        left, top = layout.left + column * layout.side, layout.top - row * layout.side
        return self.surface.height_range(np.stack([left, top - layout.side, left + layout.side, top], axis=-1))

    def unit(self, column: int, row: int) -> Unit | None:
        """The unit, or None if it is empty."""
        layout = self.layout
        left, top = layout.corner(column, row)
        k = np.arange(self.meshes + 1)
        x, y = np.meshgrid(left + k * self.finest, top - k * self.finest)
        Z = self.surface.heights(np.stack([x, y], axis=-1))
        if not np.isfinite(Z).any():
            return None
        datum = float(np.rint(np.nanmean(Z)))
        heights = (Z - datum).astype(np.float32)
        return Unit(
            left=left,
            top=top,
            side=layout.side,
            heights=heights,
            sigmas=np.full(heights.shape, np.nan, np.float32),
            datum=datum,
        )

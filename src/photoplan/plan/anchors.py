"""Where the pixels of a tile lie in the source image: a projective or smooth factor, and a field in the image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.geometry.levels import level_size


@dataclass(frozen=True, eq=False)
class Anchors:
    """A tile cut into rectangles, each a pile of boxes in (u, v, h) with eight homogeneous corners.

    A pixel looks up the box of its rectangle that holds its height, interpolates (x·w, y·w, w) trilinearly and
    divides once. For a frame camera over a map this is exact for a box of any size. What the field of the projection
    adds to the position (a lens) is interpolated between nodes.
    """

    rects: NDArray[np.int32]
    """(m, 4): first column, first row, end column, end row of each rectangle, relative to the tile; half-open."""
    box_start: NDArray[np.int32]
    """(m + 1,): boxes of rectangle i are `box_start[i]` to `box_start[i + 1]`, from low to high, without gaps."""
    box_heights: NDArray[np.float64]
    """(n, 2): lowest and highest h of each box, metres."""
    corners: NDArray[np.float64]
    """(n, 8, 3): (x·w, y·w, w) at corner 4·ih + 2·iv + iu. The corners of a rectangle lie on its pixels' outer edges
    (first column − 1/2, end column − 1/2); x and y are relative to the first pixel of `source_window`, without the
    field; w > 0 and is scaled to be about 1 inside a tile."""
    field_frame: NDArray[np.float64]
    """(5,): x and y of the field's first node, in the coordinates of `corners`; nodes per pixel along x and y; largest
    factor by which the field makes a distance longer."""
    field: NDArray[np.float32]
    """(rows, columns, 2): what is added to x and y at the nodes; (0, 0, 2): the projection has no field. Positions
    beyond the nodes are not in the image."""
    residual: float
    """Worst difference to the strict position, pixels: of the boxes, measured at their centre, face and edge middles,
    plus of the field, measured in and beside its cells' middles, and at declared breaks."""
    source_window: Window
    """Part of the source image that holds every position, with the kernel's margin, cut at the image's border."""
    scales: tuple[float, float]
    """Smallest and largest number of source pixels per target pixel along x or y."""

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """What the kernels take."""
        return self.rects, self.box_start, self.box_heights, self.corners, self.field_frame, self.field

    def at_level(self, level: int, size: tuple[int, int]) -> Anchors:
        """The same for an image of `size` that is reduced by 2 to the power of `level`; the residual stays as it is."""
        if level == 0:
            return self
        f, old = 2.0**level, self.source_window
        limit = level_size(size, level)
        # A pixel more all round: the margin was made for pixels of full size.
        col, row = max((old.col >> level) - 1, 0), max((old.row >> level) - 1, 0)
        right, bottom = (min(-(-stop >> level) + 1, most) for stop, most in zip(old.stop, limit))
        window = Window(col, row, max(0, right - col), max(0, bottom - row))
        corners = self.corners.copy()
        for axis, (before, after) in enumerate(((old.col, col), (old.row, row))):
            corners[..., axis] /= f
            corners[..., axis] += ((before + 0.5) / f - 0.5 - after) * corners[..., 2]
        frame = self.field_frame.copy()
        for axis, (before, after) in enumerate(((old.col, col), (old.row, row))):
            frame[axis] = (frame[axis] + before + 0.5) / f - 0.5 - after
            frame[axis + 2] *= f
        return replace(
            self,
            corners=corners,
            field_frame=frame,
            field=self.field / np.float32(f),
            source_window=window,
            scales=(self.scales[0] / f, self.scales[1] / f),
        )

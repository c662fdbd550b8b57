"""Where a model has a surface: inside border lines, and not far from data."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

#: A prepared polygon builds its index when it is first asked, and GEOS does not guard that against other threads.
_ONE_AT_A_TIME = threading.Lock()

#: Cells of the raster that says what is near data, at most; more area means larger cells.
_MOST_CELLS = 30_000_000


@dataclass(frozen=True, eq=False)
class Domain:
    """A raster of cells near data, and the polygon of border lines if there is one."""

    left: float
    top: float
    cell: float
    """Side of a cell, metres."""
    near: NDArray[np.bool_]
    """Cells near data, shape (rows, columns), row 0 in the north."""
    polygon: Any | None
    """Shapely polygon of the border lines in the same coordinates; None: there are none."""

    @classmethod
    def of(cls, xy: NDArray[np.float64], spacing: float, reach: float, polygon: Any | None) -> Domain:
        """Close the gaps between data (n, 2): what lies further than `reach` from data is outside, unless data surround
        it. The outline of the data is kept: it grows by one spacing only.
        """
        low, high = xy.min(axis=0), xy.max(axis=0)
        extent = high - low + 2 * reach
        cell = max(spacing, float(np.sqrt(extent[0] * extent[1] / _MOST_CELLS)))
        margin = int(np.ceil(reach / cell)) + 2
        columns, rows = (np.ceil((high - low) / cell).astype(int) + 1 + 2 * margin).tolist()
        left, top = low[0] - (margin + 0.5) * cell, high[1] + (margin + 0.5) * cell
        occupied = np.zeros((rows, columns), bool)
        occupied[((top - xy[:, 1]) / cell).astype(int), ((xy[:, 0] - left) / cell).astype(int)] = True
        grown = distance_transform_edt(~occupied) * cell <= reach
        closed = distance_transform_edt(grown) * cell > reach
        near = distance_transform_edt(~(closed | occupied)) < 1.5
        if polygon is not None:
            shapely.prepare(polygon)
        return cls(float(left), float(top), cell, near, polygon)

    def contains(self, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether places (n, 2) have a surface."""
        rows, columns = self.near.shape
        column = np.floor((xy[:, 0] - self.left) / self.cell).astype(int)
        row = np.floor((self.top - xy[:, 1]) / self.cell).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        inside[inside] = self.near[row[inside], column[inside]]
        if self.polygon is not None and inside.any():
            with _ONE_AT_A_TIME:
                inside[inside] = shapely.contains_xy(self.polygon, xy[inside])
        return inside

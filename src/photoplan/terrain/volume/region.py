"""Which cells of a grid a polygon covers: whole ones, and the exact parts of those that its edge crosses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.geometry.grid import MapGrid, Window


@dataclass(frozen=True, eq=False)
class CoveredCells:
    """Cells of a window that lie in a polygon."""

    whole: NDArray[np.bool_]
    """True where the whole cell lies inside, shape (height, width)."""
    rows: NDArray[np.int64]
    """Row in the window of each cell that the polygon's edge crosses, shape (n,)."""
    columns: NDArray[np.int64]
    areas: NDArray[np.float64]
    """Covered part of each of these cells, shape (n,), square metres."""
    centroids: NDArray[np.float64]
    """X, Y of the covered part's centroid, shape (n, 2): a linear function times the area is integrated exactly."""


def cover(polygon: Any, grid: MapGrid, window: Window) -> CoveredCells | None:
    """Cells of a window that lie inside a polygon; None if none does.

    Blocks of cells are halved until they lie inside or outside, so that the cost follows the polygon's length, not its
    area. A polygon that is prepared (`shapely.prepare`) is looked at faster.
    """
    whole = np.zeros((window.height, window.width), bool)
    blocks = np.array([[0, 0, window.height, window.width]])
    edge: list[NDArray[np.int64]] = []
    while len(blocks):
        boxes = _boxes(grid, window, blocks)
        touched = shapely.intersects(polygon, boxes)
        blocks, boxes = blocks[touched], boxes[touched]
        inside = shapely.covers(polygon, boxes)
        for row0, col0, row1, col1 in blocks[inside]:
            whole[row0:row1, col0:col1] = True
        blocks = blocks[~inside]
        single = (blocks[:, 2] - blocks[:, 0] == 1) & (blocks[:, 3] - blocks[:, 1] == 1)
        edge.append(blocks[single])
        blocks = _halves(blocks[~single])
    cells = np.concatenate(edge) if edge else np.empty((0, 4), np.int64)
    parts = shapely.intersection(polygon, _boxes(grid, window, cells))
    areas = shapely.area(parts)
    keep = areas > 0
    if not (whole.any() or keep.any()):
        return None
    centroids = shapely.get_coordinates(shapely.centroid(parts[keep]))
    return CoveredCells(whole, cells[keep, 0], cells[keep, 1], areas[keep], centroids)


def _boxes(grid: MapGrid, window: Window, blocks: NDArray[np.int64]) -> NDArray[Any]:
    left = grid.left + (window.col + blocks[:, 1]) * grid.resolution
    right = grid.left + (window.col + blocks[:, 3]) * grid.resolution
    top = grid.top - (window.row + blocks[:, 0]) * grid.resolution
    bottom = grid.top - (window.row + blocks[:, 2]) * grid.resolution
    return np.asarray(shapely.box(left, bottom, right, top))


def _halves(blocks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Each block cut into four, those without cells left out."""
    row0, col0, row1, col1 = blocks.T
    row, col = (row0 + row1 + 1) // 2, (col0 + col1 + 1) // 2
    parts = [(row0, col0, row, col), (row0, col, row, col1), (row, col0, row1, col), (row, col, row1, col1)]
    quarters = np.concatenate([np.stack(part, axis=1) for part in parts])
    return quarters[(quarters[:, 2] > quarters[:, 0]) & (quarters[:, 3] > quarters[:, 1])]

"""Polygons as squares, large inside and small along the border (Behr 1989, §6.2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.surfaces.objects import Faces
from photoplan.surfaces.polygon_faces import LEAST_AREA

#: More squares than this are not made of one polygon.
MOST_SQUARES = 4_000_000
#: Outlines are put together from triangles on a lattice of this width, metres.
_LATTICE = 1e-4


@dataclass(frozen=True, eq=False)
class Squares:
    """Squares of a polygon in the order of Behr's linear list: depth first; NW, NE, SW, SE."""

    corner: NDArray[np.float64]
    """Upper-left corners X, Y, shape (n, 2), metres."""
    side: NDArray[np.float64]
    """Shape (n,), metres."""
    level: NDArray[np.int64]
    """Number of divisions of a mesh, shape (n,)."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Outer edges xmin, ymin, xmax, ymax, shape (n, 4)."""
        (x, y), side = self.corner.T, self.side
        return np.stack([x, y - side, x + side, y], axis=1)


def decompose(polygon: Any, corner: tuple[float, float], mesh: float, levels: int) -> Squares:
    """Squares that a polygon is made of.

    Meshes that lie inside stay as they are, those outside are dropped, all others are divided by four; the smallest
    belong to the polygon if their middles do.
    """
    xmin, ymin, xmax, ymax = polygon.bounds
    col = np.arange(np.floor((xmin - corner[0]) / mesh), np.ceil((xmax - corner[0]) / mesh))
    row = np.arange(np.floor((corner[1] - ymax) / mesh), np.ceil((corner[1] - ymin) / mesh))
    finest = mesh / 2**levels
    if polygon.length / finest + len(col) * len(row) > MOST_SQUARES / 4:
        raise UsageError(f"a polygon of {polygon.length:.6g} m in squares of {finest:g} m; choose larger ones")
    # Columns and rows are counted in squares of each level, from the first mesh.
    at = np.stack(np.meshgrid(col - col[0], row - row[0]), axis=-1).reshape(-1, 2).astype(np.int64)
    first = np.array([corner[0] + col[0] * mesh, corner[1] - row[0] * mesh])
    shapely.prepare(polygon)
    found = []
    for level in range(levels + 1):
        side = mesh / 2**level
        x, y = (first + at * (side, -side)).T
        boxes = shapely.box(x, y - side, x + side, y)
        inside = shapely.contains(polygon, boxes)
        divide = ~inside & shapely.intersects(polygon, boxes)
        if level == levels:
            inside |= divide & shapely.contains_xy(polygon, x + side / 2, y - side / 2)
        found.append((at[inside], np.full(int(inside.sum()), level)))
        at = (2 * at[divide][:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]])).reshape(-1, 2)
    places, level_of = (np.concatenate(part) for part in zip(*found))
    scale = 2 ** (levels - level_of)
    order = np.lexsort((_along(places * scale[:, None]),))
    places, level_of = places[order], level_of[order]
    side_of = mesh / 2.0**level_of
    return Squares(first + places * np.stack([side_of, -side_of], axis=1), side_of, level_of)


def _along(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Place of the finest squares along a depth-first way (the curve of Morton)."""
    code = np.zeros(len(places), np.int64)
    for bit in range(31):
        code |= ((places[:, 0] >> bit & 1) << (2 * bit)) | ((places[:, 1] >> bit & 1) << (2 * bit + 1))
    return code


def outlines(faces: Faces, bounds: tuple[float, float, float, float]) -> list[tuple[str, Faces, Any]]:
    """Objects inside bounds on the map: name, faces, and outline there."""
    flat = faces.corners[..., :2]
    (ax, ay), (bx, by) = (np.moveaxis(flat[:, k] - flat[:, 0], -1, 0) for k in (1, 2))
    level = np.abs(ax * by - ay * bx) > 2 * LEAST_AREA
    frame = shapely.box(*bounds)
    places: dict[str, list[int]] = {}
    for owner in np.unique(faces.owner).tolist():
        places.setdefault(faces.names[owner], []).append(owner)
    found = []
    for name, mine in places.items():
        use = np.isin(faces.owner, mine) & level
        own = faces.only(use)
        if own is not None:
            outline = shapely.union_all(shapely.polygons(flat[use]), grid_size=_LATTICE).intersection(frame)
            if outline.area > LEAST_AREA:
                found.append((name, own, outline))
    return found

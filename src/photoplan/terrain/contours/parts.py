"""A terrain cut into parts that contours are traced in: the units of a hybrid model, or pieces of a height grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.surfaces.grid_ranges import HeightGrid
from photoplan.surfaces.units import LineElement, MeshFaces, Unit, UnitSource

Bounds = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax, metres."""


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """A piece of terrain: posts on a grid whose meshes may be oblong, and triangles where a mesh has its own.

    Parts form a chessboard; a neighbour on the right has the next column, one below the next row. On the edge that two
    parts share both must have the same vertices, to 1e-6 m in position and 2e-4 m in height.
    """

    column: int
    row: int
    origin: tuple[float, float]
    """X, Y of the upper-left post, metres."""
    mesh: tuple[float, float]
    """Mesh width in X and in Y, metres, both positive; rows run from north to south."""
    heights: NDArray[np.float64]
    """Posts, shape (rows + 1, columns + 1), metres; a mesh with a NaN corner is empty, unless it has triangles."""
    faces: MeshFaces | None = None
    """Triangles of the meshes that are not bilinear; None: all are."""
    creases: Sequence[NDArray[np.float64]] = ()
    """Breaklines, X, Y of shape (n, 2), whose edges are edges of `faces`: a contour bends sharply there."""

    def __post_init__(self) -> None:
        if self.heights.ndim != 2 or min(self.heights.shape) < 2 or min(self.mesh) <= 0:
            raise InputError(
                f"part {self.column}, {self.row} of a terrain: {self.heights.shape} posts, mesh {self.mesh}; at least "
                "2 × 2 posts and positive mesh widths are needed"
            )

    @property
    def bounds(self) -> Bounds:
        """Its outer posts."""
        rows, columns = (n - 1 for n in self.heights.shape)
        left, top = self.origin
        return left, top - rows * self.mesh[1], left + columns * self.mesh[0], top

    def cropped(self, bounds: Bounds | None) -> SurfacePart | None:
        """The meshes that touch `bounds`; None if there are none."""
        if bounds is None:
            return self
        xmin, ymin, xmax, ymax = bounds
        rows, columns = (n - 1 for n in self.heights.shape)
        col0 = max(0, math.floor((xmin - self.origin[0]) / self.mesh[0]))
        col1 = min(columns, math.ceil((xmax - self.origin[0]) / self.mesh[0]))
        row0 = max(0, math.floor((self.origin[1] - ymax) / self.mesh[1]))
        row1 = min(rows, math.ceil((self.origin[1] - ymin) / self.mesh[1]))
        if col0 >= col1 or row0 >= row1:
            return None
        if (col0, row0, col1, row1) == (0, 0, columns, rows):
            return self
        keep = np.zeros((rows, columns), bool)
        keep[row0:row1, col0:col1] = True
        return replace(
            self,
            origin=(self.origin[0] + col0 * self.mesh[0], self.origin[1] - row0 * self.mesh[1]),
            heights=self.heights[row0 : row1 + 1, col0 : col1 + 1],
            faces=None if self.faces is None else _kept_faces(self.faces, keep.ravel()),
        )


def _kept_faces(faces: MeshFaces, keep: NDArray[np.bool_]) -> MeshFaces:
    """The triangles of some of the meshes."""
    counts = np.diff(faces.start)
    corners = faces.corners[np.repeat(keep, counts)]
    start = np.concatenate([[0], np.cumsum(counts[keep])])
    return MeshFaces(faces.vertices, faces.sigmas, corners, start)


def unit_parts(
    source: UnitSource, bounds: Bounds | None = None, lines: Callable[[Bounds], Sequence[LineElement]] | None = None
) -> Iterator[SurfacePart]:
    """The units of a hybrid model, row by row from the north."""
    layout = source.layout
    for row in range(layout.rows):
        for column in range(layout.columns):
            left, top = layout.corner(column, row)
            around = left, top - layout.side, left + layout.side, top
            if bounds is not None and not _touch(around, bounds):
                continue
            unit = source.unit(column, row)
            if unit is None:
                continue
            part = _unit_part(unit, column, row, lines(around) if lines is not None and unit.faces else ())
            part_in = part.cropped(bounds)
            if part_in is not None:
                yield part_in


def _touch(a: Bounds, b: Bounds) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _unit_part(unit: Unit, column: int, row: int, lines: Sequence[LineElement]) -> SurfacePart:
    return SurfacePart(
        column=column,
        row=row,
        origin=(unit.left, unit.top),
        mesh=(unit.width, unit.width),
        heights=unit.heights.astype(float) + unit.datum,
        faces=unit.faces,
        creases=tuple(line.xyz[:, :2] for line in lines if line.kind == "breakline"),
    )


def grid_parts(
    grid: HeightGrid,
    origin: tuple[float, float],
    mesh: tuple[float, float],
    bounds: Bounds | None = None,
    side: int = 512,
) -> Iterator[SurfacePart]:
    """Pieces of a height grid, row by row from the north."""
    columns, rows = grid.size
    for row in range(-(-(rows - 1) // side)):
        for column in range(-(-(columns - 1) // side)):
            window = Window(column * side, row * side, side + 1, side + 1) & Window(0, 0, columns, rows)
            corner = origin[0] + window.col * mesh[0], origin[1] - window.row * mesh[1]
            around = corner[0], corner[1] - window.height * mesh[1], corner[0] + window.width * mesh[0], corner[1]
            if bounds is not None and not _touch(around, bounds):
                continue
            part = SurfacePart(
                column=column, row=row, origin=corner, mesh=mesh, heights=grid.read(window).astype(float)
            ).cropped(bounds)
            if part is not None:
                yield part

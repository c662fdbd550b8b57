"""Parts of a hybrid terrain model: computing units with a grid of posts each, and triangles where lines pass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.errors import InputError
from photoplan.surfaces.measured import LineKind
from photoplan.surfaces.representation import Representation, representation


@dataclass(frozen=True)
class UnitLayout:
    """The chessboard of computing units (Ecker 1991, §2.1.2): squares of one side, rows from north to south."""

    left: float
    """X of the outer left edge, metres."""
    top: float
    """Y of the outer upper edge, metres."""
    side: float
    """Side of a unit, metres."""
    columns: int
    rows: int

    def __post_init__(self) -> None:
        if not (np.isfinite([self.left, self.top, self.side]).all() and self.side > 0):
            raise InputError(f"units of side {self.side} at {self.left}, {self.top}; finite numbers are needed")
        if self.columns < 1 or self.rows < 1:
            raise InputError(f"{self.columns} × {self.rows} units; there must be at least one")

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outer edges xmin, ymin, xmax, ymax."""
        return (self.left, self.top - self.rows * self.side, self.left + self.columns * self.side, self.top)

    def corner(self, column: int, row: int) -> tuple[float, float]:
        """X, Y of a unit's upper-left corner."""
        return self.left + column * self.side, self.top - row * self.side


@storable
@dataclass(frozen=True, eq=False)
class MeshFaces:
    """Triangles of those meshes that a bilinear patch cannot describe: where lines pass, or finer posts adjoin.

    Inside a mesh the triangles cover just the part where there is a surface; on edges that two meshes share, both have
    the same vertices, so that the surface is continuous except at two-sided breaklines, where the triangles of the two
    sides have different vertices at one place.
    """

    vertices: NDArray[np.float64]
    """X, Y, Z, shape (k, 3), metres."""
    sigmas: NDArray[np.float32]
    """Standard deviation of the vertices' heights, shape (k,), metres."""
    corners: NDArray[np.int32]
    """Vertex numbers of each triangle, counter-clockwise, shape (f, 3), sorted by mesh."""
    start: NDArray[np.int64]
    """Triangles of mesh m = row · n + column are corners[start[m]:start[m + 1]], shape (n² + 1,); a mesh without
    triangles is bilinear."""


@storable
@dataclass(frozen=True, eq=False)
class Unit:
    """One computing unit (Ecker 1991, §2.1.1): posts on a grid of its own width, edges included."""

    left: float
    """X of the first column of posts, metres."""
    top: float
    """Y of the first row of posts, metres."""
    side: float
    """Metres."""
    heights: NDArray[np.float32]
    """Heights of the posts above `datum`, shape (n + 1, n + 1), row 0 in the north, metres; NaN = no surface."""
    sigmas: NDArray[np.float32]
    """Standard deviations of the posts, the same shape, metres; NaN where the height is."""
    datum: float = 0.0
    """Height that the stored heights refer to, metres: keeps float32 exact to micrometres. Faces are absolute."""
    faces: MeshFaces | None = None
    """Triangles of the meshes that are not bilinear; None: all are."""

    @property
    def meshes(self) -> int:
        """Meshes along a side."""
        return self.heights.shape[0] - 1

    @property
    def width(self) -> float:
        """Grid width: side of a mesh, metres."""
        return self.side / self.meshes

    @cached_property
    def representation(self) -> Representation:
        """What the meshes cannot follow between the posts; `sigmas` are those of the posts alone."""
        if self.faces is None:
            return representation(self.heights)
        xy = self.faces.vertices[:, :2] - (self.left, self.top)
        triangled = (np.diff(self.faces.start) > 0).reshape(self.meshes, self.meshes)
        return representation(self.heights, xy * (1 / self.width, -1 / self.width), triangled)


@dataclass(frozen=True)
class UnitFigures:
    """What is known of a computing unit beside its heights: one line of the model's table of units."""

    column: int
    row: int
    meshes: int
    """Meshes along a side."""
    low: float
    """Lowest height, metres; NaN: the unit is empty."""
    high: float
    points: int
    """Mass points and spot heights inside."""
    lines: int
    """Line elements that pass."""
    variance: float
    """Variance of the signal, m²: value of the covariance function at distance 0."""
    length: float
    """Distance at which the covariance function has fallen to half, metres."""
    noise: float
    """Standard deviation of measurement of mass points, metres: their filter value, given or estimated."""
    sigma: float
    """Root mean square of the posts' standard deviations, metres."""
    spread: float
    """Spread of the normalised residuals of the unit's points, 1 if the stochastic model fits; NaN: too few points."""
    gross: int
    """Points flagged as gross errors."""


@storable
@dataclass(frozen=True, eq=False)
class LineElement:
    """A line as the model keeps it: filtered vertices and the intersections with the grid, in order."""

    name: str
    kind: LineKind
    code: str
    xyz: NDArray[np.float64]
    """X, Y, Z, shape (n, 3), metres."""
    right: NDArray[np.float64] | None
    """Heights on the right-hand side, shape (n,), of a two-sided breakline."""
    sigmas: NDArray[np.float64]
    """Standard deviations of the heights, shape (n,), metres; NaN where unknown (borders without heights)."""
    on_grid: NDArray[np.bool_]
    """True where the vertex is an intersection with the grid, shape (n,)."""


class UnitSource(Protocol):
    """Computing units by their indices, from memory or from a file; safe to call from several threads."""

    @property
    def layout(self) -> UnitLayout:
        """Where the units lie."""
        ...

    @property
    def ranges(self) -> NDArray[np.float64]:
        """Lowest and highest height of every unit, shape (rows, columns, 2); NaN for empty units."""
        ...

    @property
    def finest(self) -> float:
        """Smallest grid width, metres."""
        ...

    def unit(self, column: int, row: int) -> Unit | None:
        """The unit, or None if it is empty."""
        ...


@dataclass(frozen=True, eq=False)
class MemoryUnits:
    """A source of computing units (`UnitSource`) that holds all of them in memory."""

    layout: UnitLayout
    units: Mapping[tuple[int, int], Unit]
    """Units by (column, row); those that are missing are empty."""
    ranges: NDArray[np.float64] = field(init=False, repr=False)
    """Lowest and highest height of every unit, shape (rows, columns, 2), metres; NaN for empty units."""

    def __post_init__(self) -> None:
        ranges = np.full((self.layout.rows, self.layout.columns, 2), np.nan)
        for (column, row), unit in self.units.items():
            if not (0 <= column < self.layout.columns and 0 <= row < self.layout.rows):
                raise InputError(
                    f"unit at column {column}, row {row}; the layout has {self.layout.columns} columns and "
                    f"{self.layout.rows} rows, counted from 0"
                )
            ranges[row, column] = unit_range(unit)
        object.__setattr__(self, "ranges", ranges)

    @property
    def finest(self) -> float:
        """Smallest grid width, metres."""
        return min((unit.width for unit in self.units.values()), default=self.layout.side)

    def unit(self, column: int, row: int) -> Unit | None:
        """The unit, or None if it is empty."""
        return self.units.get((column, row))


def unit_range(unit: Unit) -> tuple[float, float]:
    """Lowest and highest height of a unit's posts and triangles, metres; NaN, NaN if it has none."""
    known = [unit.heights[np.isfinite(unit.heights)].astype(float) + unit.datum]
    if unit.faces is not None:
        Z = unit.faces.vertices[:, 2]
        known.append(Z[np.isfinite(Z)])
    heights = np.concatenate(known)
    return (float(heights.min()), float(heights.max())) if heights.size else (np.nan, np.nan)

"""Units of hybrid terrain: measured points and lines, representation errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.errors import InputError

#: Weights by which squares of second differences are averaged along rows and along columns.
_WINDOW = (0.25, 0.5, 0.25)
#: Ratio of the mean squares of second differences at one and at two mesh widths: of smooth ground, of ground whose
#: slopes are Brownian, of steps or Brownian ground, and of ground without any correlation.
_SMOOTH, _KINKED, _STEPS, _ROUGH = 1 / 16, 1 / 4, 1 / 2, 1.0
#: Part of a ratio's logarithm beside smooth ground that is left at half the distance: of waves, and from which part on
#: the ratio is that of a power law.
_WAVE, _LAW = 0.25, 0.79
#: Correlation of the errors along x and along y in the middle of a mesh, on Brownian ground.
_BROWNIAN = -0.44
#: A vertex this close to a grid line, in meshes, lies on it.
_ON_LINE = 1e-5


@dataclass(frozen=True, eq=False)
class Representation:
    """Variance between posts, m², is bx² · x + by² · y + 2 bx by · xy with b = (4 f (1 − f))^(power / 2).

    f is the position between two posts, 0 to 1. At posts the variance is zero. In a triangle the standard deviations of
    its three sides are added, with the products of two weights for f (1 − f) and the lengths of the side along x and y.
    """

    terms: NDArray[np.float32]
    """x, y and xy at each post, shape (3, n + 1, n + 1), m²; between posts they are bilinear."""
    power: float
    """2 for smooth ground, whose error is a parabola between posts; 1 for Brownian ground, whose error is a bridge."""


def representation(
    heights: NDArray[np.float32],
    vertices: NDArray[np.float64] | None = None,
    triangled: NDArray[np.bool_] | None = None,
) -> Representation:
    """Return the representation error of a grid of posts from their second differences.

    The error of linear interpolation in the middle between two posts is half the second difference at half the mesh
    width. Its mean square is extrapolated from those at one and at two mesh widths: by a power law of the distance if
    the ground has kinks at all scales, and towards the law of smooth ground if it has none.
    """
    Z = heights.astype(float)
    across, along = _uncut(vertices, Z.shape[0] - 1)
    if triangled is not None:
        around = np.pad(triangled, 1, constant_values=True)
        free = ~(around[1:, 1:] & around[1:, :-1] & around[:-1, 1:] & around[:-1, :-1])
        across &= free[:, 1:] & free[:, :-1]
        along &= free[1:] & free[:-1]
    x, y = _second(Z, across, 1), _second(Z.T, along.T, 1).T
    wide = np.append(_second(Z, across, 2).ravel(), _second(Z.T, along.T, 2).ravel())
    narrow = np.append(x.ravel(), y.ravel())
    ratio = _SMOOTH
    if np.isfinite(narrow).any() and np.isfinite(wide).any() and np.nanmax(np.abs(wide)) > 0:
        ratio = float(np.clip(np.nanmean(narrow**2) / np.nanmean(wide**2), _SMOOTH, _ROUGH))
        # A wave's ratio falls to that of smooth ground by the fourth part of its logarithm with each halving.
        part = min(1.0, np.log(ratio / _SMOOTH) / np.log(_KINKED / _SMOOTH))
        ratio = _SMOOTH * (ratio / _SMOOTH) ** (0.25 + 0.75 * part)
    power = _power(ratio)
    xx, yy, xy = _around(x**2), _around(y**2), _around(x * y)
    # Where nothing is known of a direction, lines are so close that they carry the surface.
    xx, yy, xy = (np.nan_to_num(values) for values in (xx, yy, xy))
    xy = (power - 1) * xy + (2 - power) * _BROWNIAN * np.sqrt(xx * yy)
    return Representation((np.stack([xx, yy, xy]) * (ratio / 4)).astype(np.float32), power)


def between_data(heights: NDArray[np.float64], step: int) -> tuple[NDArray[np.float64], float]:
    """Return the standard deviation of ground between data that are `step` posts apart, beside smooth ground, at posts.

    Posts between data are interpolated, smoothly in most models; how smooth the ground is, only second differences at
    the spacing of the data and its multiples say. Of a power law their ratio stays, of waves it falls to that of smooth
    ground by the fourth part of its logarithm with each halving of the distance. Also returned is the power, as in
    `Representation`. Zero where data are not further apart than posts.
    """
    Z, none = heights.astype(float), np.zeros(heights.shape)
    if step < 2:
        return none, 2.0
    free = np.ones((Z.shape[0], Z.shape[1] - 1), bool)
    both = [(_second(Z, free, k * step) ** 2, _second(Z.T, free, k * step).T ** 2) for k in (1, 2, 4)]
    means = np.array([np.nanmean(each) if np.isfinite(each).any() else np.nan for each in both])
    if not (means[:2] > 0).all():
        return none, 2.0
    seen, wide = np.log(np.clip(means[:2] / np.where(means[1:] > 0, means[1:], means[:2]), _SMOOTH, _ROUGH) / _SMOOTH)
    wave = _SMOOTH * np.exp(_WAVE * seen)
    ratio = _SMOOTH * np.exp(seen * np.interp(seen / max(wide, 1e-9), (_WAVE, _LAW), (_WAVE, 1.0)))
    # The best interpolation leaves nothing of the error of linear interpolation on waves, all on steps.
    left = np.clip(np.log(ratio / wave) / np.log(max(_STEPS / wave, 1.1)), 0.0, 1.0)
    around = sum(np.nan_to_num(_around(square)) for square in both[0])
    return np.sqrt(ratio * left / 4 * around), _power(ratio)


def _power(ratio: float) -> float:
    """The power by which variance grows between posts."""
    return float(np.clip(-np.log2(ratio), 1.0, 2.0))


def _uncut(vertices: NDArray[np.float64] | None, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which sides of meshes along x, (n + 1, n), and along y, (n, n + 1), have no vertex inside."""
    across, along = np.ones((n + 1, n), bool), np.ones((n, n + 1), bool)
    if vertices is not None and len(vertices):
        x, y = vertices.T
        on_x, on_y = np.abs(x - np.rint(x)) < _ON_LINE, np.abs(y - np.rint(y)) < _ON_LINE
        lower_x, lower_y = (np.clip(np.floor(v), 0, n - 1).astype(int) for v in (x, y))
        nearest_x, nearest_y = (np.clip(np.rint(v), 0, n).astype(int) for v in (x, y))
        some = on_y & ~on_x
        across[nearest_y[some], lower_x[some]] = False
        some = on_x & ~on_y
        along[lower_y[some], nearest_x[some]] = False
    return across, along


def _second(Z: NDArray[np.float64], uncut: NDArray[np.bool_], step: int) -> NDArray[np.float64]:
    """Second differences along rows at a distance of `step` posts; NaN at the ends and where a line crosses."""
    found = np.full(Z.shape, np.nan)
    n = Z.shape[1]
    if n > 2 * step:
        found[:, step:-step] = Z[:, 2 * step :] - 2 * Z[:, step:-step] + Z[:, : -2 * step]
        for shift in range(2 * step):
            found[:, step:-step][~uncut[:, shift : n - 2 * step + shift]] = np.nan
    return found


def _around(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means over a window; where none is known there, over the windows around."""
    mean = _mean(values)
    return np.where(np.isnan(mean), _mean(mean), mean)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means over a window; NaN where no value is known there."""
    known = np.isfinite(values)
    total, count = _weighted_sum(np.where(known, values, 0.0)), _weighted_sum(known.astype(float))
    return np.asarray(np.where(count > 0.01, total / np.maximum(count, 0.01), np.nan))


def _weighted_sum(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum over a window with `_WINDOW` along rows and columns, zeros around."""
    before, here, after = _WINDOW
    padded = np.pad(values, 1)
    rows = before * padded[:-2] + here * padded[1:-1] + after * padded[2:]
    return np.asarray(before * rows[:, :-2] + here * rows[:, 1:-1] + after * rows[:, 2:])


PointKind = Literal["mass", "spot"]
LineKind = Literal["breakline", "formline", "border", "hole"]
POINT_KINDS: tuple[PointKind, ...] = get_args(PointKind)
LINE_KINDS: tuple[LineKind, ...] = get_args(LineKind)


@storable
@dataclass(frozen=True, eq=False)
class PointGroup:
    """Points of one class that were measured in one way."""

    name: str
    """Name of the group for users: the file, or file and code."""
    kind: PointKind
    """Mass points describe the surface; spot heights are chosen points (tops, hollows) measured with more care."""
    xyz: NDArray[np.float64]
    """X, Y, Z, shape (n, 3), metres; finite."""
    records: NDArray[np.int64]
    """Number of the record (line of a text file, else feature or point number from 1) of each point, shape (n,)."""
    sigma: float | None = None
    """Standard deviation of the heights, metres (the filter value); None: that of its class."""
    names: NDArray[Any] | None = None
    """Names of the points as the file gives them, shape (n,), strings; None: they have none."""

    def __post_init__(self) -> None:
        _check_points(self.xyz, self.name)
        if self.kind not in POINT_KINDS:
            raise InputError(f"{self.name}: points of kind {self.kind!r}; kinds are {', '.join(POINT_KINDS)}")
        if len(self.records) != len(self.xyz) or (self.names is not None and len(self.names) != len(self.xyz)):
            raise InputError(f"{self.name}: {len(self.xyz)} points, but {len(self.records)} record numbers or names")
        _check_sigma(self.sigma, self.name)

    def label(self, index: int) -> str:
        """Return how a point is named in messages and lists."""
        own = f" {self.names[index]}" if self.names is not None else ""
        return f"{self.name}{own} (record {self.records[index]})"


@storable
@dataclass(frozen=True, eq=False)
class MeasuredLine:
    """One line: its vertices in order."""

    name: str
    """Name of the line for users: file and record, and its own name or code."""
    kind: LineKind
    """Breakline (slope jumps, or with `right` the height), form line (bends smoothly), border or hole (closed)."""
    xyz: NDArray[np.float64]
    """X, Y, Z, shape (n, 3), metres; at a two-sided breakline the height left of the line in its direction.
    Z may be NaN in borders and holes, which then only bound the model."""
    right: NDArray[np.float64] | None = None
    """Heights right of the line, shape (n,), metres: a wall. None: both sides share the height."""
    sigma: float | None = None
    """Standard deviation of the heights, metres (the filter value); None: that of its class."""
    code: str = ""
    """Code of the file, such as the survey code of a ditch's edge; empty if there is none."""

    def __post_init__(self) -> None:
        if self.kind not in LINE_KINDS:
            raise InputError(f"{self.name}: line of kind {self.kind!r}; kinds are {', '.join(LINE_KINDS)}")
        _check_points(self.xyz, self.name, heights=self.kind in ("breakline", "formline"))
        if len(self.xyz) < 2:
            raise InputError(f"{self.name}: a line of {len(self.xyz)} points; at least two are needed")
        if self.right is not None and (
            self.kind != "breakline" or self.right.shape != (len(self.xyz),) or not np.isfinite(self.right).all()
        ):
            raise InputError(f"{self.name}: right-hand heights belong to breaklines, one finite height for each vertex")
        _check_sigma(self.sigma, self.name)


@storable
@dataclass(frozen=True, eq=False)
class Tin:
    """Triangles that a file brings along; kept for comparison, never used as measurements."""

    xyz: NDArray[np.float64]
    """Vertices, shape (n, 3), metres."""
    faces: NDArray[np.int64]
    """Vertex numbers of each triangle, shape (m, 3)."""


@storable
@dataclass(frozen=True, eq=False)
class MeasuredTerrain:
    """All that was measured of one terrain, in one projected CRS and one height system."""

    points: tuple[PointGroup, ...] = ()
    lines: tuple[MeasuredLine, ...] = ()
    crs: str | None = None
    """CRS as pyproj reads it; None: the files do not say."""
    height_system: str | None = None
    """Vertical CRS or its name as the file gives it; None: the files do not say."""
    tin: Tin | None = None
    """The file's own triangulation, if it has one."""
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = field(default=())
    """Notes on what was repaired or left out while reading, one line each."""
    codes: frozenset[str] = frozenset()
    """All codes and names of layers that the files hold."""
    unit: float | None = None
    """Metres in the unit of X, Y and, without `height_unit`, Z that the file states apart from its CRS; None: none."""
    height_unit: float | None = None
    """Metres in the unit of Z that the file states apart from its height system; None: none."""
    fields: tuple[str, ...] = ()
    """Names of the columns, attributes or layers of the files, file by file, for messages."""

    @property
    def count(self) -> int:
        """Number of points, vertices of lines not included."""
        return sum(len(group.xyz) for group in self.points)


def _check_points(xyz: NDArray[np.float64], name: str, heights: bool = True) -> None:
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError(f"{name}: points of shape {xyz.shape}; X, Y, Z in three columns are needed")
    if not np.isfinite(xyz if heights else xyz[:, :2]).all():
        raise InputError(f"{name}: a coordinate is not finite")


def _check_sigma(sigma: float | None, name: str) -> None:
    if sigma is not None and not (np.isfinite(sigma) and sigma >= 0):
        raise InputError(f"{name}: filter value {sigma}; a standard deviation in metres, zero or more, is needed")


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
        """Return what the meshes cannot follow between the posts; `sigmas` are those of the posts alone."""
        if self.faces is None:
            return representation(self.heights)
        xy = self.faces.vertices[:, :2] - (self.left, self.top)
        triangled = (np.diff(self.faces.start) > 0).reshape(self.meshes, self.meshes)
        return representation(self.heights, xy * (1 / self.width, -1 / self.width), triangled)


@dataclass(frozen=True)
class UnitFigures:
    """Figures of a computing unit: one row of the model's table of units."""

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
        """Return where the units lie."""
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

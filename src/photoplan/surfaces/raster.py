"""Surfaces from rasters of heights."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import nearest_turn
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.rays import ShownGround
from photoplan.kernels.terrain import height_ranges, sample_lattice, sample_points
from photoplan.surfaces.base import (
    Cache,
    Hits,
    Lattice,
    TerrainPart,
    box_points,
    carried_hits,
    carried_positions,
    follow_fan,
)
from photoplan.targets.map import MapTarget, Target

#: Cells whose ranges are kept (8 bytes each): single posts in small grids, squares of 2, 4, 8 … posts in larger ones.
MOST_CELLS = 2_000_000


class HeightGrid(Protocol):
    """Posts of a terrain grid, read by windows; safe to call from several threads."""

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        ...

    def read(self, window: Window) -> NDArray[np.float32]:
        """Heights of a window inside the grid, shape (height, width), metres; NaN where there is none."""
        ...


class RangeStore(Protocol):
    """Ranges of heights of a grid that earlier runs kept."""

    def load(self, layout: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Numbers of parts (n,), row by row, and the lowest and highest heights of their cells (n, 2, rows,
        columns).
        """
        ...

    def keep(self, layout: tuple[int, ...], part: int, cells: NDArray[np.float32]) -> None:
        """Keep what was found of a part, shape (2, rows, columns), NaN beyond the grid."""
        ...


@dataclass(frozen=True, eq=False)
class GridRanges:
    """Ranges of the cells of a grid: read once, part by part, when a window first touches them.

    Bounds are those of the posts themselves. Overviews of a file are no bounds: an average hides a summit, and a
    nearest neighbour leaves it out. Two threads that want one part at once both read it and write the same numbers.
    """

    grid: HeightGrid
    part: tuple[int, int]
    """Columns and rows that are read at once: the file's blocks."""
    store: RangeStore | None = None
    """Ranges that earlier runs found, and their file."""
    _side: int = field(init=False, repr=False)
    _low: NDArray[np.float32] = field(init=False, repr=False)
    _high: NDArray[np.float32] = field(init=False, repr=False)
    _known: NDArray[np.bool_] = field(init=False, repr=False)
    _tables: dict[int, NDArray[np.float64]] = field(init=False, repr=False, default_factory=dict)
    _recalled: list[bool] = field(init=False, repr=False, default_factory=list)

    def __post_init__(self) -> None:
        columns, rows = self.grid.size
        side = 1
        while -(-columns // side) * -(-rows // side) > MOST_CELLS:
            side *= 2
        # Parts are made of whole cells.
        width, height = (max(1, -(-extent // side)) * side for extent in self.part)
        cells = (-(-rows // side), -(-columns // side))
        for name, value in (
            ("_side", side),
            ("part", (width, height)),
            ("_low", np.full(cells, np.nan, np.float32)),
            ("_high", np.full(cells, np.nan, np.float32)),
            ("_known", np.zeros((-(-rows // height), -(-columns // width)), bool)),
        ):
            object.__setattr__(self, name, value)

    def of(self, windows: NDArray[np.int64], learn: bool = True) -> NDArray[np.float64]:
        """Bounds of the posts in windows: first column, first row, end column, end row (n, 4), shape (n, 2).

        A window is widened to whole cells. NaN, NaN for empty windows and where there is no height; with `learn` False
        nothing is read, and windows that touch unknown parts have infinite bounds.
        """
        out = np.full((len(windows), 2), np.nan)
        ask = np.flatnonzero((windows[:, 2] > windows[:, 0]) & (windows[:, 3] > windows[:, 1]))
        if not len(ask):
            return out
        if self.store is not None and not self._recalled:
            self._recall(self.store)
        if learn:
            self._learn(windows[ask])
        else:
            unknown = np.pad(~self._known, ((1, 0), (1, 0))).astype(np.int64).cumsum(axis=0).cumsum(axis=1)
            (c0, r0), (c1, r1) = (windows[ask, :2] // self.part).T, (-(-windows[ask, 2:] // self.part)).T
            count = unknown[r1, c1] - unknown[r0, c1] - unknown[r1, c0] + unknown[r0, c0]
            out[ask[count > 0]], ask = (-np.inf, np.inf), ask[count == 0]
        asked = windows[ask]
        cells = np.concatenate([asked[:, :2] // self._side, -(-asked[:, 2:] // self._side)], axis=1).astype(np.int32)
        found = np.stack([height_ranges(self._low, cells)[:, 0], height_ranges(self._high, cells)[:, 1]], axis=1)
        out[ask] = np.where(np.isinf(found), np.nan, found)
        return out

    def table(self, side: int, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return what was found out of squares of so many posts, rows × columns of them: −inf, inf: nothing yet."""
        if side not in self._tables:
            self._tables[side] = np.full((*shape, 2), np.inf) * (-1.0, 1.0)
        return self._tables[side]

    def _learn(self, windows: NDArray[np.int64]) -> None:
        """Read all parts that some windows touch and that are not known yet."""
        first = windows[:, :2] // self.part
        last = (windows[:, 2:] - 1) // self.part
        # How many windows touch each part, from the corners of the rectangles.
        count = np.zeros((self._known.shape[0] + 1, self._known.shape[1] + 1), np.int64)
        for rows, columns, sign in (
            (first[:, 1], first[:, 0], 1),
            (first[:, 1], last[:, 0] + 1, -1),
            (last[:, 1] + 1, first[:, 0], -1),
            (last[:, 1] + 1, last[:, 0] + 1, 1),
        ):
            np.add.at(count, (rows, columns), sign)
        touched = count.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
        for row, column in zip(*np.nonzero(touched & ~self._known)):
            self._read(int(column), int(row))
            self._known[row, column] = True

    def _read(self, column: int, row: int) -> None:
        width, height = self.part
        area = Window(column * width, row * height, width, height) & Window(0, 0, *self.grid.size)
        side = self._side
        cells = Window(area.col // side, area.row // side, -(-area.width // side), -(-area.height // side))
        row0, col0 = np.mgrid[0 : cells.height, 0 : cells.width].reshape(2, -1) * side
        right, bottom = np.minimum(col0 + side, area.width), np.minimum(row0 + side, area.height)
        found = height_ranges(self.grid.read(area), np.stack([col0, row0, right, bottom], axis=1).astype(np.int32))
        found[np.isinf(found)] = np.nan
        here = np.s_[cells.row : cells.row + cells.height, cells.col : cells.col + cells.width]
        self._low[here], self._high[here] = found.T.reshape(2, cells.height, cells.width)
        if self.store is not None:
            whole = np.full((2, height // side, width // side), np.nan, np.float32)
            whole[:, : cells.height, : cells.width] = found.T.reshape(2, cells.height, cells.width)
            self.store.keep(self._layout, row * self._known.shape[1] + column, whole)

    @property
    def _layout(self) -> tuple[int, ...]:
        """Return what decides the cells, for the store."""
        width, height = self.part
        return (*self.grid.size, self._side, width, height, height // self._side, width // self._side)

    def _recall(self, store: RangeStore) -> None:
        """Take over what earlier runs found."""
        numbers, cells = store.load(self._layout)
        rows, columns = cells.shape[2:]
        for number, (low, high) in zip(numbers.tolist(), cells):
            row, column = divmod(number, self._known.shape[1])
            if row < self._known.shape[0]:
                for whole, part in ((self._low, low), (self._high, high)):
                    here = whole[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
                    here[:] = part[: here.shape[0], : here.shape[1]]
                self._known[row, column] = True
        self._recalled.append(True)


#: Between CRSs, positions are interpolated where that is good to this part of a mesh; else each pixel is transformed.
POSITION_TOLERANCE = 0.01
#: Posts that are read at once where single heights are asked for.
MOST_POSTS = 4_000_000


#: Rays that are few, and the meshes along a side of the parts that they are followed over; many rays share larger ones.
FEW, FEW_PART, MANY_PART = 2000, 32, 512


@dataclass(frozen=True)
class RasterSurface:
    """A height grid placed in a CRS. Between four posts the height is bilinear (Behr 1989, eq. 5.10).

    Up to half a mesh beyond the outer posts the edge is continued, since a height raster's cells have an area;
    further out, and in every mesh that touches a missing post, there is no surface.
    """

    grid: HeightGrid
    origin: tuple[float, float]
    """X, Y of the upper-left post, metres."""
    mesh: tuple[float, float]
    """Mesh width in X and in Y, metres, both positive; rows run from north to south."""
    to_grid_crs: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes X, Y of the product's CRS (..., 2) to the grid's CRS; None if they are the same."""
    part: tuple[int, int] = (256, 256)
    """Columns and rows that are best read at once: the blocks of a file."""
    store: RangeStore | None = field(default=None, repr=False, compare=False)
    """Keeps ranges of heights for later runs."""
    turn: float | None = None
    """Length in X of one turn about the earth, for grids in longitudes and in maps on a cylinder; None: others."""
    _ranges: GridRanges = field(init=False, repr=False, compare=False)
    _kept: dict[int, Cache] = field(init=False, repr=False, compare=False, default_factory=dict)
    """Parts that rays were followed over last, by their side."""

    def __post_init__(self) -> None:
        if not (self.mesh[0] > 0 and self.mesh[1] > 0):
            raise InputError(f"terrain grid with mesh {self.mesh}; mesh widths must be positive (a north-up grid)")
        if self.turn is not None and self.grid.size[0] >= round(self.turn / self.mesh[0]) and not self._is_round:
            columns = round(self.turn / self.mesh[0])
            if abs(columns * self.mesh[0] - self.turn) < self.mesh[0] / 10:
                object.__setattr__(self, "grid", _Round(self.grid, columns))
                object.__setattr__(self, "origin", (self.origin[0] - columns // 2 * self.mesh[0], self.origin[1]))
                object.__setattr__(self, "store", None)
        object.__setattr__(self, "_ranges", GridRanges(self.grid, self.part, self.store))

    @property
    def _is_round(self) -> bool:
        return isinstance(self.grid, _Round)

    @property
    def middle(self) -> float:
        """X in the middle of the grid."""
        return self.origin[0] + (self.grid.size[0] - 1) / 2 * self.mesh[0]

    def continued(self) -> RasterSurface:
        """The same terrain, going on with its slope instead of level for a mesh beyond its outer posts."""
        (x, y), (u, v) = self.origin, self.mesh
        return replace(self, grid=_Continued(self.grid), origin=(x - 2 * u, y + 2 * v), turn=None)

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixel centres of a window of a map target, shape (height, width); NaN: no surface."""
        if not isinstance(target, MapTarget):
            raise UsageError(f"a raster surface gives relief for map targets, not for {type(target).__name__}")
        if self.to_grid_crs is not None:
            return self._relief_across(target, window)
        first = self._posts(target.grid.to_map((window.col, window.row)))
        step_x = target.grid.resolution / self.mesh[0]
        step_y = target.grid.resolution / self.mesh[1]
        last = first + np.array([(window.width - 1) * step_x, (window.height - 1) * step_y])
        part, offset = self._read(first, last)
        if part is None:
            return np.full((window.height, window.width), np.nan, np.float32)
        x0, y0 = first - offset
        return sample_lattice(part, x0, step_x, window.width, y0, step_y, window.height)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...); NaN where there is no surface."""
        XY = np.asarray(XY, float)
        return self._heights(self._posts(XY if self.to_grid_crs is None else self.to_grid_crs(XY)))

    def _heights(self, posts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heights at post coordinates (..., 2), which may be NaN."""
        flat = posts.reshape(-1, 2)
        there = np.isfinite(flat).all(axis=1)
        if not there.any():
            return np.full(posts.shape[:-1], np.nan)
        heights = np.full(len(flat), np.nan)
        heights[there] = self._sample(flat[there])
        return heights.reshape(posts.shape[:-1])

    def _sample(self, posts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heights at finite post coordinates (n, 2), in halves where they span too much of the grid to read at once."""
        low, high = posts.min(axis=0), posts.max(axis=0)
        window = self._window(low, high)
        if window.size == 0:
            return np.full(len(posts), np.nan)
        if window.size > MOST_POSTS and len(posts) > 1:
            order = np.argsort(posts[:, np.argmax(high - low)], kind="stable")
            heights = np.empty(len(posts))
            for half in np.array_split(order, 2):
                heights[half] = self._sample(posts[half])
            return heights
        offset = np.array([window.col, window.row], float)
        return sample_points(self.grid.read(window), posts - offset).astype(float)

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of the posts inside or next to map bounds (..., 4), shape (..., 2); NaN, NaN where there is none.

        Posts of up to a cell of `GridRanges` beyond the bounds count as well; each is read once.
        """
        boxes = np.asarray(bounds, float)
        posts = self._posts(box_points(boxes.reshape(-1, 4), self.to_grid_crs))
        low, high = np.fmin.reduce(posts, axis=1), np.fmax.reduce(posts, axis=1)
        # Rounding may have moved a position over a post.
        low, high = np.floor(low - 1e-6), np.floor(high + 1e-6) + 2
        there = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
        windows = np.concatenate([np.where(there[:, None], low, 0), np.where(there[:, None], high, 0)], axis=1)
        windows = np.clip(windows, 0, np.tile(self.grid.size, 2)).astype(np.int64)
        return self._ranges.of(windows).reshape(*boxes.shape[:-1], 2)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """The posts; if they are those of another CRS, the map lies on them as it does in the middle of the window."""
        half = max(window.width, window.height, 2) / 2
        middle = np.array((window.col, window.row)) + (np.array((window.width, window.height)) - 1) / 2
        cross = middle + half * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        XY = grid.to_map(cross)
        center, right, left, down, up = self._posts(XY if self.to_grid_crs is None else self.to_grid_crs(XY))
        steps = np.stack([right - left, down - up], axis=1) / (2 * half)
        if not (np.isfinite(steps).all() and np.linalg.det(steps)):
            return Lattice.of_relief(self, grid)
        # Rounded, so that pixels that are posts lie on them.
        steps = np.round(steps, 12)
        return Lattice(np.round(center - steps @ middle, 6), steps, self._part)

    def _part(self, window: Window) -> NDArray[np.float32]:
        """Posts of any window; NaN beyond the grid."""
        posts = np.full((window.height, window.width), np.nan, np.float32)
        inside = window & Window(0, 0, *self.grid.size)
        if inside.size:
            posts[inside.slices(window)] = self.grid.read(inside)
        return posts

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return where rays first come down onto the surface; see `Terrain.first_hit`."""
        paths = np.asarray(paths, float)
        parts, cache = self._parts(FEW_PART if len(paths) < FEW else MANY_PART)
        return carried_hits(parts, paths, self.to_grid_crs, bend, cache)

    def fan_hit(
        self,
        center: NDArray[np.float64],
        ends: NDArray[np.float64],
        rise: tuple[NDArray[np.float64], NDArray[np.float64]],
        rows: tuple[int, int],
        bend: float,
    ) -> ShownGround | None:
        """Return what the rays of a rendering whose columns are vertical planes meet. None if the grid lies in
        another CRS."""
        if self.to_grid_crs is not None:
            return None
        parts, cache = self._parts(MANY_PART)
        return follow_fan(parts, center, ends, rise, rows, bend, cache)

    def _parts(self, most: int) -> tuple[RasterParts, Cache]:
        """Parts of at most so many meshes along a side, and those that were used last."""
        # No more posts at once than the file's blocks have.
        side = max(16, min(most, *self.part))
        return RasterParts(self, side), self._kept.setdefault(side, OrderedDict())

    def _posts(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map coordinates to (column, row) of the posts; what lies beside the grid may lie in it a turn further."""
        column, row = (XY[..., 0] - self.origin[0]) / self.mesh[0], (self.origin[1] - XY[..., 1]) / self.mesh[1]
        if self.turn is not None:
            last = self.grid.size[0] - 0.5
            beside = (column < -0.5) | (column > last)
            column = np.where(beside, nearest_turn(column, (last - 0.5) / 2, self.turn / self.mesh[0]), column)
        return np.stack([column, row], axis=-1)

    def _window(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> Window:
        """Posts that surround positions from `low` to `high`; empty if there are none."""
        columns, rows = self.grid.size
        # A post more on each side: a position that rounding has moved over a post must still find its mesh.
        col0, row0 = (max(0, int(np.clip(np.floor(a), -1, s)) - 1) for a, s in zip(low, (columns, rows)))
        col1, row1 = (min(s, int(np.clip(np.floor(a), -3, s)) + 3) for a, s in zip(high, (columns, rows)))
        return Window(col0, row0, max(0, col1 - col0), max(0, row1 - row0))

    def _read(
        self, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32] | None, NDArray[np.float64]]:
        """Posts that surround positions from `low` to `high`, and the position of the first; None if there are none."""
        window = self._window(low, high)
        if window.size == 0:
            return None, np.zeros(2)
        return self.grid.read(window), np.array([window.col, window.row], float)

    def _relief_across(self, target: MapTarget, window: Window) -> NDArray[np.float32]:
        carry = self.to_grid_crs
        assert carry is not None
        posts = carried_positions(target.grid, window, lambda XY: self._posts(carry(XY)), POSITION_TOLERANCE)
        if posts is None:
            v, u = np.mgrid[: window.height, : window.width]
            uv = np.stack([u + window.col, v + window.row], axis=-1).astype(float)
            return self.heights(target.grid.to_map(uv)).astype(np.float32)
        part, offset = self._read(posts.min(axis=(0, 1)), posts.max(axis=(0, 1)))
        if part is None:
            return np.full((window.height, window.width), np.nan, np.float32)
        flat = sample_points(part, (posts - offset).reshape(-1, 2))
        return flat.reshape(window.height, window.width)


@dataclass(frozen=True, eq=False)
class _Round:
    """A grid that goes round the earth, with half a turn more on each side: no place has a border beside it."""

    grid: HeightGrid
    turn: int
    """Columns of a turn; the grid has as many or a few more, which repeat the first."""

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.turn // 2 + self.turn + self.turn // 2, self.grid.size[1]

    def read(self, window: Window) -> NDArray[np.float32]:
        """Heights of a window inside, shape (height, width); NaN where there is none."""
        parts: list[NDArray[np.float32]] = []
        column = window.col - self.turn // 2
        stop = column + window.width
        while column < stop or not parts:
            first = column % self.turn
            width = min(self.turn - first, stop - column)
            parts.append(self.grid.read(Window(first, window.row, width, window.height)))
            column += width
        return np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]


@dataclass(frozen=True, eq=False)
class _Continued:
    """A grid with two more posts on each side: the first continues the slope between the outer two, the next is NaN."""

    grid: HeightGrid

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        columns, rows = self.grid.size
        return columns + 4, rows + 4

    def read(self, window: Window) -> NDArray[np.float32]:
        """Heights of a window inside, shape (height, width); NaN where there is none."""
        at = [np.arange(n) + first - 2 for first, n in ((window.col, window.width), (window.row, window.height))]
        near = [np.clip(x, 0, count - 1) for x, count in zip(at, self.grid.size)]
        inner = [np.clip(n - np.sign(x - n), 0, count - 1) for x, n, count in zip(at, near, self.grid.size)]
        (col, row), stop = ([int(f(np.concatenate(p))) for p in zip(near, inner)] for f in (np.min, np.max))
        part = self.grid.read(Window(col, row, stop[0] - col + 1, stop[1] - row + 1))
        for axis, first in ((1, col), (0, row)):
            x, n, i = at[1 - axis], near[1 - axis], inner[1 - axis]
            edge, inside = (part.take(k - first, axis) for k in (n, i))
            part = edge + (edge - inside)
            void: list[slice | NDArray[np.bool_]] = [slice(None), slice(None)]
            void[axis] = np.abs(x - n) > 1
            part[tuple(void)] = np.nan
        return part


@dataclass(frozen=True, eq=False)
class RasterParts:
    """A raster in parts for rays. Posts are counted from −1: half a mesh of the first and last one is surface."""

    surface: RasterSurface
    side: int
    """Meshes along a side of a part."""

    @property
    def corner(self) -> tuple[float, float]:
        """X, Y of the post before the first."""
        s = self.surface
        return s.origin[0] - s.mesh[0], s.origin[1] + s.mesh[1]

    @property
    def step(self) -> tuple[float, float]:
        """Width and height of a part, metres."""
        return self.surface.mesh[0] * self.side, self.surface.mesh[1] * self.side

    @property
    def inside(self) -> tuple[float, float, float, float]:
        """Bounds of the surface: half a mesh beyond the outer posts."""
        s = self.surface
        (x, y), (u, v), (columns, rows) = s.origin, s.mesh, s.grid.size
        return x - u / 2, y - (rows - 0.5) * v, x + (columns - 0.5) * u, y + v / 2

    def ranges(self, window: Window) -> NDArray[np.float64]:
        """Bounds of parts, as far as they are known; shape (height, width, 2)."""
        columns, rows = self.surface.grid.size
        table = self.surface._ranges.table(self.side, (rows // self.side + 1, columns // self.side + 1))
        here = table[window.row : window.stop[1], window.col : window.stop[0]]
        unknown = np.isinf(here[..., 0])
        row, column = np.nonzero(unknown)
        here[unknown] = self._ranges(column + window.col, row + window.row, learn=False)
        return here

    def range(self, column: int, row: int) -> NDArray[np.float64]:
        """Bounds of a part; what is read for them is read once."""
        return np.asarray(self._ranges(np.array([column]), np.array([row]), learn=True)[0])

    def _ranges(self, columns: NDArray[np.int64], rows: NDArray[np.int64], learn: bool) -> NDArray[np.float64]:
        col, row = columns * self.side, rows * self.side
        posts = np.stack([col - 1, row - 1, col + self.side, row + self.side], axis=1)
        return self.surface._ranges.of(np.clip(posts, 0, np.tile(self.surface.grid.size, 2)), learn)

    def part(self, column: int, row: int) -> TerrainPart | None:
        """A part; None if it has no ground."""
        s, side = self.surface, self.side
        (columns, rows), col, top = s.grid.size, column * side - 1, row * side - 1
        left, right = max(col, 0), min(col + side + 1, columns)
        upper, lower = max(top, 0), min(top + side + 1, rows)
        posts = s.grid.read(Window(left, upper, right - left, lower - upper))
        if not np.isfinite(posts).any():
            return None
        # The outer half mesh goes on as the posts end.
        beyond = lower == rows and top + side + 1 > rows, right == columns and col + side + 1 > columns
        if any(beyond) or col < 0 or top < 0:
            posts = np.pad(posts, ((upper - top, int(beyond[0])), (left - col, int(beyond[1]))), mode="edge")
        corner = s.origin[0] + col * s.mesh[0], s.origin[1] - top * s.mesh[1]
        return TerrainPart(corner, s.mesh, posts)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Heights at points of the grid's CRS."""
        return self.surface._heights(self.surface._posts(np.asarray(XY, float)))

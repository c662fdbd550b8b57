"""Ranges of heights of the cells of a grid: what rays and boxes ask before they ask for posts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.kernels.extent import height_ranges

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
    """What earlier runs found out of a grid."""

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
    """What earlier runs found, and where it is kept."""
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
        """What was found out of squares of so many posts, rows × columns of them: −inf, inf: nothing yet."""
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
        """What decides the cells, for the store."""
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

"""Lowest and highest posts of a grid that may be larger than memory, learned where somebody asks."""

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


@dataclass(frozen=True, eq=False)
class GridRanges:
    """Ranges of the cells of a grid: read once, part by part, when a window first touches them.

    Bounds are those of the posts themselves. Overviews of a file are no bounds: an average hides a summit, and a
    nearest neighbour leaves it out. Two threads that want one part at once both read it and write the same numbers.
    """

    grid: HeightGrid
    part: tuple[int, int]
    """Columns and rows that are read at once: the file's blocks."""
    _side: int = field(init=False, repr=False)
    _low: NDArray[np.float32] = field(init=False, repr=False)
    _high: NDArray[np.float32] = field(init=False, repr=False)
    _known: NDArray[np.bool_] = field(init=False, repr=False)

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
        some = (windows[:, 2] > windows[:, 0]) & (windows[:, 3] > windows[:, 1])
        if not some.any():
            return out
        asked = windows[some]
        if learn:
            self._learn(asked)
        cells = np.concatenate([asked[:, :2] // self._side, -(-asked[:, 2:] // self._side)], axis=1).astype(np.int32)
        out[some, 0] = height_ranges(self._low, cells)[:, 0]
        out[some, 1] = height_ranges(self._high, cells)[:, 1]
        out[np.isinf(out)] = np.nan
        if not learn:
            unknown = np.pad(~self._known, ((1, 0), (1, 0))).astype(np.int64).cumsum(axis=0).cumsum(axis=1)
            (c0, r0), (c1, r1) = (asked[:, :2] // self.part).T, (-(-asked[:, 2:] // self.part)).T
            count = unknown[r1, c1] - unknown[r0, c1] - unknown[r1, c0] + unknown[r0, c0]
            out[np.flatnonzero(some)[count > 0]] = -np.inf, np.inf
        return out

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

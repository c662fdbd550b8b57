"""The tiles of a product: a few bytes each, however many there are."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window


@dataclass(frozen=True, order=True, slots=True)
class Tile:
    """A part of a product that is one task."""

    index: int
    """Its place among all tiles of the product, row by row: also the empty ones are counted."""
    window: Window
    """Its pixels in the product."""
    sources: tuple[int, ...] = (0,)
    """Rows of the table of sources that can paint here; all others are never looked at."""

    @property
    def pixels(self) -> int:
        """Pixels of the tile."""
        return self.window.size


@dataclass(frozen=True, eq=False)
class Shares:
    """Which sources can paint which tile."""

    ends: NDArray[np.int64]
    """Where the rows of each tile end, shape (n,)."""
    rows: NDArray[np.uint16]
    """Rows of the table of sources, tile by tile."""

    def __getitem__(self, place: int) -> tuple[int, ...]:
        start = self.ends[place - 1] if place else 0
        return tuple(self.rows[start : self.ends[place]].tolist())

    def only(self, places: NDArray[np.int64]) -> Shares:
        """Those of some tiles, by their places."""
        counts = np.diff(self.ends, prepend=0)[places]
        ends = np.cumsum(counts)
        at = np.arange(int(counts.sum())) + np.repeat(self.ends[places] - ends, counts)
        return Shares(ends, self.rows[at])


@dataclass(frozen=True, eq=False)
class Tiles(Sequence[Tile]):
    """Tiles that can hold a part of a source; all others of the product stay empty. A `Tile` is made when one is asked
    for."""

    window: Window
    """All pixels of the product, cut row by row; the last tiles of a row and of a column are smaller."""
    side: int
    """Side of a tile, pixels."""
    indices: NDArray[np.uint32]
    """`Tile.index` of each, increasing."""
    sources: tuple[int, ...] | Shares = (0,)
    """Rows of the table of sources that can paint them: the same for all tiles, or tile by tile."""

    @classmethod
    def every(cls, window: Window, side: int, sources: int = 1) -> Tiles:
        """All tiles of a product, which every one of its sources can paint."""
        none = cls(window, side, np.empty(0, np.uint32), tuple(range(sources)))
        return none.only(range(none.total))

    @classmethod
    def shared(cls, sources: Sequence[Tiles]) -> Tiles:
        """Tiles of a product that at least one of its sources can paint, from those of each source alone."""
        if len(sources) > np.iinfo(np.uint16).max - 1:
            raise UsageError(f"{len(sources):,} images in one product; at most {np.iinfo(np.uint16).max - 1:,} can be")
        index = np.concatenate([tiles.indices for tiles in sources])
        rows = np.repeat(np.arange(len(sources), dtype=np.uint16), [len(tiles) for tiles in sources])
        order = np.argsort(index, kind="stable")
        indices, first = np.unique(index[order], return_index=True)
        ends = np.append(first[1:], len(index)).astype(np.int64)[: len(indices)]
        return replace(sources[0], indices=indices, sources=Shares(ends, rows[order]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of all tiles, the empty ones included."""
        return -(-self.window.height // self.side), -(-self.window.width // self.side)

    @property
    def total(self) -> int:
        """Number of all tiles, the empty ones included."""
        return self.shape[0] * self.shape[1]

    def only(self, indices: Iterable[int]) -> Tiles:
        """Those tiles of the product that have these indices, increasing; where sources are told tile by tile, tiles
        that are not among these are left out."""
        wanted = np.fromiter(indices, np.uint32)
        if not isinstance(self.sources, Shares):
            return replace(self, indices=wanted)
        places = np.flatnonzero(np.isin(self.indices, wanted))
        return replace(self, indices=self.indices[places], sources=self.sources.only(places))

    def with_neighbours(self) -> Tiles:
        """The same tiles, each with the sources of the eight around it, too."""
        if not isinstance(self.sources, Shares):
            return self
        rows, cols = self.shape
        counts = np.diff(self.sources.ends, prepend=0)
        row, col = np.divmod(np.repeat(self.indices.astype(np.int64), counts), cols)
        found = []
        for down, right in itertools.product((-1, 0, 1), repeat=2):
            inside = (row + down >= 0) & (row + down < rows) & (col + right >= 0) & (col + right < cols)
            at = (row + down) * cols + col + right
            found.append(np.stack([at, self.sources.rows.astype(np.int64)])[:, inside & np.isin(at, self.indices)])
        tile, source = np.unique(np.concatenate(found, axis=1), axis=1)
        ends = np.searchsorted(tile, self.indices.astype(np.int64), side="right")
        return replace(self, sources=Shares(ends, source.astype(np.uint16)))

    def inner(self) -> Tiles:
        """Tiles without those at the border, for a product that is smaller by a tile on each side."""
        rows, cols = self.shape
        row, col = np.divmod(self.indices.astype(np.int64), cols)
        kept = self.only(self.indices[(row > 0) & (row < rows - 1) & (col > 0) & (col < cols - 1)].tolist())
        row, col = np.divmod(kept.indices.astype(np.int64), cols)
        whole = self.window
        window = Window(whole.col, whole.row, whole.width - 2 * self.side, whole.height - 2 * self.side)
        return replace(kept, window=window, indices=((row - 1) * (cols - 2) + col - 1).astype(np.uint32))

    def touching(self, window: Window) -> Tiles:
        """Tiles of the product that hold pixels of a window, whichever are listed."""
        col, row = (
            max(0, at - first) // self.side
            for at, first in zip((window.col, window.row), (self.window.col, self.window.row))
        )
        ends = (-(-(stop - first) // self.side) for stop, first in zip(window.stop, (self.window.col, self.window.row)))
        right, bottom = (min(end, most) for end, most in zip(ends, reversed(self.shape)))
        rows, cols = np.arange(row, max(bottom, row)), np.arange(col, max(right, col))
        return self.only((rows[:, None] * self.shape[1] + cols).ravel().tolist())

    @property
    def windows(self) -> NDArray[np.int64]:
        """Column, row, width and height of each, shape (n, 4)."""
        row, col = np.divmod(self.indices.astype(np.int64), self.shape[1])
        corner = self.side * np.stack([col, row], axis=1)
        size = np.minimum(self.side, (self.window.width, self.window.height) - corner)
        return np.concatenate([np.add(corner, (self.window.col, self.window.row)), size], axis=1)

    def bounds(self, grid: MapGrid) -> NDArray[np.float64]:
        """Outer edges xmin, ymin, xmax, ymax of each in a map grid, shape (n, 4)."""
        col, row, width, height = self.windows.T
        left, right = (grid.left + at * grid.resolution for at in (col, col + width))
        bottom, top = (grid.top - at * grid.resolution for at in (row + height, row))
        return np.stack([left, bottom, right, top], axis=1)

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, place: int) -> Tile: ...
    @overload
    def __getitem__(self, place: slice) -> Tiles: ...
    def __getitem__(self, place: int | slice) -> Tile | Tiles:
        if isinstance(place, slice):
            return self.only(self.indices[place].tolist())
        index = int(self.indices[place])
        row, col = divmod(index, self.shape[1])
        corner = Window(self.window.col + col * self.side, self.window.row + row * self.side, self.side, self.side)
        mine = self.sources[place % len(self)] if isinstance(self.sources, Shares) else self.sources
        return Tile(index, corner & self.window, mine)

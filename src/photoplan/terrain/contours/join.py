"""Pieces of contours from part to part become whole lines, with no more in memory than the sweep has open."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Key = tuple[int, int, int]
"""Two vertex numbers of an edge in the whole terrain, and the level that crosses it."""
Ends = dict[Key, "Chain"]


@dataclass(eq=False)
class Chain:
    """A piece of a contour, and where it may go on."""

    level: int
    pieces: deque[NDArray[np.float64]]
    """Vertices with their ranges, shapes (n, 6); the first of a piece is the last of the one before it."""
    start: Key | None
    """Edge of a part where the chain begins; None: it begins at a border or a wall, or is closed."""
    end: Key | None
    closed: bool = False

    def places(self) -> NDArray[np.float64]:
        """Vertices with their ranges, shape (n, 6), each once; a closed line's last vertex is followed by its first."""
        pieces = list(self.pieces)
        joined = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
        # Where pieces were joined to a ring, its first vertex stands at the end too.
        return joined[:-1] if self.closed and len(pieces) > 1 else joined


@dataclass(eq=False)
class Joiner:
    """Puts chains together by the edges that they share, row of parts by row of parts."""

    row: int = -1
    _starts: tuple[Ends, Ends] = field(default_factory=lambda: ({}, {}))
    """Chains by the edge where they begin: of the row before, and of this row."""
    _ends: tuple[Ends, Ends] = field(default_factory=lambda: ({}, {}))

    def add(self, chain: Chain) -> Chain | None:
        """Take a chain of the present row; returns it, or what it has completed, if nothing can follow any more."""
        if chain.start is not None:
            before = _pop(self._ends, chain.start)
            if before is not None:
                chain = self._append(before, chain)
        if chain.end is not None:
            after = _pop(self._starts, chain.end)
            if after is chain:
                chain.start, chain.end, chain.closed = None, None, True
            elif after is not None:
                chain = self._append(chain, after)
        if chain.start is None and chain.end is None:
            return chain
        # A chain that was known keeps its older end in the table of its row.
        if chain.start is not None and chain.start not in self._starts[0]:
            self._starts[1][chain.start] = chain
        if chain.end is not None and chain.end not in self._ends[0]:
            self._ends[1][chain.end] = chain
        return None

    def next_row(self, row: int) -> Iterator[Chain]:
        """Begin a row of parts; gives the chains that no part can continue any more."""
        while self.row < row and any((*self._starts, *self._ends)):
            for key, chain in self._starts[0].items():
                assert chain.start == key
                chain.start = None
                if chain.end is None:
                    yield chain
            for key, chain in self._ends[0].items():
                assert chain.end == key
                chain.end = None
                if chain.start is None:
                    yield chain
            self._starts, self._ends = (self._starts[1], {}), (self._ends[1], {})
            self.row += 1
        self.row = row

    def finish(self) -> Iterator[Chain]:
        """All that is left."""
        yield from self.next_row(self.row + 2)

    def _append(self, first: Chain, second: Chain) -> Chain:
        """One chain of two; the shorter list of pieces goes into the longer one."""
        if len(first.pieces) >= len(second.pieces):
            first.pieces.extend(second.pieces)
            kept, first.end = first, second.end
            if kept.end is not None:
                _replace(self._ends, kept.end, kept)
        else:
            second.pieces.extendleft(reversed(first.pieces))
            kept, second.start = second, first.start
            if kept.start is not None:
                _replace(self._starts, kept.start, kept)
        return kept


def _pop(tables: tuple[Ends, Ends], key: Key) -> Chain | None:
    return tables[1].pop(key, None) or tables[0].pop(key, None)


def _replace(tables: tuple[Ends, Ends], key: Key, chain: Chain) -> None:
    for table in tables:
        if key in table:
            table[key] = chain

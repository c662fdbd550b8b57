"""Squares that hold few points each: every one is the core of a patch of prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.surfaces.units import UnitLayout

#: Points that a leaf holds at most.
CAPACITY = 24
#: A leaf is not smaller than this many meshes.
_SMALLEST = 2


@dataclass(frozen=True, eq=False)
class Leaves:
    """Squares that cover all units, sorted by unit."""

    middle: NDArray[np.float64]
    """X, Y of the middles, shape (n, 2), in the coordinates that were given."""
    half: NDArray[np.float64]
    """Half sides, shape (n,), metres."""
    unit: NDArray[np.int64]
    """Number of each leaf's unit, row · columns + column, shape (n,)."""
    count: NDArray[np.int64]
    """Points inside, shape (n,)."""
    order: NDArray[np.int64]
    """Points in the order of leaves, shape (p,)."""
    first: NDArray[np.int64]
    """Points of leaf i are order[first[i]:first[i] + count[i]]."""

    def of_unit(self, unit: int) -> NDArray[np.int64]:
        """Leaves of a unit."""
        return np.arange(np.searchsorted(self.unit, unit), np.searchsorted(self.unit, unit, side="right"))


def quadtree(xy: NDArray[np.float64], layout: UnitLayout, meshes: int) -> Leaves:
    """Quarter each unit until a leaf holds at most `CAPACITY` points or is two meshes wide."""
    deepest = max(0, int(np.log2(meshes / _SMALLEST)))
    place = np.stack([xy[:, 0] - layout.left, layout.top - xy[:, 1]], axis=1) / layout.side
    column = np.clip(place[:, 0].astype(np.int64), 0, layout.columns - 1)
    row = np.clip(place[:, 1].astype(np.int64), 0, layout.rows - 1)
    inside = np.clip(((place - np.stack([column, row], axis=1)) * 2**deepest).astype(np.int64), 0, 2**deepest - 1)
    key = (row * layout.columns + column) << (2 * deepest) | _interleave(inside)
    order = np.argsort(key, kind="stable")
    key = key[order]
    cells = np.arange(layout.columns * layout.rows, dtype=np.int64)
    found: list[tuple[NDArray[np.int64], int]] = []
    for level in range(deepest + 1):
        shift = 2 * (deepest - level)
        count = np.searchsorted(key, (cells + 1) << shift) - np.searchsorted(key, cells << shift)
        split = (count > CAPACITY) & (level < deepest)
        found.append((cells[~split], level))
        cells = (cells[split, None] << 2 | np.arange(4)).ravel()
    code = np.concatenate([c << (2 * (deepest - level)) for c, level in found])
    levels = np.concatenate([np.full(len(c), level) for c, level in found])
    sort = np.argsort(code)
    code, levels = code[sort], levels[sort]
    first = np.searchsorted(key, code)
    count = np.searchsorted(key, code + (np.int64(1) << (2 * (deepest - levels)))) - first
    unit = code >> (2 * deepest)
    half = layout.side / 2.0 ** (levels + 1)
    corner = _separate(code & ((1 << (2 * deepest)) - 1)) * (layout.side / 2**deepest)
    x = layout.left + (unit % layout.columns) * layout.side + corner[:, 0] + half
    y = layout.top - (unit // layout.columns) * layout.side - corner[:, 1] - half
    return Leaves(middle=np.stack([x, y], axis=1), half=half, unit=unit, count=count, order=order, first=first)


def _interleave(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Column and row (n, 2) to one number whose bits alternate, so that quarters are ranges."""
    code = np.zeros(len(cells), np.int64)
    for bit in range(12):
        code |= ((cells[:, 0] >> bit) & 1) << (2 * bit) | ((cells[:, 1] >> bit) & 1) << (2 * bit + 1)
    return code


def _separate(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Inverse of `_interleave`."""
    cells = np.zeros((len(code), 2), np.int64)
    for bit in range(12):
        cells[:, 0] |= ((code >> (2 * bit)) & 1) << bit
        cells[:, 1] |= ((code >> (2 * bit + 1)) & 1) << bit
    return cells


def patches_at(leaves: Leaves, some: NDArray[np.int64]) -> NDArray[np.float64]:
    """Middle and half side of leaves, shape (n, 3)."""
    return np.column_stack([leaves.middle[some], leaves.half[some]])

"""Places closer than a tolerance become one place: points and vertices of lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


def clusters(xy: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """Number of the point that stands for each point; chosen points are more than `tolerance` apart.

    The first of several close points stands for them, and no point is farther than twice the tolerance from the one
    that stands for it. Time and memory grow linearly with the number of points, also where many lie at one place.
    """
    chosen = np.arange(len(xy))
    if len(xy) < 2:
        return chosen
    local = xy - np.floor(xy.min(axis=0))
    near = _candidates(local, tolerance)
    if not len(near):
        return chosen
    # All points of a cell of half the tolerance are close to each other: the first stands for them. What is left has
    # a bounded number of neighbours.
    first, whose = _first_of_cells(local[near], tolerance / 2)
    kept = near[first]
    pairs = cKDTree(local[kept]).query_pairs(tolerance, output_type="ndarray")
    chosen[near] = kept[_greedy(len(kept), pairs)][whose]
    return chosen


def _cells(local: NDArray[np.float64], side: float, shift: tuple[float, float]) -> NDArray[np.int64]:
    """One number for the cell of each point; different cells may share a number, which does no harm."""
    column, row = (np.floor(local[:, k] / side + shift[k]).astype(np.int64) for k in (0, 1))
    return np.asarray(column * (int(row.max()) + 2) + row, np.int64)


def _candidates(local: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """Points that may have another within the tolerance: those not alone in a cell of one of four shifted grids."""
    shared = np.zeros(len(local), bool)
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        key = _cells(local, 2 * tolerance, shift)
        order = np.argsort(key)
        same = np.diff(key[order]) == 0
        shared[order[1:][same]] = True
        shared[order[:-1][same]] = True
    return np.flatnonzero(shared)


def _first_of_cells(local: NDArray[np.float64], side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First point of every cell, in the order of points, and for each point which of them is its cell's."""
    column, row = (np.floor(local[:, k] / side).astype(np.int64) for k in (0, 1))
    order = np.lexsort((np.arange(len(local)), row, column))
    new = np.concatenate([[True], (np.diff(column[order]) != 0) | (np.diff(row[order]) != 0)])
    heads = order[new]
    rank = np.argsort(np.argsort(heads))
    whose = np.empty(len(local), np.int64)
    whose[order] = rank[np.cumsum(new) - 1]
    return np.sort(heads), whose


def _greedy(count: int, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """The first point of every neighbourhood stands for those of its neighbours that nobody stands for yet."""
    chosen = np.arange(count)
    neighbours: dict[int, list[int]] = {}
    for a, b in pairs.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    taken: set[int] = set()
    for a in sorted(neighbours):
        if a in taken:
            continue
        taken.add(a)
        for b in neighbours[a]:
            if b not in taken:
                taken.add(b)
                chosen[b] = a
    return chosen

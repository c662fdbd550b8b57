"""Which images are compared with each other, and which of their features look alike."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.matching.features import DESCRIPTOR_UNIT, Features

Pair = tuple[int, int]

#: Smaller part of a footprint that a pair shares.
_LEAST_SHARE = 0.05
#: Nearest or most similar images that an image is compared with, at most.
NEIGHBOURS = 20
#: Farthest of the nearest images, in median distances to the nearest one.
_REACH = 6.0
#: Coarse features that a pair shares at least.
_LEAST_SHARED = 6
#: Distance of descriptors as a part of that to the second best, at most (Lowe 2004, section 7.1).
_RATIO = 0.85
#: Rows of the table of similarities that are in memory at once.
_ROWS = 1024


@dataclass(frozen=True, eq=False)
class Guide:
    """Where features of the first image are to be expected in the second one."""

    xy: NDArray[np.float64]
    """Column and row, shape (n, 2), pixels; NaN: not to be expected anywhere."""
    radius: float
    """How far from there they may be, pixels."""


def all_pairs(count: int) -> list[Pair]:
    """Every image with every other one."""
    return list(itertools.combinations(range(count), 2))


def pairs_by_footprints(footprints: Sequence[NDArray[np.float64]]) -> list[Pair]:
    """Pairs whose footprints share at least 5 % of the smaller one."""
    areas = [shapely.convex_hull(shapely.MultiPoint(f)) for f in footprints]
    tree = shapely.STRtree(areas)
    found = []
    for i, area in enumerate(areas):
        for j in sorted(int(k) for k in tree.query(area) if k > i):
            smaller = min(area.area, areas[j].area)
            if smaller > 0 and area.intersection(areas[j]).area >= _LEAST_SHARE * smaller:
                found.append((i, j))
    return found


def pairs_by_distance(positions: NDArray[np.float64]) -> list[Pair]:
    """Each image with its 20 nearest ones, as far as six times the median distance to the nearest one."""
    n = len(positions)
    if n < 2:
        return []
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    limit = _REACH * float(np.median(distance.min(axis=1)))
    near = np.argsort(distance, axis=1, kind="stable")[:, :NEIGHBOURS]
    found = {
        (min(i, int(j)), max(i, int(j))) for i in range(n) for k, j in enumerate(near[i]) if distance[i, j] <= limit
    }
    return sorted(found)


def pairs_by_likeness(coarse: Sequence[Features]) -> list[Pair]:
    """Pairs that share some of their coarsest features: a quick look for images of which nothing is known.

    Each image keeps the 20 images that it shares most with, if they share six features or more.
    """
    shared = np.zeros((len(coarse), len(coarse)), int)
    for i, j in all_pairs(len(coarse)):
        shared[i, j] = shared[j, i] = len(match_features(coarse[i], coarse[j]))
    found: set[Pair] = set()
    for i, row in enumerate(shared):
        best = np.argsort(-row, kind="stable")[:NEIGHBOURS]
        found |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] >= _LEAST_SHARED}
    return sorted(found)


def match_features(a: Features, b: Features, guide: Guide | None = None) -> NDArray[np.int64]:
    """Features that are each other's most similar one, and clearly more similar than the next.

    Second best are features at other places only: one place may have several directions.

    Parameters
    ----------
    guide : Guide, optional
        Features of b are compared only where those of a are expected.

    Returns
    -------
    ndarray, shape (k, 2)
        Indices into a and b.
    """
    none = np.empty((0, 2), np.int64)
    if len(a) < 2 or len(b) < 2:
        return none
    left, right = (f.descriptors.astype(np.float32) / np.float32(DESCRIPTOR_UNIT) for f in (a, b))
    best = np.full(len(a), -1)
    back, back_value = np.full(len(b), -1), np.full(len(b), -np.inf)
    columns = np.arange(len(b))
    for start in range(0, len(a), _ROWS):
        rows = slice(start, min(start + _ROWS, len(a)))
        likeness = left[rows] @ right.T
        if guide is not None:
            likeness[_far(guide, rows, b)] = -1.0
        top = likeness.argmax(axis=0)
        value = likeness[top, columns]
        better = value > back_value
        back[better], back_value[better] = top[better] + start, value[better]
        best[rows] = _clear_best(likeness, b)
    i = np.flatnonzero(best >= 0)
    i = i[back[best[i]] == i]
    return np.stack([i, best[i]], axis=1)


def _far(guide: Guide, rows: slice, b: Features) -> NDArray[np.bool_]:
    expected, there = guide.xy[rows].astype(np.float32), b.xy.astype(np.float32)
    dx = expected[:, None, 0] - there[None, :, 0]
    dy = expected[:, None, 1] - there[None, :, 1]
    return ~(dx * dx + dy * dy <= np.float32(guide.radius**2))


def _clear_best(likeness: NDArray[np.float32], b: Features) -> NDArray[np.int64]:
    """Column of the best of each row, −1 where the second best is nearly as good or nothing may be compared."""
    rows = np.arange(len(likeness))
    few = min(4, likeness.shape[1])
    top = np.argpartition(-likeness, few - 1, axis=1)[:, :few]
    value = np.take_along_axis(likeness, top, axis=1)
    order = np.argsort(-value, axis=1, kind="stable")
    top, value = np.take_along_axis(top, order, axis=1), np.take_along_axis(value, order, axis=1)
    best = top[:, 0]
    # Unit vectors: squared distance = 2 − 2 · likeness.
    distance = 2.0 - 2.0 * np.minimum(value, 1.0)
    elsewhere = np.linalg.norm(b.xy[top] - b.xy[best][:, None], axis=-1) > 2.0
    next_best = np.where(elsewhere, distance, np.inf).min(axis=1)
    clear = (value[rows, 0] > -0.5) & (distance[:, 0] < _RATIO**2 * next_best)
    return np.where(clear, best, -1)

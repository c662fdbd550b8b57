"""Which data a patch is predicted from: the nearest ones, and a few further off in every direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

#: How many of the nearest data are taken …
POINTS, LINES = 72, 56
#: … and, where these lie in a row, how many of every 8th and of every 64th.
_FURTHER = ((8, 24), (64, 16))
#: Data whose extent across is less than this part of their extent along lie in a row.
_ROW = 0.1


@dataclass(frozen=True, eq=False)
class Tree:
    """A search tree of some of the data."""

    tree: cKDTree
    numbers: NDArray[np.int64]
    """Numbers of its data."""
    count: int
    """How many of them are taken."""

    def query(self, middles: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers of the nearest data, shape (p, count)."""
        near = self.tree.query(middles, k=np.arange(1, self.count + 1), p=np.inf)[1]
        found: NDArray[np.int64] = self.numbers[near]
        return found


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Search trees over points and over the points of lines, all of them and thinned.

    Where measurements lie in profiles, the nearest ones all lie in one row, and the slope across it is unknown; only
    there the thinned sets are asked too. Elsewhere far data would only bend the trend.
    """

    xy: NDArray[np.float64]
    """The data, shape (n, 2)."""
    near: tuple[Tree, ...]
    far: tuple[Tree, ...]

    @classmethod
    def of(cls, xy: NDArray[np.float64], points: int, order: NDArray[np.int64]) -> Neighbours:
        """Trees of data xy (n, 2), of which the first `points` are points.

        Parameters
        ----------
        order : ndarray, shape (points,)
            Points in an order in which neighbours follow each other: thinned, they still cover the area evenly.
        """
        near, far = [], []
        for numbers, most in ((order, POINTS), (np.arange(points, len(xy)), LINES)):
            if len(numbers):
                near.append(Tree(cKDTree(xy[numbers]), numbers, min(most, len(numbers))))
            for step, count in _FURTHER:
                some = numbers[step // 2 :: step]
                if len(some):
                    far.append(Tree(cKDTree(xy[some]), some, min(count, len(some))))
        return cls(xy, tuple(near), tuple(far))

    def query(self, middles: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers of the data around places (p, 2), shape (p, k); some may appear twice, −1 is none."""
        found = np.concatenate([tree.query(middles) for tree in self.near], axis=1)
        rows = _in_a_row(self.xy[found])
        if not rows.any() or not self.far:
            return found
        more = np.full((len(middles), sum(tree.count for tree in self.far)), -1, np.int64)
        more[rows] = np.concatenate([tree.query(middles[rows]) for tree in self.far], axis=1)
        return np.concatenate([found, more], axis=1)


def _in_a_row(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which sets of points (p, k, 2) are narrow."""
    centred = xy - xy.mean(axis=1, keepdims=True)
    a = (centred[..., 0] ** 2).mean(axis=1)
    b = (centred[..., 1] ** 2).mean(axis=1)
    c = (centred[..., 0] * centred[..., 1]).mean(axis=1)
    root = np.sqrt((a - b) ** 2 + 4 * c**2)
    narrow: NDArray[np.bool_] = a + b - root < _ROW**2 * (a + b + root)
    return narrow

"""Which part filters at places in the field have in a pixel between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window


def field_weights(
    places: Sequence[tuple[float, float]], window: Window
) -> list[tuple[int, NDArray[np.float32] | None]]:
    """Weights of the places for every pixel of a window; they add up to 1.

    Places that form a full grid (each of their columns with each of their rows, whatever the steps) are interpolated
    bilinearly, and beyond the outer ones the outer ones hold. Others get weights by the inverse square of the distance
    (Shepard 1968), so that each place has its own filter exactly and far from all of them their mean holds.

    Parameters
    ----------
    places : sequence of (column, row)
        All different.
    window : Window

    Returns
    -------
    list of (place, weights)
        Places, by their index, that have any weight in the window; weights of shape (height, width), None: 1 for all.
    """
    if len(places) == 1:
        return [(0, None)]
    col = np.arange(window.col, window.stop[0], dtype=np.float64)
    row = np.arange(window.row, window.stop[1], dtype=np.float64)
    cols, rows = sorted({x for x, _ in places}), sorted({y for _, y in places})
    found = []
    if len(cols) * len(rows) == len(places):
        across, down = _hats(cols, col), _hats(rows, row)
        for i, (x, y) in enumerate(places):
            along, below = across[cols.index(x)], down[rows.index(y)]
            if along.any() and below.any():
                found.append((i, np.multiply.outer(below, along).astype(np.float32)))
        return found
    nearness = [1.0 / np.maximum((row[:, None] - y) ** 2 + (col - x) ** 2, 1e-12) for x, y in places]
    total = np.sum(nearness, axis=0)
    return [(i, (near / total).astype(np.float32)) for i, near in enumerate(nearness)]


def _hats(nodes: Sequence[float], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear interpolation between nodes as one row of weights for each of them, (nodes, positions)."""
    return np.stack([np.interp(at, nodes, unit) for unit in np.eye(len(nodes))])

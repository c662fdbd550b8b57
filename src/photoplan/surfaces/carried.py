"""Positions of pixels in another CRS, interpolated where that is good enough."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import MapGrid, Window

#: Positions are computed at every so-manieth pixel and interpolated between.
STEP = 32


def carried_positions(
    grid: MapGrid, window: Window, carry: Callable[[NDArray[np.float64]], NDArray[np.float64]], tolerance: float
) -> NDArray[np.float64] | None:
    """Pixel centres of a window, carried from the map to other coordinates."""
    at_u = np.append(np.arange(0, window.width - 1, STEP), window.width - 1)
    at_v = np.append(np.arange(0, window.height - 1, STEP), window.height - 1)
    nodes = np.stack(np.meshgrid(at_u + window.col, at_v + window.row), axis=-1).astype(float)
    at_nodes = carry(grid.to_map(nodes))
    middles = (nodes[1:, 1:] + nodes[:-1, :-1]) / 2
    if middles.size:
        strict = carry(grid.to_map(middles))
        between = (at_nodes[1:, 1:] + at_nodes[1:, :-1] + at_nodes[:-1, 1:] + at_nodes[:-1, :-1]) / 4
        if np.abs(strict - between).max() > tolerance:
            return None
    return _between_nodes(at_nodes, at_u, at_v)


def _between_nodes(nodes: NDArray[np.float64], at_u: NDArray[np.int64], at_v: NDArray[np.int64]) -> NDArray[np.float64]:
    """Bilinear positions at every pixel between the nodes."""
    u, v = np.arange(at_u[-1] + 1.0), np.arange(at_v[-1] + 1.0)
    columns = np.empty((nodes.shape[0], len(u), 2))
    full = np.empty((len(v), len(u), 2))
    for k in range(2):
        for i in range(nodes.shape[0]):
            columns[i, :, k] = np.interp(u, at_u, nodes[i, :, k])
    upper = np.clip(np.searchsorted(at_v, v, side="right") - 1, 0, max(len(at_v) - 2, 0))
    lower = np.minimum(upper + 1, len(at_v) - 1)
    span = np.maximum(at_v[lower] - at_v[upper], 1)
    t = ((v - at_v[upper]) / span)[:, None, None]
    full[:] = columns[upper] * (1 - t) + columns[lower] * t
    return full


def box_points(
    boxes: NDArray[np.float64], carry: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None
) -> NDArray[np.float64]:
    """Points whose bounds hold the boxes xmin, ymin, xmax, ymax (n, 4) in other coordinates, shape (n, k, 2).

    Without `carry` these are two corners. Else they are a lattice over each box, and the same widened by a part in a
    hundred: edges bend between its points.
    """
    if carry is None:
        return boxes.reshape(-1, 2, 2)
    part = np.linspace(-0.01, 1.01, 9)
    x = boxes[:, None, None, 0] + part[None, None, :] * (boxes[:, 2] - boxes[:, 0])[:, None, None]
    y = boxes[:, None, None, 1] + part[None, :, None] * (boxes[:, 3] - boxes[:, 1])[:, None, None]
    lattice = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(len(boxes), 81, 2)
    return carry(lattice) if len(boxes) else lattice

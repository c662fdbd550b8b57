"""What a tile needs of its source: from blocks with heights of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.kernels.extent import height_ranges
from photoplan.plan.field import FieldGrid, FieldTable

#: Side of the blocks with heights of their own from which the source window is found, target pixels.
BLOCK = 64


def blocks_of(
    rects: NDArray[np.int32], heights: NDArray[np.float64], corners: NDArray[np.float64], relief: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Boxes cut into blocks that have heights of their own: rectangles (m, 4), and corners (m, 8, 3) by the boxes.

    A tile may be one box, but what it needs of the source is what its surface needs, not its box.
    """
    large = ((rects[:, 2:] - rects[:, :2]) > BLOCK).any(axis=1)
    parts = [_parts(rect, BLOCK) for rect in rects[large]]
    parent = np.r_[np.flatnonzero(~large), np.repeat(np.flatnonzero(large), [len(part) for part in parts])]
    blocks = np.concatenate([rects[~large], *parts])
    own = height_ranges(relief, blocks)
    low, high = np.maximum(own[:, 0], heights[parent, 0]), np.minimum(own[:, 1], heights[parent, 1])
    there = low <= high
    parent, blocks, low, high = parent[there], blocks[there], low[there], high[there]
    start, side = rects[parent, :2, None], rects[parent, 2:, None] - rects[parent, :2, None]
    fu, fv = np.moveaxis((blocks.reshape(-1, 2, 2).transpose(0, 2, 1) - start) / side, 1, 0)
    bottom, top = heights[parent].T
    fh = (np.stack([low, high], axis=1) - bottom[:, None]) / (top - bottom)[:, None]
    found = corners[parent].reshape(-1, 2, 2, 2, 3)
    for axis, f in ((1, fh), (2, fv), (3, fu)):
        a, b = (np.take(found, [i], axis=axis) for i in (0, 1))
        shape = [len(f), 1, 1, 1, 1]
        shape[axis] = 2
        found = a + f.reshape(shape) * (b - a)
    return blocks, found.reshape(-1, 8, 3)


def _parts(rect: NDArray[np.int32], side: int) -> NDArray[np.int32]:
    """A rectangle cut into smaller ones."""
    c, r = (g.ravel() for g in np.meshgrid(np.arange(rect[0], rect[2], side), np.arange(rect[1], rect[3], side)))
    return np.stack([c, r, np.minimum(c + side, rect[2]), np.minimum(r + side, rect[3])], axis=1).astype(np.int32)


def bend_beyond(grid: FieldGrid, table: FieldTable, xy: NDArray[np.float64]) -> float:
    """By how much the field can bend a block's edges beyond its corners, pixels.

    Linear interpolation misses a smooth function by the square of the distance, a bent one by the distance.
    """
    reach = np.ptp(xy, axis=1).max(axis=0) / np.array(grid.spacing)
    return table.residual * max(1.0, float(reach.max())) ** 2


def source_window(xy: NDArray[np.float64], margin: float, size: tuple[int, int]) -> Window:
    """Whole pixels that hold the positions with a margin, cut at the image's border."""
    around = int(np.ceil(min(margin, 1e6))) + 2
    # Clipped before the conversion: far outside the image a position may exceed any integer.
    col0, row0 = (int(np.clip(np.floor(a) - around, 0, s)) for a, s in zip(np.nanmin(xy, axis=(0, 1)), size))
    col1, row1 = (int(np.clip(np.ceil(a) + around + 1, 0, s)) for a, s in zip(np.nanmax(xy, axis=(0, 1)), size))
    return Window(col0, row0, max(0, col1 - col0), max(0, row1 - row0))


def scales_of(rects: NDArray[np.int32], corners: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest length of (∂x/∂u, ∂x/∂v) and (∂y/∂u, ∂y/∂v) at the corners, pixels per pixel."""
    c = corners.reshape(-1, 2, 2, 2, 3)
    width = (rects[:, 2] - rects[:, 0]).astype(float)[:, None, None, None]
    height = (rects[:, 3] - rects[:, 1]).astype(float)[:, None, None, None]
    du = np.repeat(np.diff(c, axis=3), 2, axis=3) / width[..., None]
    dv = np.repeat(np.diff(c, axis=2), 2, axis=2) / height[..., None]
    w = c[..., 2:]
    xy = c[..., :2] / w
    slope_u = (du[..., :2] - xy * du[..., 2:]) / w
    slope_v = (dv[..., :2] - xy * dv[..., 2:]) / w
    lengths = np.hypot(slope_u, slope_v)
    return float(lengths.min()), float(lengths.max())

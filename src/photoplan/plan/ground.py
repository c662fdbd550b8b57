"""Ground of a tile, the same for all its sources: its relief, and the positions of its boxes on the ground."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.kernels.anchors import owned_bounds
from photoplan.kernels.terrain import height_ranges
from photoplan.targets.map import Target

#: Side of the squares with heights of their own from which it is found what a tile needs of a source, pixels.
SQUARE = 64

# The 3 × 3 × 3 lattice of a box in (h, v, u): eight corners, and the nineteen places between them.
_LATTICE = np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=3)))
#: Places of the eight corners in the lattice, 4·ih + 2·iv + iu.
CORNERS = np.flatnonzero((_LATTICE != 0.5).all(axis=1))
#: Place of the middle of a box in the lattice.
MIDDLE = int(np.flatnonzero((_LATTICE == 0.5).all(axis=1))[0])


@dataclass(frozen=True, eq=False)
class Boxes:
    """Rectangles of a tile, each a pile of boxes of equal thickness, on the ground."""

    rects: NDArray[np.int32]
    """(m, 4): first column, first row, end column, end row, in the tile's pixels."""
    layers: NDArray[np.int64]
    """(m,): boxes in the pile of each rectangle."""
    rect: NDArray[np.int64]
    """(n,): the rectangle of each box; those of one are beside each other, from low to high."""
    heights: NDArray[np.float64]
    """(n, 2): lowest and highest h of each box."""
    lattice: NDArray[np.float64]
    """(n, 27, 3): X, Y, Z of the lattice of each box."""


@dataclass(frozen=True, eq=False)
class TileGround:
    """A tile before any source is looked at."""

    target: Target
    window: Window
    """The tile, in the target's pixels."""
    relief: NDArray[np.float32]
    """h of every pixel, shape (height, width); NaN where there is no surface."""
    ranges: NDArray[np.float64]
    """Lowest and highest h of squares of `SQUARE` pixels, shape (2, rows, cols); inf, −inf where there is none."""
    first: Boxes
    """The whole tile, cut only where its target is bent."""

    @classmethod
    def of(cls, target: Target, window: Window, relief: NDArray[np.float32]) -> TileGround:
        """Look at the relief of a tile."""
        rows, cols = -(-relief.shape[0] // SQUARE), -(-relief.shape[1] // SQUARE)
        ranges = height_ranges(relief, squares(relief.shape)).T.reshape(2, rows, cols)
        if target.breaks is None:
            rects = np.array([[0, 0, window.width, window.height]], np.int32)
            heights = np.array([[ranges[0].min(), ranges[1].max()]])
        else:
            rects = _between_breaks(target, window)
            heights = height_ranges(relief, rects)
        first = _boxes(target, window, rects, heights, np.ones(len(rects), np.int64))
        return cls(target=target, window=window, relief=relief, ranges=np.ascontiguousarray(ranges), first=first)

    @property
    def is_height(self) -> bool:
        """Whether h is the height of the ground: on a map."""
        level = self.first.lattice[:, :, 2] - self.first.heights[:, :1]
        rise = np.ptp(self.first.heights, axis=1)[:, None]
        return bool((np.abs(level - _LATTICE[:, 0] * rise) < 1e-6 * (1.0 + np.abs(self.first.heights).max())).all())

    def boxes(self, rects: NDArray[np.int32], layers: NDArray[np.int64]) -> Boxes:
        """Boxes of rectangles; those without a surface are dropped."""
        return _boxes(self.target, self.window, rects, height_ranges(self.relief, rects), layers)

    def XYZ(
        self, rects: NDArray[np.int32], heights: NDArray[np.float64], fractions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Ground of places (..., 3) in (h, v, u), 0 to 1, of boxes (..., 4) and (..., 2)."""
        return _ground(self.target, self.window, rects, heights, fractions)

    def owned(
        self, owner: NDArray[np.uint16], sources: Sequence[int], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Where the pixels are that some of `count` sources paint."""
        place = np.full(max(count, int(owner.max(initial=0))) + 1, -1)
        place[np.add(sources, 1)] = np.arange(len(sources))
        squares = np.zeros((len(sources), *self.ranges.shape[1:]), bool)
        parts = np.tile(np.array([*reversed(owner.shape), 0, 0]), (len(sources), 1))
        owned_bounds(owner, place, SQUARE, squares, parts)
        nothing = np.array([np.inf, -np.inf])[:, None, None]
        return np.where(squares[:, None], self.ranges, nothing), parts

    def where(self, mine: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """As `owned`, of some pixels: ranges, (2, rows, cols), of their own depths, and the part that they are in."""
        depth = np.where(mine, self.relief, np.float32(np.nan))
        ranges = height_ranges(depth, squares(depth.shape)).T.reshape(self.ranges.shape)
        rows, cols = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
        return np.ascontiguousarray(ranges), np.array([cols[0], rows[0], cols[-1] + 1, rows[-1] + 1])


@lru_cache(maxsize=16)
def squares(shape: tuple[int, int]) -> NDArray[np.int32]:
    """Rectangles of the squares of a tile of some rows and columns, row by row, shape (n, 4)."""
    row, col = (at.ravel() for at in np.mgrid[0 : shape[0] : SQUARE, 0 : shape[1] : SQUARE])
    ends = np.minimum(col + SQUARE, shape[1]), np.minimum(row + SQUARE, shape[0])
    return np.stack([col, row, *ends], axis=1).astype(np.int32)


def _between_breaks(target: Target, window: Window) -> NDArray[np.int32]:
    """The tile, cut where its target is bent: a pixel that a break crosses is alone between smooth rectangles."""
    places = ((), ()) if target.breaks is None else (target.breaks.columns, target.breaks.rows)
    cuts = []
    for at, first, count in zip(places, (window.col, window.row), (window.width, window.height)):
        edges = np.asarray(at, float) + 0.5 - first
        cuts.append(np.unique(np.clip(np.r_[0, np.floor(edges), np.ceil(edges), count], 0, count)).astype(np.int32))
    (c0, r0), (c1, r1) = (np.meshgrid(*(cut[part] for cut in cuts)) for part in (slice(-1), slice(1, None)))
    return np.stack([c0.ravel(), r0.ravel(), c1.ravel(), r1.ravel()], axis=1)


def _boxes(
    target: Target, window: Window, rects: NDArray[np.int32], heights: NDArray[np.float64], layers: NDArray[np.int64]
) -> Boxes:
    """Rectangles with their own height range; those without a surface are dropped."""
    there = np.isfinite(heights).all(axis=1)
    if not there.all():
        rects, heights, layers = rects[there], heights[there], layers[there]
    # A flat rectangle still needs a box with a thickness to divide by; float32 relief is only good to ~1e-7 of itself.
    pad = 0.01 + 1e-6 * np.abs(heights).max(axis=1, initial=0.0)
    heights = heights + np.stack([-pad, pad], axis=1)
    rect = np.repeat(np.arange(len(rects)), layers)
    layer = np.arange(len(rect)) - np.repeat(np.cumsum(layers) - layers, layers)
    low, high = heights[rect].T
    step = (high - low) / layers[rect]
    bottom = low + layer * step
    # The last layer ends exactly where the rectangle does.
    top = np.where(layer == layers[rect] - 1, high, bottom + step)
    bounds = np.stack([bottom, top], axis=1)
    lattice = _ground(target, window, rects[rect][:, None], bounds[:, None], _LATTICE)
    return Boxes(rects=rects, layers=layers, rect=rect, heights=bounds, lattice=lattice)


def _ground(
    target: Target,
    window: Window,
    rects: NDArray[np.int32],
    heights: NDArray[np.float64],
    fractions: NDArray[np.float64],
) -> NDArray[np.float64]:
    fh, fv, fu = fractions[..., 0], fractions[..., 1], fractions[..., 2]
    u = rects[..., 0] - 0.5 + fu * (rects[..., 2] - rects[..., 0]) + window.col
    v = rects[..., 1] - 0.5 + fv * (rects[..., 3] - rects[..., 1]) + window.row
    h = heights[..., 0] + fh * (heights[..., 1] - heights[..., 0])
    return target.to_ground(np.stack([u, v, h], axis=-1))

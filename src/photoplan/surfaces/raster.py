"""Terrain as a grid of heights, bilinear inside a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.sample_grid import sample_lattice, sample_points
from photoplan.surfaces.carried import carried_positions
from photoplan.targets.base import Target
from photoplan.targets.map import MapTarget

#: Between CRSs, positions are interpolated where that is good to this part of a mesh; else each pixel is transformed.
POSITION_TOLERANCE = 0.01
#: Posts that are read at once where single heights are asked for …
MOST_POSTS = 4_000_000
#: … and the side of the parts in which a range of heights is looked for.
PART = 2048


class HeightGrid(Protocol):
    """Posts of a terrain grid, read by windows; safe to call from several threads."""

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        ...

    def read(self, window: Window) -> NDArray[np.float32]:
        """Heights of a window inside the grid, shape (height, width), metres; NaN where there is none."""
        ...


@dataclass(frozen=True)
class RasterSurface:
    """A height grid placed in a CRS. Between four posts the height is bilinear (Behr 1989, eq. 5.10).

    Up to half a mesh beyond the outer posts the edge is continued, since a height raster's cells have an area;
    further out, and in every mesh that touches a missing post, there is no surface.
    """

    grid: HeightGrid
    origin: tuple[float, float]
    """X, Y of the upper-left post, metres."""
    mesh: tuple[float, float]
    """Mesh width in X and in Y, metres, both positive; rows run from north to south."""
    to_grid_crs: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Takes X, Y of the product's CRS (..., 2) to the grid's CRS; None if they are the same."""

    def __post_init__(self) -> None:
        if not (self.mesh[0] > 0 and self.mesh[1] > 0):
            raise InputError(f"terrain grid with mesh {self.mesh}; mesh widths must be positive (a north-up grid)")

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Heights of the pixel centres of a window of a map target, shape (height, width); NaN: no surface."""
        if not isinstance(target, MapTarget):
            raise UsageError(f"a raster surface gives relief for map targets, not for {type(target).__name__}")
        if self.to_grid_crs is not None:
            return self._relief_across(target, window)
        first = self._posts(target.grid.to_map((window.col, window.row)))
        step_x = target.grid.resolution / self.mesh[0]
        step_y = target.grid.resolution / self.mesh[1]
        last = first + np.array([(window.width - 1) * step_x, (window.height - 1) * step_y])
        part, offset = self._read(first, last)
        if part is None:
            return np.full((window.height, window.width), np.nan, np.float32)
        x0, y0 = first - offset
        return sample_lattice(part, x0, step_x, window.width, y0, step_y, window.height)

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height at map points (..., 2), shape (...); NaN where there is no surface."""
        XY = np.asarray(XY, float)
        posts = self._posts(XY if self.to_grid_crs is None else self.to_grid_crs(XY))
        flat = posts.reshape(-1, 2)
        there = np.isfinite(flat).all(axis=1)
        if not there.any():
            return np.full(posts.shape[:-1], np.nan)
        heights = np.full(len(flat), np.nan)
        heights[there] = self._sample(flat[there])
        return heights.reshape(posts.shape[:-1])

    def _sample(self, posts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heights at finite post coordinates (n, 2), in halves where they span too much of the grid to read at once."""
        low, high = posts.min(axis=0), posts.max(axis=0)
        window = self._window(low, high)
        if window.size == 0:
            return np.full(len(posts), np.nan)
        if window.size > MOST_POSTS and len(posts) > 1:
            order = np.argsort(posts[:, np.argmax(high - low)], kind="stable")
            heights = np.empty(len(posts))
            for half in np.array_split(order, 2):
                heights[half] = self._sample(posts[half])
            return heights
        offset = np.array([window.col, window.row], float)
        return sample_points(self.grid.read(window), posts - offset).astype(float)

    def height_range(self, bounds: tuple[float, float, float, float]) -> tuple[float, float]:
        """Lowest and highest post inside or next to map `bounds`; NaN, NaN where there is none."""
        xmin, ymin, xmax, ymax = bounds
        edge = np.linspace(0, 1, 9)
        x, y = np.meshgrid(xmin + edge * (xmax - xmin), ymin + edge * (ymax - ymin))
        XY = np.stack([x, y], axis=-1)
        posts = self._posts(XY if self.to_grid_crs is None else self.to_grid_crs(XY)).reshape(-1, 2)
        window = self._window(posts.min(axis=0), posts.max(axis=0))
        low, high = np.inf, -np.inf
        for part in window.tiles(PART):
            heights = self.grid.read(part)
            there = heights[np.isfinite(heights)]
            if there.size:
                low, high = min(low, float(there.min())), max(high, float(there.max()))
        return (low, high) if low <= high else (np.nan, np.nan)

    def _posts(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map coordinates to (column, row) of the posts."""
        return np.stack(
            [(XY[..., 0] - self.origin[0]) / self.mesh[0], (self.origin[1] - XY[..., 1]) / self.mesh[1]], axis=-1
        )

    def _window(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> Window:
        """Posts that surround positions from `low` to `high`; empty if there are none."""
        columns, rows = self.grid.size
        # A post more on each side: a position that rounding has moved over a post must still find its mesh.
        col0, row0 = (max(0, int(np.clip(np.floor(a), -1, s)) - 1) for a, s in zip(low, (columns, rows)))
        col1, row1 = (min(s, int(np.clip(np.floor(a), -3, s)) + 3) for a, s in zip(high, (columns, rows)))
        return Window(col0, row0, max(0, col1 - col0), max(0, row1 - row0))

    def _read(
        self, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32] | None, NDArray[np.float64]]:
        """Posts that surround positions from `low` to `high`, and the position of the first; None if there are none."""
        window = self._window(low, high)
        if window.size == 0:
            return None, np.zeros(2)
        return self.grid.read(window), np.array([window.col, window.row], float)

    def _relief_across(self, target: MapTarget, window: Window) -> NDArray[np.float32]:
        carry = self.to_grid_crs
        assert carry is not None
        posts = carried_positions(target.grid, window, lambda XY: self._posts(carry(XY)), POSITION_TOLERANCE)
        if posts is None:
            v, u = np.mgrid[: window.height, : window.width]
            uv = np.stack([u + window.col, v + window.row], axis=-1).astype(float)
            return self.heights(target.grid.to_map(uv)).astype(np.float32)
        part, offset = self._read(posts.min(axis=(0, 1)), posts.max(axis=(0, 1)))
        if part is None:
            return np.full((window.height, window.width), np.nan, np.float32)
        flat = sample_points(part, (posts - offset).reshape(-1, 2))
        return flat.reshape(window.height, window.width)

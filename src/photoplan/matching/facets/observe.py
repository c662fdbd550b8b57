"""The pixels of an image that look at a block of facets, and their rays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, project, tremor_of
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.facets_transfer import CELL, bends, steepness, transfer
from photoplan.matching.facets.pyramid import Pyramid

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]

#: Posts around a window that are adjusted with it and belong to its neighbours: half a patch of the roughness, the
#: border of which nothing is learnt, and some more.
MARGIN = 24
#: Rays are followed for pixels this far apart, or closer where rays between them would be off by more than this part of
#: a grey facet; they are bent if straight ones would be.
_STEP, _OFF = 32, 0.001
#: Times by which pixels lie closer on a facet than on level ground from which on they are left out: on a wall, whose
#: grey values are finer than the facets of the map, or beside the edge of what hides the ground behind it.
_WALL = 3.0
#: Points along a side of a block that are projected to find its pixels, and heights: some may lie beyond where a line
#: has seen.
_POINTS, _HEIGHTS = 9, 5


@dataclass(frozen=True)
class Facets:
    """A block of height facets on a map: posts and, between them, finer grey facets."""

    left: float
    """X of the first post."""
    top: float
    """Y of the first post."""
    pitch: float
    """Side of a height facet, metres."""
    shape: tuple[int, int]
    """Rows and columns of posts, at least 2 each."""
    ratio: int
    """Grey facets along a side of a height facet."""

    def to_posts(self, XY: ArrayLike) -> _Doubles:
        """Map points (..., 2) to column and row of the posts."""
        XY = np.asarray(XY, float)
        return np.stack([(XY[..., 0] - self.left) / self.pitch, (self.top - XY[..., 1]) / self.pitch], axis=-1)

    def to_map(self, uv: ArrayLike) -> _Doubles:
        """Inverse of `to_posts`."""
        uv = np.asarray(uv, float)
        return np.stack([self.left + uv[..., 0] * self.pitch, self.top - uv[..., 1] * self.pitch], axis=-1)

    def sampled(self, values: _Doubles, XY: ArrayLike) -> _Doubles:
        """Values at the posts (..., rows, columns), bilinear at map points (n, m, 2) of a grid, shape (..., n, m);
        beyond the border those of the border."""
        uv = self.to_posts(XY)
        rows, columns = self.shape
        x, y = np.clip(uv[0, :, 0], 0, columns - 1), np.clip(uv[:, 0, 1], 0, rows - 1)
        i, j = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
        a, b = x - i, (y - j)[:, None]
        upper, lower = values.take(j, -2), values.take(j + 1, -2)
        upper = upper.take(i, -1) * (1 - a) + upper.take(i + 1, -1) * a
        lower = lower.take(i, -1) * (1 - a) + lower.take(i + 1, -1) * a
        return np.asarray(upper * (1 - b) + lower * b)

    @property
    def posts(self) -> _Doubles:
        """X, Y of all posts, shape (rows, columns, 2)."""
        v, u = np.mgrid[: self.shape[0], : self.shape[1]]
        return self.to_map(np.stack([u, v], axis=-1))


def facets_of(grid: MapGrid, window: Window, level: int, ratio: int, margin: int = MARGIN) -> Facets:
    """Facets of a level over a window of a map and `margin` posts around it.

    Posts of a level are every 2^level-th pixel of the map, counted from its first: the same for every window.
    """
    step = 1 << level
    first = np.array([window.col, window.row]) // step - margin
    last = -(-(np.array(window.stop) - 1) // step) + margin
    left, top = grid.to_map(first * step)
    columns, rows = (last - first + 1).tolist()
    return Facets(left=float(left), top=float(top), pitch=grid.resolution * step, shape=(rows, columns), ratio=ratio)


def levels_done(window: Window, coarsest: int, level: int, part: float) -> float:
    """How much of all levels of a window is done when so much of one is: they cost as much as they have facets."""
    sides = [(window.width / 2**k + 2 * MARGIN, window.height / 2**k + 2 * MARGIN) for k in range(coarsest + 1)]
    facets = [across * along for across, along in sides]
    return (sum(facets[level + 1 :]) + part * facets[level]) / sum(facets)


@dataclass(frozen=True, eq=False)
class View:
    """An image that takes part."""

    camera: Camera
    pyramid: Pyramid
    finer: int = 0
    """Levels by which its pixels are smaller than usual ones: it takes part reduced by as many more."""


@dataclass(frozen=True, eq=False)
class Relief:
    """A surface that pixels are carried to."""

    heights: _Doubles
    """At the posts, shape (rows, columns), metres."""
    bent: _Doubles
    """See `facets_transfer.bends`."""
    steep: _Doubles
    """See `facets_transfer.steepness`."""

    @classmethod
    def of(cls, heights: _Doubles) -> Relief:
        """From heights at the posts."""
        rows, columns = heights.shape
        bent, steep = np.empty((2, rows, columns)), np.empty((-(-(rows - 1) // CELL), -(-(columns - 1) // CELL)))
        bends(heights, bent)
        steepness(heights, steep)
        return cls(heights, bent, steep)


@dataclass(frozen=True, eq=False)
class Sight:
    """What a view has of a block: pixels of a window of one of its levels, and how their rays run."""

    raw: _Floats
    """Grey values, shape (h, w); NaN where there are none."""
    ways: _Doubles
    """Rays of every so many pixels, see `facets_transfer.transfer`; (m, n, 8)."""
    steps: tuple[int, int]
    """How many pixels to the right and down."""
    level: float
    """Height that is 0 for them, metres."""
    first: tuple[int, int]
    """Column and row of the first pixel."""
    places: _Floats = field(default_factory=lambda: np.empty((0, 0, 4), np.float32))
    """Where the pixels lie on the surface, see `facets_transfer.transfer`."""
    on: _Doubles | None = None
    """Heights of the surface that they were carried to."""

    def onto(self, relief: Relief) -> Sight:
        """The same pixels, carried to a surface."""
        if self.on is relief.heights:
            return self
        places = np.empty((*self.raw.shape, 4), np.float32)
        transfer(self.ways, *self.steps, relief.heights - self.level, relief.bent, relief.steep, _WALL, places)
        return replace(self, places=places, on=relief.heights)


def look(view: View, level: int, facets: Facets, heights: tuple[float, float]) -> Sight | None:
    """Pixels of a level of a view that may look at a block between two heights, metres; None: there are none."""
    seen = pixels_between(view, level, facets, heights)
    return (
        None
        if seen is None
        else _followed(view.camera, seen[1], seen[0], level + view.finer, facets, _known(view, heights))
    )


def pixels_between(
    view: View, level: int, facets: Facets, heights: tuple[float, float]
) -> tuple[Window, _Floats] | None:
    """Window of a level of a view that may look at a block between two heights, metres, and its grey values, shape
    (h, w); None: there is none."""
    low, high = _known(view, heights)
    if not low < high:
        return None
    level += view.finer
    window = _window(view, level, facets, (low, high))
    if window.width < 2 or window.height < 2:
        return None
    raw = view.pyramid.read(level, window)
    return (window, raw) if np.isfinite(raw).any() else None


def _known(view: View, heights: tuple[float, float]) -> tuple[float, float]:
    """The part of a range of heights that a view may see."""
    low, high = heights
    return max(low, view.camera.vantage.floor), min(high, float(view.camera.vantage.point[2]) - 1e-3)


def _window(view: View, level: int, facets: Facets, heights: tuple[float, float]) -> Window:
    """Pixels of a level around the positions of a block between two heights, inside the image."""
    rows, columns = facets.shape
    v, u = np.meshgrid(np.linspace(0, rows - 1, _POINTS), np.linspace(0, columns - 1, _POINTS), indexing="ij")
    XY = facets.to_map(np.stack([u, v], axis=-1)).reshape(-1, 2)
    XYZ = np.concatenate([np.column_stack([XY, np.full(len(XY), z)]) for z in np.linspace(*heights, _HEIGHTS)])
    xy = project(view.camera, XYZ) / 2**level
    xy = xy[np.isfinite(xy).all(axis=1)]
    if not len(xy):
        return Window(0, 0, 0, 0)
    width, height = view.pyramid.size(level)
    first = np.clip(np.floor(xy.min(axis=0)) - 1, 0, (width, height)).astype(int)
    last = np.clip(np.ceil(xy.max(axis=0)) + 2, 0, (width, height)).astype(int)
    size = np.maximum(last - first, 0)
    return Window(int(first[0]), int(first[1]), int(size[0]), int(size[1]))


def _followed(
    camera: Camera, raw: _Floats, window: Window, level: int, facets: Facets, levels: tuple[float, float]
) -> Sight:
    """Rays of a lattice of pixels, as fine along each axis as it takes for straight lines between them to be good."""
    size, first, scale = (window.width, window.height), np.array([window.col, window.row]), 2.0**level
    # Where a flight shakes each line of the image stands for itself.
    right, down = _STEP, _STEP if tremor_of(camera) is None else 1

    def cross(at: _Doubles, z: float) -> _Doubles:
        return facets.to_posts(_on_level(camera, (at + first) * scale, z))

    def worst(found: _Doubles, expected: _Doubles) -> float:
        return float(np.nanmax(np.abs(found - expected), initial=0.0)) * facets.ratio

    while True:
        x, y = (np.arange(max(2, -(-(n - 1) // step) + 1)) * step for n, step in zip(size, (right, down)))
        at = np.stack(np.meshgrid(x, y), axis=-1).astype(float)
        low, high = (cross(at, z) for z in levels)
        off = np.zeros(2)
        for nodes, z in ((low, levels[0]), (high, levels[1])):
            if right > 1:
                off[0] = max(
                    off[0], worst(cross(at[:, :-1] + np.array([right / 2, 0.0]), z), (nodes[:, :-1] + nodes[:, 1:]) / 2)
                )
            if down > 1:
                off[1] = max(off[1], worst(cross(at[:-1] + np.array([0.0, down / 2]), z), (nodes[:-1] + nodes[1:]) / 2))
        if (off <= _OFF).all():
            break
        right, down = (max(1, step // 2) if far > _OFF else step for step, far in zip((right, down), off))
    half, mean, way = (levels[1] - levels[0]) / 2, (low + high) / 2, (high - low) / 2
    # With heights t from -1 to 1: mean + bend (t² - 1), and way t + twist (t³ - t).
    bend, twist = np.zeros_like(mean), np.zeros_like(mean)
    inner = [sum(levels) / 2 + part * half for part in (-0.5, 0.5)]
    some = tuple(slice(None, None, max(1, n // _POINTS)) for n in at.shape[:2])
    if worst(cross(at[some], inner[1]), (mean + way / 2)[some]) > _OFF:
        below, above = (cross(at, z) for z in inner)
        bend, twist = (4 * mean - 2 * (below + above)) / 3, (4 * (way - above + below)) / 3
    coefficients = mean - bend, (way - twist) / half, bend / half**2, twist / half**3
    ways = np.concatenate(coefficients, axis=-1)
    first_pixel = window.col, window.row
    return Sight(raw=raw, ways=ways, steps=(right, down), level=sum(levels) / 2, first=first_pixel)


def _on_level(camera: Camera, xy: NDArray[Any], height: float) -> _Doubles:
    """X, Y where rays of image points (..., 2) come down to a height; NaN where they do not."""
    origin, direction = camera.rays(xy.reshape(-1, 2), height)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (height - origin[:, 2]) / direction[:, 2]
        XY = np.where(direction[:, 2:] < 0, origin[:, :2] + along[:, None] * direction[:, :2], np.nan)
    return XY.reshape(xy.shape)

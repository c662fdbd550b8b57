"""Footprints of images, and tiles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.shifted import intersect


@dataclass(frozen=True, order=True, slots=True)
class Tile:
    """A part of a product that is one task."""

    index: int
    """Its place among all tiles of the product, row by row: also the empty ones are counted."""
    window: Window
    """Its pixels in the product."""
    sources: tuple[int, ...] = (0,)
    """Rows of the table of sources that can paint here; all others are never looked at."""

    @property
    def pixels(self) -> int:
        """Pixels of the tile."""
        return self.window.size


@dataclass(frozen=True, eq=False)
class Shares:
    """Which sources can paint which tile."""

    ends: NDArray[np.int64]
    """Where the rows of each tile end, shape (n,)."""
    rows: NDArray[np.uint16]
    """Rows of the table of sources, tile by tile."""

    def __getitem__(self, place: int) -> tuple[int, ...]:
        start = self.ends[place - 1] if place else 0
        return tuple(self.rows[start : self.ends[place]].tolist())

    def only(self, places: NDArray[np.int64]) -> Shares:
        """Those of some tiles, by their places."""
        counts = np.diff(self.ends, prepend=0)[places]
        ends = np.cumsum(counts)
        at = np.arange(int(counts.sum())) + np.repeat(self.ends[places] - ends, counts)
        return Shares(ends, self.rows[at])


@dataclass(frozen=True, eq=False)
class Tiles(Sequence[Tile]):
    """Tiles that can hold a part of a source; all others of the product stay empty. A `Tile` is made when one is asked
    for."""

    window: Window
    """All pixels of the product, cut row by row; the last tiles of a row and of a column are smaller."""
    side: int
    """Side of a tile, pixels."""
    indices: NDArray[np.uint32]
    """`Tile.index` of each, increasing."""
    sources: tuple[int, ...] | Shares = (0,)
    """Rows of the table of sources that can paint them: the same for all tiles, or tile by tile."""

    @classmethod
    def every(cls, window: Window, side: int, sources: int = 1) -> Tiles:
        """All tiles of a product, which every one of its sources can paint."""
        none = cls(window, side, np.empty(0, np.uint32), tuple(range(sources)))
        return none.only(range(none.total))

    @classmethod
    def shared(cls, sources: Sequence[Tiles]) -> Tiles:
        """Tiles of a product that at least one of its sources can paint, from those of each source alone."""
        if len(sources) > np.iinfo(np.uint16).max - 1:
            raise UsageError(f"{len(sources):,} images in one product; at most {np.iinfo(np.uint16).max - 1:,} can be")
        index = np.concatenate([tiles.indices for tiles in sources])
        rows = np.repeat(np.arange(len(sources), dtype=np.uint16), [len(tiles) for tiles in sources])
        order = np.argsort(index, kind="stable")
        indices, first = np.unique(index[order], return_index=True)
        ends = np.append(first[1:], len(index)).astype(np.int64)[: len(indices)]
        return replace(sources[0], indices=indices, sources=Shares(ends, rows[order]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of all tiles, the empty ones included."""
        return -(-self.window.height // self.side), -(-self.window.width // self.side)

    @property
    def total(self) -> int:
        """Number of all tiles, the empty ones included."""
        return self.shape[0] * self.shape[1]

    def only(self, indices: Iterable[int]) -> Tiles:
        """Those tiles of the product that have these indices, increasing; where sources are told tile by tile, tiles
        that are not among these are left out."""
        wanted = np.fromiter(indices, np.uint32)
        if not isinstance(self.sources, Shares):
            return replace(self, indices=wanted)
        places = np.flatnonzero(np.isin(self.indices, wanted))
        return replace(self, indices=self.indices[places], sources=self.sources.only(places))

    def with_neighbours(self) -> Tiles:
        """The same tiles, each with the sources of the eight around it, too."""
        if not isinstance(self.sources, Shares):
            return self
        rows, cols = self.shape
        counts = np.diff(self.sources.ends, prepend=0)
        row, col = np.divmod(np.repeat(self.indices.astype(np.int64), counts), cols)
        found = []
        for down, right in itertools.product((-1, 0, 1), repeat=2):
            inside = (row + down >= 0) & (row + down < rows) & (col + right >= 0) & (col + right < cols)
            at = (row + down) * cols + col + right
            found.append(np.stack([at, self.sources.rows.astype(np.int64)])[:, inside & np.isin(at, self.indices)])
        tile, source = np.unique(np.concatenate(found, axis=1), axis=1)
        ends = np.searchsorted(tile, self.indices.astype(np.int64), side="right")
        return replace(self, sources=Shares(ends, source.astype(np.uint16)))

    def inner(self) -> Tiles:
        """Tiles without those at the border, for a product that is smaller by a tile on each side."""
        rows, cols = self.shape
        row, col = np.divmod(self.indices.astype(np.int64), cols)
        kept = self.only(self.indices[(row > 0) & (row < rows - 1) & (col > 0) & (col < cols - 1)].tolist())
        row, col = np.divmod(kept.indices.astype(np.int64), cols)
        whole = self.window
        window = Window(whole.col, whole.row, whole.width - 2 * self.side, whole.height - 2 * self.side)
        return replace(kept, window=window, indices=((row - 1) * (cols - 2) + col - 1).astype(np.uint32))

    def touching(self, window: Window) -> Tiles:
        """Tiles of the product that hold pixels of a window, whichever are listed."""
        col, row = (
            max(0, at - first) // self.side
            for at, first in zip((window.col, window.row), (self.window.col, self.window.row))
        )
        ends = (-(-(stop - first) // self.side) for stop, first in zip(window.stop, (self.window.col, self.window.row)))
        right, bottom = (min(end, most) for end, most in zip(ends, reversed(self.shape)))
        rows, cols = np.arange(row, max(bottom, row)), np.arange(col, max(right, col))
        return self.only((rows[:, None] * self.shape[1] + cols).ravel().tolist())

    @property
    def windows(self) -> NDArray[np.int64]:
        """Column, row, width and height of each, shape (n, 4)."""
        row, col = np.divmod(self.indices.astype(np.int64), self.shape[1])
        corner = self.side * np.stack([col, row], axis=1)
        size = np.minimum(self.side, (self.window.width, self.window.height) - corner)
        return np.concatenate([np.add(corner, (self.window.col, self.window.row)), size], axis=1)

    def bounds(self, grid: MapGrid) -> NDArray[np.float64]:
        """Outer edges xmin, ymin, xmax, ymax of each in a map grid, shape (n, 4)."""
        col, row, width, height = self.windows.T
        left, right = (grid.left + at * grid.resolution for at in (col, col + width))
        bottom, top = (grid.top - at * grid.resolution for at in (row + height, row))
        return np.stack([left, bottom, right, top], axis=1)

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, place: int) -> Tile: ...
    @overload
    def __getitem__(self, place: slice) -> Tiles: ...
    def __getitem__(self, place: int | slice) -> Tile | Tiles:
        if isinstance(place, slice):
            return self.only(self.indices[place].tolist())
        index = int(self.indices[place])
        row, col = divmod(index, self.shape[1])
        corner = Window(self.window.col + col * self.side, self.window.row + row * self.side, self.side, self.side)
        mine = self.sources[place % len(self)] if isinstance(self.sources, Shares) else self.sources
        return Tile(index, corner & self.window, mine)


Bounds = tuple[float, float, float, float]

#: Ground further from the projection centre than this is not looked at, metres …
FAR = 30_000.0
#: … nor further than this many heights above the lowest ground (87° from the nadir).
FLATTEST = 20.0
#: Slope of the flattest rays that are followed; flatter ones and those that go up count as these.
_GRAZING = 0.25 / FLATTEST
#: Points on a side of the image's border.
_PER_SIDE = 24
#: Directions in which the extent of what is seen is known, beside those across the sides of the image.
_DIRECTIONS = 16
#: Levels between which curved rays are followed straight.
_LEVELS = 9
#: Boxes along a side in which the ground below an image is looked at, and how often it is looked at more closely.
_BOXES, _LOOKS = 48, 4
#: Points per side of the lattice that is asked for a first height where there is no ground below the camera.
_LATTICE = 9
_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Footprint:
    """What one image sees of the ground."""

    outline: NDArray[np.float64]
    """Ground points X, Y, Z of the image's border, or of the middle of its outermost pixels where they alone meet the
    surface, shape (n, 3); NaN where no ray does."""
    bounds: Bounds | None
    """Map bounds xmin, ymin, xmax, ymax of everything the image sees of the surface; None: nothing."""
    on_surface: float
    """Part of the image's border points and middle whose rays meet the surface, 0 to 1."""
    height_range: tuple[float, float]
    """Bounds of the heights inside the bounds, metres; NaN, NaN without bounds."""

    @property
    def usual_height(self) -> float:
        """Mean of the border's heights; where no border point meets the surface, the middle of the range."""
        met = self.outline[np.isfinite(self.outline[:, 2]), 2]
        return float(met.mean() if len(met) else np.mean(self.height_range))


@dataclass(frozen=True, eq=False)
class ImageExtent:
    """What an image can show of each level: how far it extends from the camera's vantage in some directions.

    Straight rays cross levels at places that move linearly with the level, so an extent, the largest of many such
    places, is a convex function of the level: between two levels it is no larger than on the line between its values.
    """

    center: NDArray[np.float64]
    """The camera's vantage, a projection centre if it has one, shape (3,)."""
    directions: NDArray[np.float64]
    """Unit vectors of the map, shape (k, 2); the first are +X, +Y, −X, −Y."""
    levels: NDArray[np.float64]
    """Ascending heights, shape (m,), metres; the image shows nothing above the last one that is finite."""
    extents: NDArray[np.float64]
    """Largest coordinate along each direction, from the vantage, shape (m, k), metres."""
    far: float
    """What lies further than this from the vantage, along any direction, does not count, metres."""

    @classmethod
    def of(cls, camera: Camera, low: float, high: float, far: float = math.inf) -> ImageExtent | None:
        """The view between two levels, cut off `far` from the vantage; None: no ray gets there."""
        vantage = camera.vantage
        center = vantage.point
        # A little more, for surfaces whose ranges are rounded.
        low, high = max(low - 0.5, vantage.floor), high + 0.5
        xy = _border(camera, min(low, float(center[2]) - 1.0))
        if xy is None:
            return None
        rays = [camera.rays(xy, level) for level in (low, min(high, float(center[2])))]
        straight = np.array_equal(rays[0][0], rays[1][0])
        slope = rays[0][1][:, 2] / (np.hypot(*rays[0][1][:, :2].T) + 1e-12)
        down, up = slope.min() < _GRAZING, straight and slope.max() > -_GRAZING
        ends = (low if down else max(low, float(center[2])), high if up else min(high, float(center[2])))
        if not ends[0] < ends[1]:
            return None
        levels = np.union1d(np.linspace(*ends, 2 if straight else _LEVELS), np.clip(center[2], *ends))
        feet = np.stack([_feet(camera, xy, level, rays[0] if straight else None) for level in levels]) - center[:2]
        for above in range(1, len(feet)):
            # A ray that ends between the levels, since nothing is known of it there, stays where it was.
            feet[above] = np.where(np.isnan(feet[above]), feet[above - 1], feet[above])
        directions = _directions(feet[0] if down else feet[-1])
        along = feet @ directions.T
        extents = along.max(axis=1)
        # The border may bend between its points, by less than it does between every second one; and a pixel.
        pixel = np.linalg.norm(np.diff(feet, axis=1), axis=2).sum(axis=1) / sum(camera.size) / 2
        extents += extents - along[:, ::2].max(axis=1) + pixel[:, None]
        return cls(center, directions, levels, extents, far)

    @property
    def bounds(self) -> Bounds:
        """Map bounds of all that the image can show of the levels."""
        east, north, west, south = np.minimum(self.extents[:, :4].max(axis=0), self.far)
        x, y = self.center[:2]
        return (float(x - west), float(y - south), float(x + east), float(y + north))

    def reach(self, ranges: NDArray[np.float64]) -> NDArray[np.float64]:
        """Extents (n, k) of what the image can show between two heights each (n, 2); −inf: nothing, NaN: no heights."""
        low = np.maximum(ranges[:, 0], self.levels[0])
        high = np.minimum(ranges[:, 1], self.levels[-1])
        at = np.stack([low, high], axis=1)
        extents = np.stack([np.interp(at, self.levels, column) for column in self.extents.T], axis=-1).max(axis=1)
        return np.where((low > high)[:, None], -np.inf, np.minimum(extents, self.far))

    def sees(self, boxes: NDArray[np.float64], ranges: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether boxes of the map (n, 4) with their ranges of heights (n, 2) can fall into the image, shape (n,)."""
        x, y = boxes[:, ::2] - self.center[0], boxes[:, 1::2] - self.center[1]
        u, v = self.directions.T
        nearest = np.minimum(x[:, :1] * u, x[:, 1:] * u) + np.minimum(y[:, :1] * v, y[:, 1:] * v)
        with np.errstate(invalid="ignore"):
            return np.asarray((nearest <= self.reach(ranges)).all(axis=1))


def image_border(size: tuple[int, int], per_side: int = 16) -> NDArray[np.float64]:
    """Points along the outer edge of an image, clockwise from the upper-left corner, shape (4·per_side, 2), pixels."""
    width, height = size
    t = np.arange(per_side) / per_side
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    ones = np.ones(per_side)
    sides = [
        np.stack([left + t * width, top * ones], axis=1),
        np.stack([right * ones, top + t * height], axis=1),
        np.stack([right - t * width, bottom * ones], axis=1),
        np.stack([left * ones, bottom - t * height], axis=1),
    ]
    return np.concatenate(sides)


def footprint(camera: Camera, terrain: Terrain, bounds: Bounds | None) -> Footprint:
    """Footprint of an image on the ground."""
    seen = _seen(camera, terrain, bounds)
    if seen is None:
        return Footprint(np.full((64, 3), np.nan), None, 0.0, (math.nan, math.nan))
    low, high = (float(h) for h in terrain.height_range(seen))
    border = np.concatenate([image_border(camera.size), [[(s - 1) / 2 for s in camera.size]]])
    outline = intersect(camera, border, terrain, (low, high))
    # A strip's record of the flight may end with the middle of its last line.
    missed = np.isnan(outline[:, 0])
    outline[missed] = intersect(camera, border[missed].clip(0, np.array(camera.size) - 1), terrain, (low, high))
    return Footprint(outline[:-1], seen, float(np.isfinite(outline[:, 0]).mean()), (low, high))


def mean_gsd(camera: Camera, seen: Footprint) -> float:
    """Mean ground sampling distance of an image over its footprint, metres.

    At each footprint point it is the square root of the ground area of one image pixel on level ground.
    """
    points = seen.outline[np.isfinite(seen.outline).all(axis=1)]
    if not len(points):
        xmin, ymin, xmax, ymax = seen.bounds or (0, 0, 0, 0)
        return math.sqrt((xmax - xmin) * (ymax - ymin) / (camera.size[0] * camera.size[1]))
    points = np.concatenate([points, points.mean(axis=0, keepdims=True)])
    area = np.abs(np.linalg.det(camera.derivatives(points)[..., :2]))
    return float(np.nanmean(1 / np.sqrt(area)))


class Ranged(Protocol):
    """What knows the range of its heights inside map bounds, as `Terrain.height_range` has it."""

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Lower and upper bound of the heights inside map bounds (..., 4), shape (..., 2); NaN where there are none."""
        ...


def covered_tiles(camera: Camera, terrain: Ranged, grid: MapGrid, side: int, seen: Bounds | None = None) -> Tiles:
    """Tiles that can hold a pixel of the image, judged from the range of heights under each tile; others than those
    that meet `seen`, the bounds of its footprint, are not looked at."""
    near = grid.window if seen is None else grid.window_of(seen)
    every = Tiles(grid.window, side, np.empty(0, np.uint32)).touching(near)
    boxes = every.bounds(grid)
    ranges = terrain.height_range(boxes)
    if not np.isfinite(ranges).any():
        return every.only(())
    view = ImageExtent.of(camera, float(np.nanmin(ranges)), float(np.nanmax(ranges)))
    return every.only(() if view is None else every.indices[view.sees(boxes, ranges)])


def some_height(terrain: Terrain, near: Bounds, x: float, y: float) -> float:
    """Height at a point, or else in the middle of what some points inside `near` have; NaN if all of them have none."""
    below = float(terrain.heights(np.array([x, y])))
    if np.isfinite(below):
        return below
    part = (np.arange(_LATTICE) + 0.5) / _LATTICE
    X, Y = near[0] + part * (near[2] - near[0]), near[1] + part * (near[3] - near[1])
    # One at a time: a surface may read all that lies between the points of one question.
    some = [float(terrain.heights(np.array([u, v]))) for u in X for v in Y]
    return float(np.nanmedian(some)) if np.isfinite(some).any() else math.nan


def _seen(camera: Camera, terrain: Terrain, bounds: Bounds | None) -> Bounds | None:
    """Bounds of the ground that can fall into the image; None: there is none.

    Between two levels the rays stay inside known bounds. If the ground there does not leave the levels, no ray has met
    ground elsewhere; otherwise the level that failed is moved, each time a little further than was found, so that
    slopes do not take many rounds. Ground far from the footprint is never asked for.
    """
    vantage = camera.vantage
    x, y, z = (float(c) for c in vantage.point)
    away = FAR if vantage.reach is None else vantage.reach
    near = (x - away, y - away, x + away, y + away)
    near = near if bounds is None else _common(near, bounds)
    if not _holds(near):
        return None
    low = high = some_height(terrain, near, x, y)
    more, whole = 0.01, False
    for _ in range(_ROUNDS):
        if not low < z and not whole:
            (low, high), whole = terrain.height_range(near), True
        if not low < z:
            return None
        view = ImageExtent.of(camera, low, high, min(away, FLATTEST * (z - low)) if vantage.central else away)
        cut = near if view is None else _common(near, view.bounds)
        if view is None or not _holds(cut):
            return None
        found = terrain.height_range(cut)
        if np.isnan(found[0]) and not whole:
            # There is a hole where the rays come down: what lies below these levels decides.
            found, whole = terrain.height_range(near), True
        if not (found[0] < low or found[1] > high):
            return _closely(view, terrain, cut)
        low = min(low, found[0] - more * (z - found[0])) if found[0] < low else low
        high, more = max(high, found[1]), 2 * more
    return near


def _closely(view: ImageExtent, terrain: Terrain, bounds: Bounds) -> Bounds | None:
    """Bounds of the boxes that can be seen, and of what can be seen of them; refined while they shrink much."""
    for _ in range(_LOOKS):
        x, y = np.linspace(bounds[0], bounds[2], _BOXES + 1), np.linspace(bounds[1], bounds[3], _BOXES + 1)
        left, bottom = (a.ravel() for a in np.meshgrid(x[:-1], y[:-1]))
        right, top = (a.ravel() for a in np.meshgrid(x[1:], y[1:]))
        boxes = np.stack([left, bottom, right, top], axis=1)
        ranges = terrain.height_range(boxes)
        kept = view.sees(boxes, ranges)
        if not kept.any():
            return None
        boxes = boxes[kept]
        east, north, west, south = (view.reach(ranges[kept])[:, :4] * (1, 1, -1, -1)).T
        tight = (
            max(bounds[0], float(np.maximum(boxes[:, 0], view.center[0] + west).min())),
            max(bounds[1], float(np.maximum(boxes[:, 1], view.center[1] + south).min())),
            min(bounds[2], float(np.minimum(boxes[:, 2], view.center[0] + east).max())),
            min(bounds[3], float(np.minimum(boxes[:, 3], view.center[1] + north).max())),
        )
        shrunk = (tight[2] - tight[0]) * (tight[3] - tight[1]) / ((bounds[2] - bounds[0]) * (bounds[3] - bounds[1]))
        bounds = tight
        if shrunk > 0.7:
            break
    return bounds


def _border(camera: Camera, level: float) -> NDArray[np.float64] | None:
    """Points of the image's border whose rays reach a level; None if no ray does.

    Where the border has no ray (beyond the circle of a fisheye, above the horizon of a curved earth) the last point
    that has one, on the way from a point that has one, takes its place.
    """
    border = image_border(camera.size, _PER_SIDE)
    blind = np.isnan(camera.rays(border, level)[1][:, 2])
    if not blind.any():
        return border
    part = (np.arange(_LATTICE) + 0.5) / _LATTICE
    inside = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * camera.size - 0.5
    inside = np.concatenate([inside, border])
    direction = camera.rays(inside, level)[1]
    if np.isnan(direction[:, 2]).all():
        return None
    good = np.broadcast_to(inside[np.nanargmin(direction[:, 2])], border[blind].shape).copy()
    bad = border[blind]
    for _ in range(20):
        middle = (good + bad) / 2
        there = np.isfinite(camera.rays(middle, level)[1][:, 2:])
        good, bad = np.where(there, middle, good), np.where(there, bad, middle)
    border[blind] = good
    return border


def _feet(
    camera: Camera, xy: NDArray[np.float64], level: float, rays: tuple[NDArray[np.float64], NDArray[np.float64]] | None
) -> NDArray[np.float64]:
    """Where rays cross a level, X and Y (n, 2); those that never do, or far away, end far away in their direction."""
    vantage = camera.vantage
    z = float(vantage.point[2])
    if vantage.central and abs(level - z) < 1e-6:
        return np.broadcast_to(vantage.point[:2], xy.shape)
    origin, direction = camera.rays(xy, level) if rays is None else rays
    sign = np.sign(level - z) or -1.0
    least = _GRAZING * np.hypot(direction[:, 0], direction[:, 1]) + 1e-12
    drop = sign * np.maximum(sign * direction[:, 2], least)
    foot = origin[:, :2] + direction[:, :2] * ((level - origin[:, 2]) / drop)[:, None]
    return np.asarray(foot)


def _directions(feet: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions for extents: along the map's axes, all around, and across the sides of what is seen of a level."""
    angle = np.concatenate([np.arange(4) * 4, np.setdiff1d(np.arange(_DIRECTIONS), np.arange(4) * 4)])
    around = np.stack([np.cos(angle * 2 * np.pi / _DIRECTIONS), np.sin(angle * 2 * np.pi / _DIRECTIONS)], axis=1)
    corners = feet[::_PER_SIDE]
    side = np.roll(corners, -1, axis=0) - corners
    across = np.stack([side[:, 1], -side[:, 0]], axis=1) / (np.linalg.norm(side, axis=1, keepdims=True) + 1e-12)
    outwards = np.sign(((corners - corners.mean(axis=0)) * across).sum(axis=1, keepdims=True))
    return np.concatenate([around, across * outwards])


def _common(a: Bounds, b: Bounds) -> Bounds:
    return (max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3]))


def _holds(bounds: Bounds) -> bool:
    return bounds[0] < bounds[2] and bounds[1] < bounds[3]

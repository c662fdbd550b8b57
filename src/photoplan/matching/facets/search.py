"""A start where relief is strong: heights are searched on planes, neighbours have like ones (semi-global matching).

The planes are those of an object-space sweep (Collins 1996): every image is carried to each of them, where census
descriptions of their cells are compared. From coarse to fine each post is searched around what the level before found
(Rothermel et al. 2012), so that the planes of the finest levels are few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.cameras.base import project
from photoplan.events import stretch, tell
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.matching import (
    HALF_COLUMNS,
    HALF_ROWS,
    MOST_PAIRS,
    add_plane_costs,
    census_transform,
    cost_scatter,
    least_cost_steps,
    sample_plane,
    sum_paths,
)
from photoplan.matching.facets.observe import Facets, View, facets_of, levels_done, pixels_between

_Doubles = NDArray[np.float64]
_Integers = NDArray[np.int64]

#: Distance of the planes, pixels of parallax of a level.
_STEP = 0.5
#: Cells between those that are projected, and planes.
_LATTICE, _EVERY = 16, 4
#: Nearest to the images that planes come, part of the distance of the height at which they are stated.
_NEAREST = 0.25
#: Steps that are searched around the least and largest of the posts around; posts around that are sure, and if not.
_AROUND, _NEAR, _WIDE = 3, 3, 9
#: What a step to the next plane costs along a path, and to any other one, parts of the cost's usual contrast; paths.
_SMALL, _LARGE, _PATHS = 0.15, 0.75, 8
#: Steps next to the best one that are no other choice, and the part of the contrast by which others must cost more.
_APART, _SURE = 2, 0.5
#: What a choice must cost more, parts of the contrast, to be less probable by the factor e: half the contrast is wrong
#: in 0.5 % of the places. What is less probable than this does not count: nobody counted it.
_PROBABLE, _FAINT = 0.094, 0.003
#: Pixels of parallax by which heights may differ from those that were found without a doubt.
_AWAY = 1.0


@dataclass(frozen=True)
class Planes:
    """Heights of the planes of every level, the same for all windows of a map."""

    pixel: float
    """What one pixel of parallax of usual pairs of images is at the height `at`, metres; of the finest level."""
    at: float
    ceiling: float = np.inf
    """Height of the images, metres: towards it planes come closer, as parallax grows."""

    def heights(self, numbers: NDArray[np.number], level: int) -> _Doubles:
        """Of planes by their numbers, metres."""
        if np.isinf(self.ceiling):
            return np.asarray(numbers * self._step(level))
        return np.asarray(self.ceiling - 1.0 / (np.maximum(numbers, 1e-3) * self._step(level)))

    def numbers(self, heights: _Doubles, level: int) -> _Doubles:
        """Inverse of `heights`, with parts."""
        if np.isinf(self.ceiling):
            return np.asarray(heights / self._step(level))
        least = _NEAREST * (self.ceiling - self.at)
        return np.asarray(1.0 / np.maximum(self.ceiling - heights, least) / self._step(level))

    def pixels(self, heights: _Doubles) -> _Doubles:
        """Height of one pixel of parallax at heights, metres; of the finest level."""
        if np.isinf(self.ceiling):
            return np.full(np.shape(heights), self.pixel)
        return np.asarray(self.pixel * ((self.ceiling - heights) / (self.ceiling - self.at)) ** 2)

    def away(self, heights: _Doubles, found: _Doubles) -> _Doubles:
        """By how much heights are farther from others than a pixel of parallax, metres; 0 where they are not."""
        return np.asarray(np.maximum(np.abs(heights - found) - _AWAY * self.pixels(found), 0.0))

    def _step(self, level: int) -> float:
        step = _STEP * 2**level * self.pixel
        return step if np.isinf(self.ceiling) else step / (self.ceiling - self.at) ** 2


@dataclass(frozen=True)
class Search:
    """How heights are searched."""

    planes: Planes
    ratio: int
    """Cells that are compared along the side of a height facet of the finest level."""
    base: int
    """Pyramid level of the images for these."""
    coarsest: int
    """Level on which the whole reach is searched."""
    room: float
    """How far what is found may be wrong, metres."""


@dataclass(frozen=True, eq=False)
class Searched:
    """Heights that were found post by post."""

    facets: Facets
    heights: _Doubles
    """Shape (rows, columns), metres."""
    margin: _Doubles
    """By how much other heights cost more, parts of the cost's usual contrast; 0: unknown."""
    variance: _Doubles
    """Of the choice among heights, m²."""
    ends: tuple[_Doubles, _Doubles]
    """Least and largest number of the planes of the posts around."""

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Where other heights cost clearly more."""
        return np.asarray(self.margin >= _SURE)

    def __call__(self, XY: _Doubles) -> _Doubles:
        """Heights at map points (n, m, 2) of a grid."""
        return self.facets.sampled(self.heights, XY)


def search(
    views: Sequence[View],
    grid: MapGrid,
    window: Window,
    how: Search,
    start: Callable[[_Doubles], _Doubles],
    reach: float,
) -> Searched | None:
    """Heights of a window of a map."""
    found: Searched | None = None
    planes = how.planes
    for level in range(how.coarsest, -1, -1):
        facets = facets_of(grid, window, level, how.ratio)
        begun = np.asarray(start(facets.posts), float)
        if not np.isfinite(begun).any():
            return None
        begun = np.where(np.isfinite(begun), begun, np.nanmean(begun))
        low, high = (np.floor(planes.numbers(begun + side * reach, level)).astype(np.int64) for side in (-1, 1))
        if found is not None:
            near = _near(found, facets)
            low, high = np.clip(near[0], low, high), np.clip(near[1], low, high)
        begin, end = (levels_done(window, how.coarsest, level, part) for part in (0.0, 1.0))
        with stretch(begin, end, f"level {how.coarsest - level + 1} of {how.coarsest + 1}"):
            before, found = found, _level(views, level, how.base, facets, planes, low, high + 1) or found
        if before is not None and found is not None and found is not before:
            found = replace(found, variance=found.variance + _nearest(before.facets, before.variance, facets))
    if found is None or found.facets.pitch != grid.resolution:
        return None
    heights = _filled(found.heights, np.clip(found.margin / _SURE, 0.0, 1.0) ** 4)
    return replace(found, heights=heights, variance=found.variance + planes.away(heights, found.heights) ** 2)


def _filled(values: _Doubles, weights: _Doubles) -> _Doubles:
    """Values as far as they weigh, 0 to 1, and for the rest those of cells twice as large, and so on."""
    rows, columns = values.shape
    if min(rows, columns) < 2:
        return np.full_like(values, np.average(values, weights=weights + 1e-12))
    padded = [np.pad(a, ((0, rows % 2), (0, columns % 2))) for a in (weights * values, weights)]
    sums, share = (a.reshape(a.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3)) for a in padded)
    coarse = _filled(sums / np.maximum(share, 1e-12), np.minimum(share, 1.0))
    finer = ndimage.zoom(coarse, 2, order=1, mode="nearest", grid_mode=True)[:rows, :columns]
    return np.asarray(weights * values + (1 - weights) * finer)


def _near(found: Searched, facets: Facets) -> tuple[_Integers, _Integers]:
    """First and last plane to be searched at the posts of the next finer level."""
    low, high = (2.0 * _nearest(found.facets, end, facets) + side * _AROUND for side, end in zip((-1, 1), found.ends))
    return np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)


def _around(steps: _Doubles, sure: NDArray[np.bool_]) -> tuple[_Doubles, _Doubles]:
    """Least and largest of the planes of the sure posts around each, farther around where a post is not sure.

    Where no post around is sure, of all of them.
    """
    ends = []
    for extreme, nothing in ((ndimage.minimum_filter, np.inf), (ndimage.maximum_filter, -np.inf)):
        trusted = np.where(sure, steps, nothing)
        far = extreme(trusted, _WIDE)
        far = np.where(np.isfinite(far), far, extreme(steps, _WIDE))
        ends.append(extreme(np.where(sure, extreme(trusted, _NEAR), far), _NEAR))
    return ends[0], ends[1]


def _nearest(own: Facets, values: _Doubles, finer: Facets) -> _Doubles:
    """Values at the nearest posts."""
    uv = np.rint(own.to_posts(finer.posts)).astype(int)
    rows, columns = own.shape
    return np.asarray(values[np.clip(uv[..., 1], 0, rows - 1), np.clip(uv[..., 0], 0, columns - 1)])


def _level(
    views: Sequence[View], level: int, base: int, facets: Facets, planes: Planes, low: _Integers, high: _Integers
) -> Searched | None:
    """Heights at the posts of a level, each between its own two planes; None: no two images see it."""
    m, (rows, columns) = facets.ratio, facets.shape
    ends = planes.heights(np.array([low.min(), high.max()]), level)
    seen = [(view, *pixels) for view in views if (pixels := pixels_between(view, level + base, facets, tuple(ends)))]
    if len(seen) < 2:
        return None
    shape = (len(seen), (rows - 1) * m + 1, (columns - 1) * m + 1)
    census, known = np.zeros(shape, np.uint64), np.zeros(shape, bool)
    first = np.concatenate([[0], np.cumsum(high - low)]).astype(np.int64)
    cost = np.full(first[-1], np.nan, np.float32)
    pairs = _pairs(seen, facets, planes, level, float(ends.mean()))
    half = max(1, m // 2)
    grey = np.empty(shape[1:], np.float32)
    for k in range(int(low.min()), int(high.max())):
        if (k - int(low.min())) % _EVERY == 0:
            ats = [
                _positions(view, window, level + base + view.finer, facets, planes, level, k)
                for view, window, _ in seen
            ]
        part = (k - int(low.min())) % _EVERY / _EVERY
        active = (low <= k) & (k < high)
        if not active.any():
            continue
        tell((k - int(low.min())) / int(high.max() - low.min()))
        cells = _cells(active, m, shape[1:], (half, half))
        around = ndimage.maximum_filter(cells, (2 * HALF_ROWS + 1, 2 * HALF_COLUMNS + 1))
        for n, (_, _, raw) in enumerate(seen):
            sample_plane(raw, (1 - part) * ats[n][0] + part * ats[n][1], _LATTICE, around, grey)
            census_transform(grey, cells, census[n], known[n])
        add_plane_costs(census, known, pairs, k, low, high, m, half, np.nan, first, cost)
    contrast, usual = _contrast(cost, first)
    # Heights at which no two images see a post may be right as well: others have to be better than chance.
    cost[np.isnan(cost)] = usual - _SURE * contrast
    path, total = np.empty_like(cost), np.zeros_like(cost)
    sum_paths(cost, first, low, np.float32(_SMALL * contrast), np.float32(_LARGE * contrast), path, total)
    steps, margin, variance = np.empty((3, rows, columns))
    least_cost_steps(total, first, low, _APART, steps, margin)
    whole = _PATHS * contrast
    nearby = _around(steps, margin >= _SURE * whole)
    # What finer levels search is not yet chosen from.
    kept = (nearby[0] - _AROUND / 2, nearby[1] + _AROUND / 2) if level else (steps - _APART, steps + _APART)
    cost_scatter(total, first, low, steps, _PROBABLE * whole, _FAINT, *kept, variance)
    heights = planes.heights(steps, level)
    step = _STEP * 2**level * planes.pixels(heights)
    return Searched(facets=facets, heights=heights, margin=margin / whole, variance=variance * step**2, ends=nearby)


def _cells(active: NDArray[np.bool_], m: int, shape: tuple[int, int], half: tuple[int, int]) -> NDArray[np.bool_]:
    """Cells around posts."""
    out = np.zeros(shape, bool)
    out[::m, ::m] = active
    return np.asarray(ndimage.maximum_filter(out, (2 * half[0] + 1, 2 * half[1] + 1)))


def _positions(
    view: View, window: Window, pyramid: int, facets: Facets, planes: Planes, level: int, k: int
) -> tuple[_Doubles, _Doubles]:
    """Where every `_LATTICE`-th cell of a plane, and of another `_EVERY` further on, lies in a window of an image."""
    m, (rows, columns) = facets.ratio, facets.shape
    u, v = (np.arange(-(-((n - 1) * m) // _LATTICE) + 1) * (_LATTICE / m) for n in (columns, rows))
    XY = facets.to_map(np.stack(np.meshgrid(u, v), axis=-1))
    out = []
    for z in planes.heights(np.array([k, k + _EVERY]), level):
        xy = project(view.camera, np.concatenate([XY, np.full((*XY.shape[:2], 1), z)], axis=-1))
        out.append(np.asarray(xy / 2**pyramid - (window.col, window.row)))
    return out[0], out[1]


def _pairs(
    seen: Sequence[tuple[View, Window, NDArray[np.float32]]], facets: Facets, planes: Planes, level: int, height: float
) -> _Integers:
    """All pairs of images, the best to compare first: those whose rays part as the planes are made for.

    Rays that part more see things from sides too different, and those that part less tell less of heights.
    """
    every = np.array(list(combinations(range(len(seen)), 2)))
    if len(every) <= MOST_PAIRS:
        return every
    rows, columns = facets.shape
    middle = facets.to_map(np.array([columns - 1, rows - 1]) / 2)
    ways = []
    for view, _, _ in seen:
        J = view.camera.derivatives(np.array([*middle, height]))
        ways.append(np.linalg.solve(J[:, :2], J[:, 2]))
    apart = np.linalg.norm(np.array(ways)[every[:, 0]] - np.array(ways)[every[:, 1]], axis=1)
    best = facets.pitch / facets.ratio / 2**level / float(planes.pixels(np.array(height)))
    return np.ascontiguousarray(every[np.argsort(np.abs(np.log(np.maximum(apart, 1e-9) / best)), kind="stable")])


def _contrast(cost: NDArray[np.float32], first: _Integers) -> tuple[float, float]:
    """Usual cost of a plane less the least one of its post, and the usual cost; NaN: not seen by two images."""
    known = np.isfinite(cost)
    counts = np.add.reduceat(known, first[:-1], dtype=np.int64)
    several = counts > 2
    if not several.any():
        return 0.1, 0.5
    least = np.minimum.reduceat(np.where(known, cost, np.float32(np.inf)), first[:-1])[several]
    usual = np.add.reduceat(np.where(known, cost, np.float32(0)), first[:-1])[several] / counts[several]
    return max(float(np.median(usual - least)), 0.02), float(np.median(usual))

"""Surface reconstruction with facets from coarse to fine, after a search on planes (semi-global matching).

The planes are those of an object-space sweep (Collins 1996): every image is carried to each of them, where census
descriptions of their cells are compared. From coarse to fine each post is searched around what the level before found
(Rothermel et al. 2012), so that the planes of the finest levels are few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.arrays import Floats, Floats32, Ints, Mask
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
from photoplan.matching.facets.block import (
    FacetBlock,
    edge_variances,
    evidence,
    fit,
    grey_places,
    grey_sigmas,
    misfit_variances,
    pixel_noise,
    residual_pictures,
)
from photoplan.matching.facets.observe import (
    MARGIN,
    Facets,
    Relief,
    Roughness,
    Sight,
    Transfer,
    View,
    facets_of,
    first_guess,
    levels_done,
    look,
    pixels_between,
)

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

    def heights(self, numbers: NDArray[np.number], level: int) -> Floats:
        """Of planes by their numbers, metres."""
        if np.isinf(self.ceiling):
            return np.asarray(numbers * self._step(level))
        return np.asarray(self.ceiling - 1.0 / (np.maximum(numbers, 1e-3) * self._step(level)))

    def numbers(self, heights: Floats, level: int) -> Floats:
        """Inverse of `heights`, with parts."""
        if np.isinf(self.ceiling):
            return np.asarray(heights / self._step(level))
        least = _NEAREST * (self.ceiling - self.at)
        return np.asarray(1.0 / np.maximum(self.ceiling - heights, least) / self._step(level))

    def pixels(self, heights: Floats) -> Floats:
        """Height of one pixel of parallax at heights, metres; of the finest level."""
        if np.isinf(self.ceiling):
            return np.full(np.shape(heights), self.pixel)
        return np.asarray(self.pixel * ((self.ceiling - heights) / (self.ceiling - self.at)) ** 2)

    def away(self, heights: Floats, found: Floats) -> Floats:
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
    heights: Floats
    """Shape (rows, columns), metres."""
    margin: Floats
    """By how much other heights cost more, parts of the cost's usual contrast; 0: unknown."""
    variance: Floats
    """Of the choice among heights, m²."""
    ends: tuple[Floats, Floats]
    """Least and largest number of the planes of the posts around."""

    @property
    def sure(self) -> Mask:
        """Where other heights cost clearly more."""
        return np.asarray(self.margin >= _SURE)

    def __call__(self, XY: Floats) -> Floats:
        """Heights at map points (n, m, 2) of a grid."""
        return self.facets.sampled(self.heights, XY)


def search(
    views: Sequence[View], grid: MapGrid, window: Window, how: Search, start: Callable[[Floats], Floats], reach: float
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


def _filled(values: Floats, weights: Floats) -> Floats:
    """Values as far as they weigh, 0 to 1, and for the rest those of cells twice as large, and so on."""
    rows, columns = values.shape
    if min(rows, columns) < 2:
        return np.full_like(values, np.average(values, weights=weights + 1e-12))
    padded = [np.pad(a, ((0, rows % 2), (0, columns % 2))) for a in (weights * values, weights)]
    sums, share = (a.reshape(a.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3)) for a in padded)
    coarse = _filled(sums / np.maximum(share, 1e-12), np.minimum(share, 1.0))
    finer = ndimage.zoom(coarse, 2, order=1, mode="nearest", grid_mode=True)[:rows, :columns]
    return np.asarray(weights * values + (1 - weights) * finer)


def _near(found: Searched, facets: Facets) -> tuple[Ints, Ints]:
    """First and last plane to be searched at the posts of the next finer level."""
    low, high = (2.0 * _nearest(found.facets, end, facets) + side * _AROUND for side, end in zip((-1, 1), found.ends))
    return np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)


def _around(steps: Floats, sure: Mask) -> tuple[Floats, Floats]:
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


def _nearest(own: Facets, values: Floats, finer: Facets) -> Floats:
    """Values at the nearest posts."""
    uv = np.rint(own.to_posts(finer.posts)).astype(int)
    rows, columns = own.shape
    return np.asarray(values[np.clip(uv[..., 1], 0, rows - 1), np.clip(uv[..., 0], 0, columns - 1)])


def _level(
    views: Sequence[View], level: int, base: int, facets: Facets, planes: Planes, low: Ints, high: Ints
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


def _cells(active: Mask, m: int, shape: tuple[int, int], half: tuple[int, int]) -> Mask:
    """Cells around posts."""
    out = np.zeros(shape, bool)
    out[::m, ::m] = active
    return np.asarray(ndimage.maximum_filter(out, (2 * half[0] + 1, 2 * half[1] + 1)))


def _positions(
    view: View, window: Window, pyramid: int, facets: Facets, planes: Planes, level: int, k: int
) -> tuple[Floats, Floats]:
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
    seen: Sequence[tuple[View, Window, Floats32]], facets: Facets, planes: Planes, level: int, height: float
) -> Ints:
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


def _contrast(cost: Floats32, first: Ints) -> tuple[float, float]:
    """Usual cost of a plane less the least one of its post, and the usual cost; NaN: not seen by two images."""
    known = np.isfinite(cost)
    counts = np.add.reduceat(known, first[:-1], dtype=np.int64)
    several = counts > 2
    if not several.any():
        return 0.1, 0.5
    least = np.minimum.reduceat(np.where(known, cost, np.float32(np.inf)), first[:-1])[several]
    usual = np.add.reduceat(np.where(known, cost, np.float32(0)), first[:-1])[several] / counts[several]
    return max(float(np.median(usual - least)), 0.02), float(np.median(usual))


#: Iterations of the coarsest level and of others until roughness is estimated; for the last level and others, how many
#: estimates follow each other, and iterations after each series.
_FIRST, _THEN = (4, 2), (((3, 1), (2, 2)), ((3, 1),))
#: Standard deviation of curvatures until it is estimated, pixels of parallax.
_LOOSE = 0.5
#: A view that has fewer pixels of a block is left out.
_FEW = 16
#: How far a surface may move on a level: grey facets, and on the coarsest level part of the flying height, or as far as
#: it keeps to, if that is known.
_ROOM, _FAR = 16.0, 0.15
#: Distance of the heights that are tried on the coarsest level, pixels of parallax, and how many up and down at most.
_TRIAL, _MOST_TRIALS = 0.5, 24
#: The multiple of its reach that the surface keeps to.
_BEYOND = 1.5
#: Part of the misfit of the start below which another height is taken: without texture none fits better than others.
_BETTER = 0.8
#: Part of the posts that a search must be sure of, so that they tell the noise of all.
_TRUSTED = 0.1
#: Posts around those at a step that do not tell it either.
_BESIDE = 5
#: The multiple of the usual misfit above which a post does not, either.
_MISFIT = 2.0
#: Standard deviation of grey values until it is estimated, part of their contrast.
_NOISE = 0.1
#: What a search costs, part of all; and of a level what is done when it is opened, adjusted, adjusted again after each
#: estimate of roughness.
_SEARCHED, _OPENED, _ADJUSTED, _AGAIN = 0.4, 0.1, 0.35, ((0.5, 0.7), (0.8, 0.85))


@dataclass(frozen=True)
class Scheme:
    """How fine facets and images are."""

    ratio: int
    """Grey facets along a side of a height facet."""
    coarsest: int
    """Level on which the reconstruction begins."""
    base: int = 0
    """Level of the image pyramids that the finest facets use: images that are much finer than these."""
    reach: float = 0.0
    """How far the start may be wrong, metres: what the coarsest level does not pull in is tried there."""
    coarse: bool = False
    """Whether grey facets of few images are coarser than pixels, or hardly finer."""
    search: Search | None = None
    """How heights are searched within the reach with which the coarsest level then begins; None: they are not."""


@dataclass(frozen=True, eq=False)
class Found:
    """A window of the surface."""

    heights: Floats32
    """Shape (rows, columns), metres; NaN where fewer than two images see it."""
    sigmas: Floats32
    """Standard deviations, metres; NaN where there is no height."""
    count: NDArray[np.uint8]
    """Images that see the facets around a post."""
    fit: Floats32
    """Root mean square of the standardised residuals around a post, or of the differences between the images that agree
    best there if that is less; 1 is expected, NaN where there is no height."""
    grey: Floats32
    """Grey values, `ratio` times as fine; NaN where no image sees it."""
    grey_sigmas: Floats32
    """Their standard deviations; NaN where there is no grey value."""
    residuals: Floats32 | None
    """Standardised residuals of every view where the grey values are, shape (views, m · rows, m · columns), NaN without
    a pixel; None: not wanted."""
    astray: int
    """Posts without a height since it went as far from the start as it may."""
    sums: Floats
    """Of every view: Σ of squared residuals in its own grey values, and redundancy; shape (n, 2)."""
    noise: Floats
    """Of every view: the noise of its pixels by themselves, squared, and their mean grey value, both times the pixels,
    and the pixels; shape (n, 3)."""
    moves: tuple[float, ...]
    """Mean last correction of the heights on each level, the finest first, pixels of parallax; 0: nothing was seen."""


def reconstruct(
    views: Sequence[View],
    grid: MapGrid,
    window: Window,
    scheme: Scheme,
    start: Callable[[Floats], Floats],
    residuals: bool = False,
) -> Found | None:
    """Heights and grey values of a window of a map.

    Parameters
    ----------
    views : sequence of View
    grid : MapGrid
        Its pixels are the height posts.
    window : Window
        Of its pixels.
    scheme : Scheme
    start : callable
        Heights of map points (..., 2) with which the coarsest level begins, metres; NaN: unknown.
    residuals : bool
        Whether residuals of every view are wanted.

    Returns
    -------
    Found or None
        None: fewer than two images see any of it, or the start knows no height here.
    """
    block: FacetBlock | None = None
    found: Searched | None = None
    reach, stated = scheme.reach, start
    if scheme.search is not None:
        with stretch(0.0, _SEARCHED, "search"):
            found = search(views, grid, window, scheme.search, start, scheme.reach)
        if found is None:
            return None
        start, reach = found, scheme.search.room
    moves = [0.0] * (scheme.coarsest + 1)
    for level in range(scheme.coarsest, -1, -1):
        facets = facets_of(grid, window, level, scheme.ratio)
        heights = _start_heights(start, facets) if block is None else _finer(block, facets, start)
        if heights is None:
            return None
        with _part(scheme, window, level, 0.0, _OPENED):
            block = _opened(views, level + scheme.base, facets, heights, block, reach) or block
        if block is None or block.facets is not facets:
            continue
        block.limits, block.reach = _limits(start, facets, reach), reach
        block.coarse = scheme.coarse and level == 0
        if level == scheme.coarsest:
            if found is None:
                block.heights = _lifted(block, reach)
            else:
                block.roughness = block.roughness.around(block.heights)
                block.trusted = found.sure if found.sure.mean() > _TRUSTED else None
        with _part(scheme, window, level, _OPENED, _ADJUSTED):
            block.adjust(_FIRST[level < scheme.coarsest], True)
        for k, (estimates, iterations) in enumerate(_THEN[level > 0]):
            if level == 0:
                block.trusted = _telling(block, found)
            block.roughen(estimates)
            # Not before the noise has settled, nor where heights are still on their way, which looks like noise.
            with _part(scheme, window, level, *_AGAIN[k]):
                block.adjust(iterations, level == 0, texture=level == k == 0)
        moves[level] = block.moves[-1]
    if block is None or block.facets.pitch != grid.resolution:
        return None
    return _found(block, views, window, scheme, stated, found, tuple(moves), residuals)


def _part(scheme: Scheme, window: Window, level: int, *ends: float) -> AbstractContextManager[None]:
    """What is told inside is of a level, from one part of it to another."""
    first = 0.0 if scheme.search is None else _SEARCHED
    begin, end = (first + (1 - first) * levels_done(window, scheme.coarsest, level, part) for part in ends)
    return stretch(begin, end, f"level {scheme.coarsest - level + 1} of {scheme.coarsest + 1}")


def _telling(block: FacetBlock, found: Searched | None) -> Mask | None:
    """Posts that tell noise and roughness of a block: not those beside steps, where pixels fit far worse than they
    usually do, nor where a search is not sure.

    None: all, also where those that would are too few.
    """
    misfit = np.nan_to_num(fit(block))
    told = ~ndimage.maximum_filter(edge_variances(block) > 0, _BESIDE)
    told &= misfit <= _MISFIT * np.median(misfit[misfit > 0])
    if found is not None:
        told &= found.sure
    return told if _TRUSTED < told.mean() < 1 else None


def _opened(
    views: Sequence[View], level: int, facets: Facets, heights: Floats, before: FacetBlock | None, reach: float
) -> FacetBlock | None:
    """A block at the start of a level; None if fewer than two views see it."""
    span, relief = (float(heights.min()), float(heights.max())), Relief.of(heights)
    sights: list[Sight] = []
    own: list[View] = []
    for view in views:
        room = _room(view, facets, span, before, reach)
        sight = look(view, level, facets, (span[0] - room, span[1] + room))
        if sight is None:
            continue
        sight = sight.onto(relief)
        if np.count_nonzero(np.isfinite(sight.places[..., 0]) & np.isfinite(sight.raw)) >= _FEW:
            sights.append(sight)
            own.append(view)
    if len(sights) < 2:
        return None
    transfers, sigmas = _radiometry(own, sights, facets, before)
    block = FacetBlock(
        facets=facets,
        sights=sights,
        transfers=transfers,
        heights=heights,
        roughness=Roughness.uniform(facets.shape, 1.0),
        sigmas=sigmas,
    )
    block.views, block.scale = own, block.parallax()
    # Loose until it is estimated: from a stiff start, what does not fit would be taken for noise. Curvatures over twice
    # the distance are larger than those to be estimated.
    block.roughness = (
        Roughness.uniform(facets.shape, _LOOSE / block.scale)
        if before is None
        else before.roughness.on(before.facets, facets)
    )
    return block


def _lifted(block: FacetBlock, reach: float) -> Floats:
    """The start, lifted or lowered as a whole by what fits best within its reach."""
    pixel = 1.0 / block.scale
    count = min(_MOST_TRIALS, int(np.ceil(reach / (_TRIAL * pixel) - 0.5)))
    trials = sorted(range(-count, count + 1), key=abs)
    if len(trials) == 1:
        return block.heights
    lifted = [block.heights + k * _TRIAL * pixel for k in trials]
    misfits = [block.misfit(heights) for heights in lifted]
    best = int(np.argmin(misfits))
    return lifted[best if misfits[best] < _BETTER * misfits[0] else 0]


def _room(view: View, facets: Facets, span: tuple[float, float], before: FacetBlock | None, reach: float) -> float:
    """How far the surface may still move on a level, metres."""
    distance = abs(float(view.camera.vantage.point[2]) - sum(span) / 2)
    far = min(_FAR * distance, _BEYOND * reach) if reach > 0 else _FAR * distance
    return _ROOM * facets.pitch / facets.ratio + (far if before is None else 0.0)


def _radiometry(
    views: Sequence[View], sights: Sequence[Sight], facets: Facets, before: FacetBlock | None
) -> tuple[list[Transfer], Floats]:
    """Transfer parameters and noise of the level before; of views that it did not have, guesses."""
    guesses = first_guess(sights, facets)
    contrast = max(float(np.nanstd(np.concatenate([s.raw.reshape(-1) for s in sights]))), 1e-3)
    sigmas = np.full(len(sights), _NOISE * contrast)
    known = {} if before is None else {id(view): n for n, view in enumerate(before.views)}
    for k, view in enumerate(views):
        if before is not None and id(view) in known:
            guesses[k] = before.transfers[known[id(view)]].on(facets)
            sigmas[k] = before.sigmas[known[id(view)]]
    return guesses, sigmas


def _start_heights(start: Callable[[Floats], Floats], facets: Facets) -> Floats | None:
    """Heights of the start at the posts; where it has none, their mean; None if it has none at all."""
    found = np.asarray(start(facets.posts), float)
    known = np.isfinite(found)
    return np.where(known, found, found[known].mean()) if known.any() else None


def _limits(start: Callable[[Floats], Floats], facets: Facets, reach: float) -> tuple[Floats | float, Floats | float]:
    """What the surface keeps to around a start that is wrong by `reach` at most; no limits if nobody says so."""
    if not reach > 0:
        return -np.inf, np.inf
    begun, room = np.asarray(start(facets.posts), float), _BEYOND * reach
    return np.nan_to_num(begun - room, nan=-np.inf), np.nan_to_num(begun + room, nan=np.inf)


def _finer(block: FacetBlock, facets: Facets, start: Callable[[Floats], Floats]) -> Floats:
    """Heights of the level before at the posts of finer facets, bilinear, with what the start has between its posts;
    beyond the border those of the border.

    So relief that coarse facets cannot follow is not lost by them.
    """
    coarse, fine = (np.asarray(start(f.posts), float) for f in (block.facets, facets))
    detail = fine - block.facets.sampled(coarse, facets.posts)
    return block.facets.sampled(block.heights, facets.posts) + np.nan_to_num(detail)


def _found(
    block: FacetBlock,
    views: Sequence[View],
    window: Window,
    scheme: Scheme,
    start: Callable[[Floats], Floats],
    searched: Searched | None,
    moves: tuple[float, ...],
    residuals: bool = False,
) -> Found:
    """What a block holds of its window."""
    variance, misfit, counted = block.variances(), fit(block), block.counted
    ratio = block.facets.ratio
    inner = slice(MARGIN, MARGIN + window.height), slice(MARGIN, MARGIN + window.width)
    begun = np.asarray(start(block.facets.posts), float)
    low, high = (np.where(np.isfinite(begun), begun, block.heights) + side * scheme.reach for side in (-1, 1))
    agreed = evidence(block, scheme.base, low, high, inner, misfit)
    if agreed is None:
        doubt = edge_variances(block) + misfit_variances(block, misfit)
        if searched is not None:
            assert scheme.search is not None
            away = scheme.search.planes.away(block.heights, searched.heights)
            doubt += searched.variance + np.where(searched.sure, away, 0.0) ** 2
    else:
        doubt = agreed.variance + (0.0 if searched is None else (1.0 - agreed.probability) * searched.variance)
        misfit = agreed.fit
        counted = np.minimum(counted, agreed.count)
    # What one image alone sees has no height, and grey values no place.
    seen = counted[inner] > 1
    astray = block.astray[inner] & seen
    count = np.where(astray, np.uint8(1), counted[inner])
    place = [next(n for n, view in enumerate(views) if view is own) for own in block.views]
    sums, noise = np.zeros((len(views), 2)), np.zeros((len(views), 3))
    sums[place] = block.sums
    for n, sight in zip(place, block.sights):
        pixels = float(np.isfinite(sight.raw).sum())
        noise[n] = np.array([pixel_noise(sight.raw) ** 2, float(np.nanmean(sight.raw)), 1.0]) * pixels
    at = grey_places(block, window, MARGIN)

    def finer(values: NDArray[Any]) -> NDArray[Any]:
        return np.repeat(np.repeat(values, ratio, axis=0), ratio, axis=1)

    pictures = None
    if residuals:
        fine = (
            slice(ratio * MARGIN, ratio * (MARGIN + window.height)),
            slice(ratio * MARGIN, ratio * (MARGIN + window.width)),
        )
        pictures = np.full((len(views), *at.shape[:2]), np.nan, np.float32)
        for n, picture in zip(place, residual_pictures(block)):
            pictures[n] = picture[fine]
    return Found(
        heights=_where(count > 1, block.heights[inner]),
        sigmas=_where(count > 1, np.sqrt(np.maximum(variance[inner], 0.0) + doubt[inner])),
        count=count,
        fit=_where(count > 1, misfit[inner]),
        grey=_where(finer(seen), block.grey_values(at.reshape(-1, 2)).reshape(at.shape[:2])),
        grey_sigmas=_where(finer(seen), grey_sigmas(block, at, finer(np.nan_to_num(variance[inner])))),
        residuals=pictures,
        astray=int(astray.sum()),
        sums=sums,
        noise=noise,
        moves=moves,
    )


def _where(known: Mask, values: NDArray[Any]) -> Floats32:
    """Values where they are known, NaN elsewhere."""
    return np.where(known, values, np.nan).astype(np.float32)

"""Refinement of matches, and loops that measure its accuracy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from photoplan.adjustment.least_squares import MEDIAN_2D
from photoplan.arrays import Floats, Ints, Mask
from photoplan.codec import storable
from photoplan.events import Map
from photoplan.kernels.matching import CONVERGED, CORRELATION, RESULTS, match_patches, spline_coefficients
from photoplan.matching.features import Grey, Tracks, patches_at

#: Neighbours whose features tell how two images are turned and scaled against each other at a place.
_NEIGHBOURS = 15
#: Patches that are matched at once.
_CHUNK = 500
#: A reference may be so much coarser than the finest image of its track.
_NEARLY_FINEST = 0.8

#: The mapping of a patch may change by this while it is matched, against the one it starts from: else it is another's.
_BENT = 0.5


@dataclass(frozen=True)
class RefineSettings:
    """How patches are matched and which results count."""

    radius: int = 10
    """Of the round patch in the reference image, pixels."""
    search: float = 4.0
    """How far from its feature a point may be found, pixels."""
    correlation: float = 0.8
    """Least correlation of the patches after matching."""
    sigma: float = 0.2
    """Largest standard deviation of a coordinate, pixels."""
    settled: float = 1e-3
    """Displacement below which the iteration ends, pixels."""
    iterations: int = 30


@storable
@dataclass(frozen=True, eq=False)
class Matched:
    """Results of matching n patches between two images."""

    xy: Floats
    """Column and row in the second image, (n, 2); NaN where the patch was not found."""
    affine: Floats
    """From offsets in the first to offsets in the second image, (n, 2, 2)."""
    correlation: Floats
    """(n,)."""
    covariance: Floats
    """Of `xy` as the fit has it, (n, 2, 2), square pixels."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Refined tracks and what became of the others."""

    tracks: Tracks
    unsettled: int
    """Image points whose patch was not found (no texture, no convergence, at the image's edge)."""
    unlike: int
    """Image points left out for their correlation."""
    uncertain: int
    """Image points left out for their standard deviation."""
    correlation: float
    """Median of the correlations of those that are kept."""


@dataclass(frozen=True, eq=False)
class _Pair:
    """Points that a reference image has in common with another."""

    a: int
    b: int
    first: Ints
    """Rows of the points in the one, (n,)."""
    second: Ints


def disc(radius: int) -> Floats:
    """Weights of a round patch, shape (2 radius + 1, 2 radius + 1)."""
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return (u * u + v * v <= (radius + 0.5) ** 2).astype(float)


def match_between(
    images: tuple[Grey, Grey],
    at: Ints,
    start: tuple[Floats, Floats],
    settings: RefineSettings,
    weights: Floats | None = None,
) -> Matched:
    """Match patches round whole pixels of the first image in the second image.

    Parameters
    ----------
    images : pair of Grey
    at : ndarray, shape (n, 2)
        Column and row in the first image.
    start : pair of ndarrays
        Approximate position in the second image (n, 2), and affine from the first to the second image (n, 2, 2).
    weights : ndarray, shape (n, m, m), optional
        Of the template's pixels; the whole disc if it is None.
    """
    n, m = len(at), 2 * settings.radius + 1
    results = np.full((n, RESULTS), np.nan)
    round_patch = disc(settings.radius)
    limits = np.array([settings.iterations, settings.settled, settings.search])
    order = np.lexsort((start[0][:, 0], start[0][:, 1] // 256)) if n else np.empty(0, int)
    for chunk in (order[k : k + _CHUNK] for k in range(0, n, _CHUNK)):
        templates = patches_at(images[0], at[chunk] - settings.radius, m).astype(float)
        whole = np.isfinite(templates[:, round_patch > 0]).all(axis=1)
        reach = float(np.linalg.norm(start[1][chunk], axis=(1, 2), ord=2).max()) * settings.radius + settings.search
        half = int(np.ceil(reach)) + 4
        middle = np.rint(start[0][chunk]).astype(np.int64)
        windows = patches_at(images[1], middle - half, 2 * half + 1).astype(float)
        known = np.isfinite(windows)
        mean = np.nanmean(np.where(known.any(axis=(1, 2))[:, None, None], windows, 0.0), axis=(1, 2))
        windows = np.where(known, windows, mean[:, None, None])
        spline_coefficients(windows)
        found = np.zeros((len(chunk), RESULTS))
        found[:, :2] = start[0][chunk] - middle + half
        found[:, 2:6] = start[1][chunk].reshape(-1, 4)
        w = np.broadcast_to(round_patch, templates.shape) if weights is None else weights[chunk]
        match_patches(np.nan_to_num(templates), np.ascontiguousarray(w), windows, limits, found)
        good = (found[:, -1] == CONVERGED) & whole & _on_known(known, found, settings.radius)
        good &= _near(found[:, 2:6].reshape(-1, 2, 2), start[1][chunk])
        found[:, :2] += middle - half
        results[chunk[good]] = found[good]
    return Matched(
        results[:, :2],
        results[:, 2:6].reshape(-1, 2, 2),
        results[:, CORRELATION],
        results[:, [9, 10, 10, 11]].reshape(-1, 2, 2),
    )


def _near(affine: Floats, start: Floats) -> Mask:
    """Whether mappings are still like those that they started from."""
    change = np.linalg.inv(start) @ np.nan_to_num(affine, nan=9.0) - np.eye(2)
    return np.asarray(np.linalg.norm(change, axis=(1, 2), ord=2) < _BENT, np.bool_)


def _on_known(known: Mask, found: Floats, radius: int) -> Mask:
    """Whether the middle and the rim of the matched patches lie on pixels that have a value."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = (radius + 2) * np.stack([np.cos(turn), np.sin(turn)])
    at = found[:, :2, None] + found[:, 2:6].reshape(-1, 2, 2) @ np.concatenate([rim, rim / 2, np.zeros((2, 1))], axis=1)
    side = known.shape[1]
    whole = np.rint(np.nan_to_num(at, nan=-1.0)).astype(np.int64)
    inside = ((whole >= 0) & (whole < side)).all(axis=1)
    col, row = np.clip(whole, 0, side - 1).transpose(1, 0, 2)
    return (inside & known[np.arange(len(found))[:, None], row, col]).all(axis=1)


def reference_points(tracks: Tracks, sizes: Sequence[tuple[int, int]]) -> Ints:
    """Row of the reference point of each track: of the images in which it is seen finest, the most central one.

    A feature's scale in pixels is larger in an image of finer resolution.
    """
    size = np.array(sizes, float).reshape(-1, 2)[tracks.image]
    off = np.linalg.norm((tracks.xy - (size - 1) / 2) / size, axis=1)
    finest = np.zeros(tracks.count)
    np.maximum.at(finest, tracks.track, tracks.scale)
    coarse = tracks.scale < _NEARLY_FINEST * finest[tracks.track]
    order = np.lexsort((off, coarse, tracks.track))
    return order[np.searchsorted(tracks.track[order], np.arange(tracks.count))]


def local_affines(tracks: Tracks, first: Ints, second: Ints) -> Floats:
    """How the second image is turned and scaled against the first one at points of both, shape (n, 2, 2).

    A single feature's direction and scale are rough; medians over the neighbours are taken.
    """
    turn = tracks.angle[second] - tracks.angle[first]
    ratio = np.log(tracks.scale[second] / tracks.scale[first])
    k = min(_NEIGHBOURS, len(first))
    _, near = cKDTree(tracks.xy[first]).query(tracks.xy[first], k=k)
    near = near.reshape(len(first), k)
    # Medians of angles: about the direction where most of them are.
    mean = np.angle(np.exp(1j * turn)[near].mean(axis=1))
    turn = mean + np.median(np.angle(np.exp(1j * (turn[near] - mean[:, None]))), axis=1)
    scale = np.exp(np.median(ratio[near], axis=1))
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def refine_tracks(
    tracks: Tracks, images: Sequence[Grey], settings: RefineSettings, factor: float = 1.0, run: Map = map
) -> Refined:
    """Match all points of every track against its reference.

    The reference point becomes the whole pixel nearest to its feature. Half of the variance of a matched position is
    the reference's: both images have noise. A track's reference gets the mean of these halves.

    Parameters
    ----------
    images : sequence of Grey
    factor : float
        Standard deviations of the fit are multiplied by this, see `photoplan.matching.refine`.
    run : callable
        Does the work image by image, as `map` does: it may use threads.
    """
    reference = reference_points(tracks, [g.size for g in images])
    pairs = list(_image_pairs(tracks, reference))

    def work(pair: _Pair) -> Matched:
        at = np.rint(tracks.xy[pair.first]).astype(np.int64)
        affine = local_affines(tracks, pair.first, pair.second)
        near = tracks.xy[pair.second] + np.einsum("nij,nj->ni", affine, at - tracks.xy[pair.first])
        return match_between((images[pair.a], images[pair.b]), at, (near, affine), settings)

    xy = tracks.xy.copy()
    xy[reference] = np.rint(xy[reference])
    variance = np.full((len(tracks), 2), np.nan)
    correlation = np.full(len(tracks), np.nan)
    for pair, found in zip(pairs, run(work, pairs)):
        xy[pair.second], correlation[pair.second] = found.xy, found.correlation
        variance[pair.second] = found.covariance[:, [0, 1], [0, 1]] / 2 * factor**2
    return _accepted(tracks, reference, xy, variance, correlation, settings)


def _image_pairs(tracks: Tracks, reference: Ints) -> Iterator[_Pair]:
    other = np.setdiff1d(np.arange(len(tracks)), reference)
    first = reference[tracks.track[other]]
    key = np.stack([tracks.image[first], tracks.image[other]], axis=1)
    pairs, which = np.unique(key, axis=0, return_inverse=True)
    which = which.reshape(-1)
    for k, (a, b) in enumerate(pairs):
        rows = which == k
        yield _Pair(int(a), int(b), first[rows], other[rows])


def _accepted(
    tracks: Tracks, reference: Ints, xy: Floats, variance: Floats, correlation: Floats, settings: RefineSettings
) -> Refined:
    is_reference = np.zeros(len(tracks), bool)
    is_reference[reference] = True
    settled = np.isfinite(correlation)
    alike = settled & (correlation >= settings.correlation)
    sure = alike & (variance.max(axis=1) <= settings.sigma**2)
    count = np.bincount(tracks.track[sure], minlength=tracks.count)
    for k in range(2):
        total = np.bincount(tracks.track[sure], variance[sure, k], minlength=tracks.count)
        variance[reference, k] = total / np.maximum(count, 1)
    keep = sure | (is_reference & (count > 0)[tracks.track])
    sigma = np.sqrt(np.where(keep[:, None], variance, np.nan))
    refined = Tracks(track=tracks.track, image=tracks.image, xy=xy, scale=tracks.scale, angle=tracks.angle, sigma=sigma)
    others = ~is_reference
    return Refined(
        tracks=refined.where(keep),
        unsettled=int((others & ~settled).sum()),
        unlike=int((settled & ~alike).sum()),
        uncertain=int((alike & ~sure).sum()),
        correlation=float(np.median(correlation[sure])) if sure.any() else float("nan"),
    )


#: Side of the squares that are dealt out, pixels. Noise of neighbouring pixels is alike: with squares of 4 pixels, a
#: third of the effect of grain two pixels wide was missed, with 6 a seventh; larger ones leave too few for a patch.
SQUARE = 6
#: The patch of the loops is larger than that of refinement by this: a third of it is used at a time.
WIDER = 1.5
#: Fewer loops than this tell nothing.
LEAST = 30
#: Tracks that are tried.
_MOST = 600
#: Factor where there are too few loops: a third ray is missing, or texture.
ASSUMED = 3.0
#: Median of the squared length of a two-dimensional normal vector of unit variance.
_MEDIAN = MEDIAN_2D**2


@dataclass(frozen=True)
class Loops:
    """What the loops say."""

    factor: float
    """By which standard deviations of the fit are to be multiplied; never below 1."""
    count: int
    """Loops that could be closed."""

    @property
    def measured(self) -> bool:
        """Whether the factor comes from loops at all."""
        return self.count >= LEAST


def latin_weights(radius: int, affine: Floats, part: int) -> Floats:
    """Weights of the pixels that belong to one of the three parts of a patch."""
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(float)
    there = np.einsum("nij,jrc->nirc", affine, np.stack([u, v]))
    square = np.floor(there / SQUARE + 0.5).astype(np.int64)
    own = (square[:, 0] + square[:, 1]) % 3 == part
    return own * disc(radius)


def close_loops(
    tracks: Tracks, reference: Ints, images: Sequence[Grey], settings: RefineSettings, run: Map = map
) -> Loops:
    """Measure the factor on some of the tracks with three rays or more.

    The factor is the root of the median of the squared closures, each divided by its covariance as the three fits have
    it, against what the normal distribution has.
    """
    start = np.concatenate([[0], np.cumsum(tracks.rays)])
    rows = []
    long = np.flatnonzero(tracks.rays >= 3)
    for t in long[np.linspace(0, len(long) - 1, min(_MOST, len(long))).astype(int)] if len(long) else long:
        a = int(reference[t])
        b, c = [k for k in range(start[t], start[t + 1]) if k != a][:2]
        rows.append((a, b, c))
    if len(rows) < LEAST:
        return Loops(ASSUMED, len(rows))
    table = np.array(rows)
    triples, which = np.unique(tracks.image[table], axis=0, return_inverse=True)
    tasks = [(tuple(int(i) for i in t), table[which.reshape(-1) == k]) for k, t in enumerate(triples)]
    wide = replace(settings, radius=round(settings.radius * WIDER))
    found = list(run(lambda task: _close(tracks, [images[i] for i in task[0]], task[1], wide), tasks))
    gap = np.concatenate([f[0] for f in found])
    covariance = np.concatenate([f[1] for f in found])
    good = np.isfinite(gap).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    if good.sum() < LEAST:
        return Loops(ASSUMED, int(good.sum()))
    gap, covariance = gap[good], covariance[good]
    square = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(covariance), gap)
    factor = float(np.sqrt(np.median(square) / _MEDIAN))
    return Loops(max(1.0, factor), int(good.sum()))


def _close(tracks: Tracks, images: Sequence[Grey], rows: Ints, settings: RefineSettings) -> tuple[Floats, Floats]:
    """Closures (n, 2) and their covariances (n, 2, 2) in the first image; NaN where a step failed."""
    a, b, c = rows.T
    begin = np.rint(tracks.xy[a])
    at, to_first = begin.copy(), np.broadcast_to(np.eye(2), (len(a), 2, 2))
    covariance = np.zeros((len(a), 2, 2))
    for part, (here, there) in enumerate(((a, b), (b, c), (c, a))):
        pair = images[part], images[(part + 1) % 3]
        at, to_first, covariance = _step(tracks, pair, (here, there), (at, to_first, covariance), settings, part)
    return at - begin, covariance


def _step(
    tracks: Tracks,
    pair: tuple[Grey, Grey],
    rows: tuple[Ints, Ints],
    state: tuple[Floats, Floats, Floats],
    settings: RefineSettings,
    part: int,
) -> tuple[Floats, Floats, Floats]:
    """Position, affine to the loop's first image and covariance, carried into the next image."""
    at, to_first, covariance = state
    first, second = rows
    affine = local_affines(tracks, first, second)
    known: Mask = np.asarray(np.isfinite(at).all(axis=1), np.bool_)
    whole = np.rint(np.where(known[:, None], at, 0.0)).astype(np.int64)
    near = tracks.xy[second] + np.einsum("nij,nj->ni", affine, whole - tracks.xy[first])
    weights = latin_weights(settings.radius, np.where(known[:, None, None], to_first, np.eye(2)), part)
    found = match_between(pair, whole, (near, affine), settings, weights)
    found = _liked(found, known, settings)
    # The patch lies at a whole pixel: from there to the point it is less than one.
    position = found.xy + np.einsum("nij,nj->ni", found.affine, at - whole)
    carried = found.affine @ covariance @ found.affine.transpose(0, 2, 1) + found.covariance
    with np.errstate(invalid="ignore"):
        determinant = np.linalg.det(found.affine)
    back = np.full_like(found.affine, np.nan)
    usable = np.isfinite(determinant) & (np.abs(determinant) > 0.05)
    back[usable] = np.linalg.inv(found.affine[usable])
    return position, to_first @ back, carried


def _liked(found: Matched, known: Mask, settings: RefineSettings) -> Matched:
    """Without the results that refinement would not take."""
    bad = ~(known & (found.correlation >= settings.correlation))
    xy, affine, covariance = found.xy.copy(), found.affine.copy(), found.covariance.copy()
    xy[bad], affine[bad], covariance[bad] = np.nan, np.nan, np.nan
    return Matched(xy, affine, found.correlation, covariance)

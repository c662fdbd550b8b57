"""How much larger the errors of matching are than its fit says: loops through three images that should close.

A patch is matched from image A to B, from there to C, and back to A. What is missing to the start is the sum of three
errors. If all three used the same pixels, the noise of each image would enter twice with opposite signs and cancel: the
loop would close whatever the noise. So every step uses pixels of its own: the patch is cut into small squares which are
dealt out to the three steps like the symbols of a Latin square, so that each has its share of every part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.robust import MEDIAN_2D
from photoplan.events import Map
from photoplan.matching.grey import Grey
from photoplan.matching.refine import Matched, RefineSettings, disc, local_affines, match_between
from photoplan.matching.tracks import Tracks

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


def latin_weights(radius: int, affine: NDArray[np.float64], part: int) -> NDArray[np.float64]:
    """Weights of the pixels that belong to one of the three parts of a patch."""
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(float)
    there = np.einsum("nij,jrc->nirc", affine, np.stack([u, v]))
    square = np.floor(there / SQUARE + 0.5).astype(np.int64)
    own = (square[:, 0] + square[:, 1]) % 3 == part
    return own * disc(radius)


def close_loops(
    tracks: Tracks, reference: NDArray[np.int64], images: Sequence[Grey], settings: RefineSettings, run: Map = map
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


def _close(
    tracks: Tracks, images: Sequence[Grey], rows: NDArray[np.int64], settings: RefineSettings
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
    rows: tuple[NDArray[np.int64], NDArray[np.int64]],
    state: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    settings: RefineSettings,
    part: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Position, affine to the loop's first image and covariance, carried into the next image."""
    at, to_first, covariance = state
    first, second = rows
    affine = local_affines(tracks, first, second)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(at).all(axis=1), np.bool_)
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


def _liked(found: Matched, known: NDArray[np.bool_], settings: RefineSettings) -> Matched:
    """Without the results that refinement would not take."""
    bad = ~(known & (found.correlation >= settings.correlation))
    xy, affine, covariance = found.xy.copy(), found.affine.copy(), found.covariance.copy()
    xy[bad], affine[bad], covariance[bad] = np.nan, np.nan, np.nan
    return Matched(xy, affine, found.correlation, covariance)

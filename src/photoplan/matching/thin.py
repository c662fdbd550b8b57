"""Fewer tie points: those that many images share, spread evenly over every image and every overlap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from photoplan.matching.tracks import Tracks

#: Cells along each side of an image.
CELLS = 5
#: Tracks that every sixth of an overlap (its von Gruber positions) keeps, where it has so many.
GRUBER = 3


def thin_tracks(tracks: Tracks, sizes: Sequence[tuple[int, int]], per_image: int) -> NDArray[np.bool_]:
    """Tracks to keep.

    Long tracks come first, of equally long ones those with the smaller standard deviation (or the finer feature). A
    track is kept if at least half of its images have room for it in the cell where it lies. Then each overlap of two
    images is looked at in two by three parts, and those that hold fewer than `GRUBER` tracks get what they can.

    Parameters
    ----------
    tracks : Tracks
    sizes : sequence of (int, int)
        Width and height of each image.
    per_image : int
        Points that an image is to have: an equal share for each of 5 × 5 cells.

    Returns
    -------
    ndarray, shape (tracks.count,)
    """
    room = int(np.ceil(per_image / CELLS**2))
    cell = _cells(tracks, sizes)
    start = np.concatenate([[0], np.cumsum(tracks.rays)])
    filled = np.zeros((len(sizes), CELLS**2), int)
    keep = np.zeros(tracks.count, bool)
    order = _order(tracks)
    for t in order:
        part = slice(start[t], start[t + 1])
        image, where = tracks.image[part], cell[part]
        if 2 * (filled[image, where] < room).sum() >= len(image):
            filled[image, where] += 1
            keep[t] = True
    _fill_overlaps(tracks, start, order, keep)
    return keep


def _cells(tracks: Tracks, sizes: Sequence[tuple[int, int]]) -> NDArray[np.int64]:
    part = (tracks.xy + 0.5) / np.array(sizes, float).reshape(-1, 2)[tracks.image] * CELLS
    return np.clip(part.astype(np.int64), 0, CELLS - 1) @ np.array([1, CELLS])


def _order(tracks: Tracks) -> NDArray[np.int64]:
    """Tracks from the best to the worst."""
    worst = np.zeros(tracks.count)
    quality = np.where(np.isfinite(tracks.sigma[:, 0]), tracks.sigma.max(axis=1), tracks.scale)
    np.maximum.at(worst, tracks.track, quality)
    return np.lexsort((np.arange(tracks.count), worst, -tracks.rays))


def _fill_overlaps(tracks: Tracks, start: NDArray[np.int64], order: NDArray[np.int64], keep: NDArray[np.bool_]) -> None:
    """Keep further tracks where a part of an overlap holds too few; `keep` is changed."""
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    members: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for t in range(tracks.count):
        rows = range(start[t], start[t + 1])
        for a in rows:
            for b in rows:
                if tracks.image[a] < tracks.image[b]:
                    members.setdefault((int(tracks.image[a]), int(tracks.image[b])), []).append((t, a))
    for found in members.values():
        t, row = np.array(found).T
        xy = tracks.xy[row]
        low, high = xy.min(axis=0), xy.max(axis=0)
        long = int(np.argmax(high - low))
        counts = np.where(np.arange(2) == long, 3, 2)
        part = np.clip(((xy - low) / np.maximum(high - low, 1.0) * counts).astype(int), 0, counts - 1) @ (1, counts[0])
        for p in range(6):
            here = t[part == p]
            missing = GRUBER - int(keep[here].sum())
            if missing > 0:
                spare = here[~keep[here]]
                keep[spare[np.argsort(rank[spare])[:missing]]] = True

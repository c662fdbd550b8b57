"""Points that several images have in common, from the verified matches of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from photoplan.matching.features import Features
from photoplan.matching.verify import PairMatches

#: Features of one image closer than this are one point (pixels of the full image, at full scale).
SAME_PLACE = 1.5


@dataclass(frozen=True, eq=False)
class Tracks:
    """Image points and the track that each belongs to; a track has one point in an image."""

    track: NDArray[np.int64]
    """Track of each image point, (n,); numbers from 0 without gaps, points of one track side by side."""
    image: NDArray[np.int64]
    """Index of its image, (n,)."""
    xy: NDArray[np.float64]
    """Column and row, (n, 2), pixels."""
    scale: NDArray[np.float64]
    """Scale of the feature, (n,), pixels."""
    angle: NDArray[np.float64]
    """Direction of the feature, (n,), radians from column towards row axis."""
    sigma: NDArray[np.float64]
    """Standard deviation of column and row, (n, 2), pixels; NaN: not known."""

    def __len__(self) -> int:
        return len(self.track)

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    @property
    def rays(self) -> NDArray[np.int64]:
        """Image points of each track."""
        return np.bincount(self.track, minlength=self.count)

    def where(self, keep: NDArray[Any]) -> Tracks:
        """The points at `keep` (mask); tracks with fewer than two points left are dropped."""
        keep = np.asarray(keep, bool)
        left = np.bincount(self.track[keep], minlength=self.count)
        keep = keep & (left >= 2)[self.track]
        _, track = np.unique(self.track[keep], return_inverse=True)
        rest = (getattr(self, n)[keep] for n in ("image", "xy", "scale", "angle", "sigma"))
        return Tracks(track.reshape(-1).astype(np.int64), *rest)

    def of_tracks(self, keep: NDArray[np.bool_]) -> Tracks:
        """The tracks where `keep` (one per track) is true."""
        return self.where(keep[self.track])


@dataclass(frozen=True, eq=False)
class TracksFound:
    """Tracks, and how many were not taken."""

    tracks: Tracks
    ambiguous: int
    """Tracks that had points at two places of one image: dropped as a whole."""


def build_tracks(features: Sequence[Features], pairs: Sequence[PairMatches], same: float = SAME_PLACE) -> TracksFound:
    """Join matches that share a feature.

    Parameters
    ----------
    features : sequence of Features
        Of each image.
    pairs : sequence of PairMatches
        Verified matches.
    same : float
        Features of one image that are closer than this are the same point: a place with several directions.
    """
    start = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(np.int64)
    total = int(start[-1])
    none = np.empty(0, np.int64)
    a = np.concatenate([none, *(start[p.first] + p.features[:, 0] for p in pairs)])
    b = np.concatenate([none, *(start[p.second] + p.features[:, 1] for p in pairs)])
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    used = np.zeros(total, bool)
    used[a] = used[b] = True
    index = np.flatnonzero(used)
    image = np.repeat(np.arange(len(features)), np.diff(start))[index]
    xy = np.concatenate([np.empty((0, 2)), *(f.xy for f in features)])[index]
    scale = np.concatenate([np.empty(0), *(f.scale for f in features)])[index]
    angle = np.concatenate([np.empty(0), *(f.angle for f in features)])[index]
    _, track = np.unique(label[index], return_inverse=True)
    order = np.lexsort((scale, image, track))
    track, image, xy, scale, angle = track.reshape(-1)[order], image[order], xy[order], scale[order], angle[order]
    again = np.concatenate([[False], (track[1:] == track[:-1]) & (image[1:] == image[:-1])]) if len(track) else used[:0]
    apart = np.concatenate([[0.0], np.linalg.norm(np.diff(xy, axis=0), axis=1)]) if len(track) else scale
    bad = np.zeros(int(track.max()) + 1 if len(track) else 0, bool)
    bad[track[again & (apart > same)]] = True
    every = Tracks(
        track=track.astype(np.int64),
        image=image,
        xy=xy,
        scale=scale,
        angle=angle,
        sigma=np.full((len(track), 2), np.nan),
    )
    return TracksFound(every.where(~again & ~bad[track]), int(bad.sum()))


def joined_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of several levels as one, each with numbers of its own."""
    start = np.cumsum([0, *(part.count for part in parts)])
    rest = (np.concatenate([getattr(p, n) for p in parts]) for n in ("image", "xy", "scale", "angle", "sigma"))
    return Tracks(np.concatenate([p.track + k for p, k in zip(parts, start)]), *rest)


#: Points that an image shares with at least two oriented ones, from which a model grows to it.
_GROWS = 20


def weak_images(count: int, tracks: Tracks) -> list[int]:
    """Images to which no model grows that begins with the pair of most common points.

    An image is added when `_GROWS` of its points are seen in two images of the model.
    """
    image, track = tracks.image, tracks.track
    table = coo_matrix((np.ones(len(tracks), np.int32), (image, track)), shape=(count, tracks.count)).tocsr()
    common = (table @ table.T).tocoo()
    apart = common.row < common.col
    if not apart.any():
        return list(range(count))
    best = np.flatnonzero(apart)[np.argmax(common.data[apart])]
    model = np.zeros(count, bool)
    model[[common.row[best], common.col[best]]] = True
    while True:
        known = np.bincount(track[model[image]], minlength=tracks.count) >= 2
        new = ~model & (np.bincount(image[known[track]], minlength=count) >= _GROWS)
        if not new.any():
            return [int(k) for k in np.flatnonzero(~model)]
        model |= new


def connected_parts(count: int, tracks: Tracks) -> list[list[int]]:
    """Images that hang together by tracks, the largest part first; an image without any is a part of its own."""
    total = count + tracks.count
    graph = coo_matrix((np.ones(len(tracks), np.int8), (tracks.image, count + tracks.track)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    parts: dict[int, list[int]] = {}
    for image in range(count):
        parts.setdefault(int(label[image]), []).append(image)
    return sorted(parts.values(), key=len, reverse=True)


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

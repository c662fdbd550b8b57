"""Tracks and their thinning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from photoplan.matching.features import (
    CELLS,
    GRUBER,
    Features,
    PairMatches,
    Tracks,
    build_tracks,
    connected_parts,
    thin_tracks,
)

EMPTY = np.empty((0, 0), np.uint8)


def features(*xy: tuple[float, float]) -> Features:
    n = len(xy)
    return Features(np.array(xy, float).reshape(-1, 2), np.ones(n), np.zeros(n), np.ones(n), EMPTY)


def pair(a: int, b: int, *rows: tuple[int, int]) -> PairMatches:
    return PairMatches(a, b, np.array(rows, np.int64).reshape(-1, 2), len(rows))


def tracks_of(rows: list[tuple[int, int, float, float]]) -> Tracks:
    """Rows track, image, x, y."""
    table = np.array(sorted(rows), float)
    n = len(table)
    return Tracks(
        table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:], np.ones(n), np.zeros(n), np.full((n, 2), np.nan)
    )


def test_matches_that_share_a_feature_are_one_track() -> None:
    f = [features((0, 0), (10, 10)), features((1, 1), (11, 11)), features((2, 2), (50, 50))]
    found = build_tracks(f, [pair(0, 1, (0, 0), (1, 1)), pair(1, 2, (0, 0))])
    t = found.tracks
    assert (t.count, found.ambiguous) == (2, 0)
    assert t.rays.tolist() == [3, 2]
    assert t.xy[t.track == 0].tolist() == [[0, 0], [1, 1], [2, 2]]
    assert t.image[t.track == 1].tolist() == [0, 1]


def test_a_track_with_two_places_in_one_image_is_dropped_and_counted() -> None:
    f = [features((0, 0), (30, 0)), features((1, 1)), features((2, 2))]
    found = build_tracks(f, [pair(0, 1, (0, 0)), pair(1, 2, (0, 0)), pair(0, 2, (1, 0))])
    assert (found.tracks.count, found.ambiguous) == (0, 1)


def test_one_place_with_two_directions_is_one_point() -> None:
    f = [features((0, 0), (0.2, 0)), features((1, 1)), features((2, 2))]
    found = build_tracks(f, [pair(0, 1, (0, 0)), pair(1, 2, (0, 0)), pair(0, 2, (1, 0))])
    assert (found.tracks.count, found.ambiguous) == (1, 0)
    assert found.tracks.image.tolist() == [0, 1, 2]


def test_tracks_that_lose_points_are_renumbered_or_dropped() -> None:
    t = tracks_of([(0, 0, 1, 1), (0, 1, 1, 1), (1, 0, 2, 2), (1, 1, 2, 2), (1, 2, 2, 2)])
    kept = t.where(np.array([True, False, True, True, False]))
    assert kept.track.tolist() == [0, 0] and kept.xy[:, 0].tolist() == [2, 2]
    assert t.of_tracks(np.array([False, True])).rays.tolist() == [3]


def test_without_matches_there_is_nothing() -> None:
    found = build_tracks([features((0, 0)), features((1, 1))], [])
    assert (found.tracks.count, len(found.tracks), found.ambiguous) == (0, 0, 0)
    assert connected_parts(2, found.tracks) == [[0], [1]]


def test_parts_that_hang_together() -> None:
    t = tracks_of([(0, 0, 0, 0), (0, 3, 0, 0), (1, 3, 0, 0), (1, 4, 0, 0), (2, 1, 0, 0), (2, 2, 0, 0)])
    assert connected_parts(6, t) == [[0, 3, 4], [1, 2], [5]]


SIZE = (1000, 800)


def cloud(count: int, seed: int, images: tuple[int, ...], first: int = 0, **box: NDArray) -> list:
    rng = np.random.default_rng(seed)
    low, high = box.get("low", np.zeros(2)), box.get("high", np.array(SIZE, float))
    return [(first + t, i, *rng.uniform(low, high)) for t in range(count) for i in images]


def test_long_tracks_are_kept_first() -> None:
    short = cloud(2000, 1, (0, 1)) + cloud(2000, 7, (2, 3), first=2000)
    t = tracks_of(short + cloud(60, 2, (0, 1, 2, 3), first=4000))
    keep = thin_tracks(t, [SIZE] * 4, 250)
    assert keep[4000:].all()
    assert 400 <= keep.sum() < 1000


def test_of_equally_long_tracks_the_more_accurate_ones_are_kept() -> None:
    t = tracks_of(cloud(2000, 8, (0, 1)))
    sigma = np.random.default_rng(9).uniform(0.05, 0.2, t.count)
    keep = thin_tracks(replace(t, sigma=np.repeat(sigma[t.track], 2).reshape(-1, 2)), [SIZE] * 2, 250)
    assert sigma[keep].mean() < 0.09 < 0.12 < sigma[~keep].mean()


def test_points_are_spread_and_about_as_many_as_wanted() -> None:
    corner = cloud(3000, 3, (0, 1), high=np.array([199.0, 159.0]))
    t = tracks_of(corner + cloud(1500, 4, (0, 1), first=3000))
    thin = t.of_tracks(thin_tracks(t, [SIZE] * 2, 250))
    for image in range(2):
        count = np.histogram2d(*thin.xy[thin.image == image].T, bins=CELLS, range=[[0, 1000], [0, 800]])[0]
        assert count.min() >= 9 and 250 <= count.sum() <= 500
        assert np.abs(np.diff(np.sort(count.ravel()))).max() <= 10


def test_every_sixth_of_an_overlap_keeps_points_where_there_are_some() -> None:
    """Two strips: long tracks fill the cells of both images, the pair (0, 2) has few short ones near one edge."""
    long = cloud(2000, 5, (0, 1, 3)) + cloud(2000, 10, (2, 4, 5), first=2000)
    edge = cloud(40, 6, (0, 2), first=4000, low=np.array([0.0, 700.0]), high=np.array([1000.0, 800.0]))
    t = tracks_of(long + edge)
    keep = thin_tracks(t, [SIZE] * 6, 100)
    xy = t.xy[(t.image == 0) & (t.track >= 4000)]
    kept = xy[keep[4000:]]
    assert len(kept) < 25
    assert np.histogram(kept[:, 0], bins=3, range=(0, 1000))[0].min() >= GRUBER

"""Kernels of the search of heights against slow, obvious ways."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from photoplan.kernels.matching import (
    HALF_COLUMNS,
    HALF_ROWS,
    add_plane_costs,
    census_transform,
    cost_scatter,
    least_cost_steps,
    sample_plane,
    sum_paths,
)


def runs(rng: np.random.Generator, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First steps, where runs begin, and costs."""
    low, count = rng.integers(-3, 4, (rows, columns)), rng.integers(1, 7, (rows, columns))
    first = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return low, first, rng.uniform(0, 1, first[-1]).astype(np.float32)


def test_costs_are_those_of_the_cheapest_way_along_each_path() -> None:
    low, first, cost = runs(np.random.default_rng(5), 5, 6)
    small, large = np.float32(0.25), np.float32(0.5)
    path, total = np.empty_like(cost), np.zeros_like(cost)
    sum_paths(cost, first, low, small, large, path, total)
    expected = np.zeros(len(cost))

    def own(j: int, i: int) -> slice:
        return slice(first[j * 6 + i], first[j * 6 + i + 1])

    for dj, di in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        for j in range(5):
            for i in range(6):
                # All posts on the path up to this one, the farthest first: the best chain of steps that ends in each.
                chain = [(j, i)]
                while 0 <= chain[0][0] - dj < 5 and 0 <= chain[0][1] - di < 6:
                    chain.insert(0, (chain[0][0] - dj, chain[0][1] - di))
                sums = cost[own(*chain[0])].astype(float)
                for before, here in pairwise(chain):
                    k, n = (low[p] + np.arange(own(*p).stop - own(*p).start) for p in (here, before))
                    apart = np.abs(k[:, None] - n[None])
                    price = np.where(apart == 0, 0.0, np.where(apart == 1, small, large))
                    cheapest = np.minimum((price + sums).min(axis=1), sums.min() + large)
                    sums = cost[own(*here)] + cheapest - sums.min()
                expected[own(j, i)] += sums
    assert np.abs(total - expected).max() < 1e-4


def test_the_cheapest_step_and_how_far_the_next_one_is() -> None:
    k = np.arange(12.0)
    valley = np.minimum((k - 4.2) ** 2, 1.5 + np.abs(k - 9))
    total = np.concatenate([valley, k]).astype(np.float32)
    first, low = np.array([0, 12, 24]), np.array([[100, 100]])
    steps, margin = np.empty((1, 2)), np.empty((1, 2))
    least_cost_steps(total, first, low, 2, steps, margin)
    assert abs(steps[0, 0] - 104.2) < 1e-4 and abs(margin[0, 0] - (1.5 - 0.04)) < 1e-4
    assert steps[0, 1] == 100 and margin[0, 1] == 0  # the first one of a run is no minimum


def test_other_choices_scatter_as_probable_as_they_are() -> None:
    """Two valleys, 6 steps apart; the second costs two units more."""
    total = np.full(11, 50.0, np.float32)
    total[2], total[8] = 3.0, 5.0
    out = np.empty((1, 1))
    first, low, best = np.array([0, 11]), np.array([[10]]), np.array([[12.0]])
    cost_scatter(total, first, low, best, 1.0, 0.01, best - 2, best + 2, out)
    p = np.exp(-2.0)
    assert abs(out[0, 0] - 36 * p / (1 + p)) < 1e-6
    cost_scatter(total, first, low, best, 1.0, 0.01, best - 2, best + 6, out)
    assert out[0, 0] < 1e-6  # a finer level chooses from both
    cost_scatter(total, first, low, best, 0.4, 0.01, best - 2, best + 2, out)
    assert out[0, 0] == 0  # five units


def test_cells_of_a_plane_and_what_is_brighter_around_them() -> None:
    y, x = np.mgrid[:30, :40].astype(np.float32)
    raw = 2 * x + 3 * y
    raw[20:, 30:] = np.nan
    at = np.stack(np.meshgrid([2.5, 18.5, 34.5], [1.25, 17.25]), axis=-1)
    wanted, grey = np.ones((16, 33), bool), np.empty((16, 33), np.float32)
    wanted[0, 0] = False
    sample_plane(raw, at, 16, wanted, grey)
    r, c = np.mgrid[:16, :33]
    known = wanted & np.isfinite(raw[(r + 1.25).astype(int) + 1, (c + 2.5).astype(int) + 1])
    assert np.allclose(grey[known], (2 * (c + 2.5) + 3 * (r + 1.25))[known], atol=1e-3)
    assert np.isnan(grey[0, 0])
    noise = np.random.default_rng(1).normal(0, 1, (16, 33)).astype(np.float32)
    bits, ok = np.zeros((16, 33), np.uint64), np.zeros((16, 33), bool)
    census_transform(noise, wanted, bits, ok)
    around = noise[5 - HALF_ROWS : 6 + HALF_ROWS, 9 - HALF_COLUMNS : 10 + HALF_COLUMNS]
    assert int(bits[5, 9]) == int("".join("01"[int(v)] for v in (around > noise[5, 9]).reshape(-1)), 2)
    assert ok[HALF_ROWS:-HALF_ROWS, HALF_COLUMNS:-HALF_COLUMNS].all() and ok.sum() == (16 - 6) * (33 - 8)


def test_the_cost_is_that_of_the_better_half_of_the_pairs() -> None:
    """Two images alike, a third one with all bits of 62 different: one of three pairs is good, two count."""
    census = np.zeros((3, 9, 9), np.uint64)
    census[2] = (1 << 62) - 1
    known, pairs = np.ones(census.shape, bool), np.array([[0, 1], [0, 2], [1, 2]])
    low = np.full((3, 3), 4)
    low[0, 0] = 6
    first = np.concatenate([[0], np.cumsum(np.full(9, 2))]).astype(np.int64)
    cost = np.full(18, 9.0, np.float32)
    add_plane_costs(census, known, pairs, 5, low, low + 2, 4, 1, 0.5, first, cost)
    assert (cost[:2] == 9).all() and (cost[2::2] == 9).all() and np.allclose(cost[3::2], 0.5)
    add_plane_costs(census, known, pairs[:1], 5, low, low + 2, 4, 1, 0.5, first, cost)
    assert np.allclose(cost[3::2], 0.0)
    add_plane_costs(census, known & False, pairs, 5, low, low + 2, 4, 1, 0.25, first, cost)
    assert np.allclose(cost[3::2], 0.25)

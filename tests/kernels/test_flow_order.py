"""Flooding and ways down against definitions."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.kernels import terrain as kernels
from photoplan.kernels.jit import COMPILED

SIZE = 40 if COMPILED else 14


def terrain(seed):
    rng = np.random.default_rng(seed)
    z = np.round(rng.normal(0, 3, (SIZE, SIZE + 5)), seed % 2).astype(np.float32)
    z[rng.random(z.shape) < 0.02] = np.nan
    return z


def flooded(z):
    filled = np.empty(z.shape, np.float32)
    order, origin = np.empty(z.size, np.int32), np.full(z.size, -1, np.int32)
    count = kernels.flood(z, filled, order, origin)
    receiver = np.empty(z.size, np.int32)
    kernels.steepest(filled, origin, receiver)
    return filled, order[:count], receiver


def shifted(a, row, col, outside):
    out = np.full((a.shape[0] + 2, a.shape[1] + 2), outside, a.dtype)
    out[1:-1, 1:-1] = a
    return out[1 + row : 1 + row + a.shape[0], 1 + col : 1 + col + a.shape[1]]


NEIGHBOURS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


@pytest.mark.parametrize("seed", range(4))
def test_filled_height_is_the_lowest_pass_on_any_way_out(seed):
    """The definition, by repetition until nothing changes: level = max(height, lowest level around)."""
    z = terrain(seed)
    level = np.where(np.isnan(z), -np.inf, np.inf)
    while True:
        around = np.min([shifted(level, r, c, -np.inf) for r, c in NEIGHBOURS], axis=0)
        new = np.where(np.isnan(z), -np.inf, np.maximum(z, around))
        if (new == level).all():
            break
        level = new
    filled, order, _ = flooded(z)
    np.testing.assert_array_equal(filled, np.where(np.isnan(z), np.nan, level))
    assert sorted(order) == list(np.flatnonzero(~np.isnan(z.ravel())))
    assert (np.diff(filled.ravel()[order]) >= 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_every_way_leads_out_and_no_water_is_lost(seed):
    z = terrain(seed)
    filled, order, receiver = flooded(z)
    place = np.empty(z.size, int)
    place[order] = np.arange(len(order))
    inside = receiver >= 0
    assert (place[receiver[inside]] < place[np.flatnonzero(inside)]).all(), "no circles"
    assert (filled.ravel()[receiver[inside]] <= filled.ravel()[inside]).all(), "never uphill"
    for split in (False, True):
        sums = np.where(np.isnan(z), 0.0, 1.0).ravel()
        if split:
            kernels.accumulate_split(filled, order, receiver, sums)
        else:
            kernels.accumulate(order, receiver, sums)
        assert sums[receiver == -1].sum() == pytest.approx(len(order), rel=1e-12)
        assert sums[~np.isnan(z.ravel())].min() >= 1


def test_steepest_neighbour_counts_the_diagonal_as_longer():
    z = np.full((3, 3), 10, np.float32)
    z[1, 1] = 5
    z[0, 0], z[1, 0] = 5 - 1.3, 5 - 1.0
    receiver = np.empty(9, np.int32)
    kernels.steepest(z, np.full(9, -1, np.int32), receiver)
    assert receiver[4] == 3
    z[0, 0] = 5 - 1.5
    kernels.steepest(z, np.full(9, -1, np.int32), receiver)
    assert receiver[4] == 0


@pytest.mark.parametrize("angle", [0, 20, 45, 70, 100, 155, 200, 250, 300, 341])
def test_split_flow_follows_the_angle_of_a_plane(angle):
    """On a plane the two shares are those of the direction of its fall between the two neighbours."""
    a = np.deg2rad(angle)
    row, col = np.mgrid[-1:2, -1:2]
    z = (10 - 0.3 * (np.cos(a) * col - np.sin(a) * row)).astype(np.float32)
    sums = np.zeros(9)
    sums[4] = 1
    kernels.accumulate_split(z, np.array([4], np.int32), np.full(9, -1, np.int32), sums)
    shares = {d: sums[(1 + kernels.ROW[d]) * 3 + 1 + kernels.COLUMN[d]] for d in range(8)}
    d, part = angle // 45, angle % 45 / 45
    assert shares[d] == pytest.approx(1 - part, abs=1e-5)
    assert shares[(d + 1) % 8] == pytest.approx(part, abs=1e-5)

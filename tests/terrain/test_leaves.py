"""Leaves of the quadtree cover the units exactly and hold few points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.surfaces.units import UnitLayout
from photoplan.terrain.observations import CAPACITY, Leaves, quadtree

LAYOUT = UnitLayout(-20.0, 64.0, 32.0, 3, 2)


def leaves_of(seed: int, count: int, meshes: int = 32) -> tuple[np.ndarray, Leaves]:
    rng = np.random.default_rng(seed)
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    xy = np.vstack([
        rng.uniform([xmin, ymin], [xmax, ymax], (count, 2)),
        rng.normal([10.0, 30.0], 1.5, (count, 2)),
    ])  # fmt: skip
    return xy, quadtree(xy, LAYOUT, meshes)


@given(st.integers(0, 10**6), st.integers(0, 400))
@settings(max_examples=25, deadline=None)
def test_leaves_cover_all_units_once(seed: int, count: int) -> None:
    _, leaves = leaves_of(seed, count)
    assert (4 * leaves.half**2).sum() == pytest.approx(6 * 32.0**2)
    assert (np.diff(leaves.unit) >= 0).all()
    probe = np.random.default_rng(seed + 1).uniform([-20, 0], [76, 64], (50, 2))
    inside = (np.abs(probe[:, None] - leaves.middle[None]) < leaves.half[None, :, None]).all(axis=2)
    assert (inside.sum(axis=1) == 1).all()


@given(st.integers(0, 10**6), st.integers(1, 400))
@settings(max_examples=25, deadline=None)
def test_every_point_is_in_its_leaf_and_leaves_are_small_enough(seed: int, count: int) -> None:
    xy, leaves = leaves_of(seed, count)
    assert sorted(leaves.order.tolist()) == list(range(len(xy)))
    assert leaves.count.sum() == len(xy) and (leaves.first[1:] == np.cumsum(leaves.count)[:-1]).all()
    smallest = 32.0 / 32 * 2 / 2
    for k in range(len(leaves.half)):
        own = xy[leaves.order[leaves.first[k] : leaves.first[k] + leaves.count[k]]]
        assert (np.abs(own - leaves.middle[k]) <= leaves.half[k] + 1e-9).all()
        assert leaves.count[k] <= CAPACITY or leaves.half[k] == smallest
    assert leaves.half.min() >= smallest


def test_leaves_of_a_unit() -> None:
    _, leaves = leaves_of(1, 200)
    every = np.concatenate([leaves.of_unit(u) for u in range(6)])
    np.testing.assert_array_equal(every, np.arange(len(leaves.half)))
    for unit in range(6):
        row, column = divmod(unit, 3)
        left, top = LAYOUT.corner(column, row)
        middle = leaves.middle[leaves.of_unit(unit)]
        assert (middle[:, 0] > left).all() and (middle[:, 0] < left + 32).all()
        assert (middle[:, 1] < top).all() and (middle[:, 1] > top - 32).all()


def test_points_in_the_order_of_leaves_follow_each_other() -> None:
    """Thinned, they still cover the area evenly: neighbours in the list are neighbours on the ground."""
    xy, leaves = leaves_of(2, 1500)
    step = np.linalg.norm(np.diff(xy[leaves.order], axis=0), axis=1)
    assert np.median(step) < 0.3 * np.median(np.linalg.norm(np.diff(xy, axis=0), axis=1))


def test_places_on_the_outer_edge_belong_to_the_last_unit() -> None:
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    leaves = quadtree(np.array([[xmax, ymin], [xmin, ymax]]), LAYOUT, 16)
    assert leaves.count[leaves.unit == 5].sum() == 1 and leaves.count[leaves.unit == 0].sum() == 1

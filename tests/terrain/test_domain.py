"""Where there is a surface: near data, in gaps that are narrow enough, inside border lines."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from photoplan.terrain.predict import Domain

X, Y = np.meshgrid(np.arange(0.5, 60), np.arange(0.5, 40))
XY = np.column_stack([X.ravel(), Y.ravel()])


def test_all_data_are_inside_and_what_is_far_is_not() -> None:
    xy = np.random.default_rng(1).uniform(0, 60, (300, 2))
    domain = Domain.of(xy, 3.5, 10.0, None)
    assert domain.contains(xy).all()
    assert not domain.contains(np.array([[-9.0, 30.0], [30.0, 69.0], [1e6, 0.0], [-1e6, 0.0]])).any()


@pytest.mark.parametrize("gap, closed", [(4.0, True), (7.0, True), (16.0, False)])
def test_gaps_up_to_twice_the_reach_are_closed(gap: float, closed: bool) -> None:
    xy = XY[(XY[:, 0] < 20) | (XY[:, 0] > 20 + gap)]
    domain = Domain.of(xy, 1.0, 5.0, None)
    middle = np.column_stack([np.full(20, 20 + gap / 2), np.linspace(8, 32, 20)])
    assert domain.contains(middle).all() == closed and domain.contains(middle).any() == closed


def test_the_outline_grows_by_two_cells_at_most() -> None:
    domain = Domain.of(XY, 1.0, 8.0, None)
    beside = np.column_stack([60 + np.array([0.4, 3.0, 6.0]), np.full(3, 20.0)])
    assert domain.contains(beside).tolist() == [True, False, False]


def test_holes_inside_and_what_is_beyond_the_border_are_outside() -> None:
    polygon = shapely.box(10, 10, 50, 30) - shapely.box(20, 15, 25, 20)
    domain = Domain.of(XY, 1.0, 5.0, polygon)
    places = np.array([[15.0, 20], [22, 17], [5, 20], [49.9, 29.9], [50.1, 20]])
    assert domain.contains(places).tolist() == [True, False, False, True, False]


@pytest.mark.slow
def test_a_wide_area_takes_larger_cells_and_keeps_all_data() -> None:
    xy = np.random.default_rng(2).uniform(0, 2_000_000, (50, 2))
    domain = Domain.of(xy, 1.0, 10.0, None)
    assert domain.near.size < 4e7 and domain.cell > 1.0 and domain.contains(xy).all()

"""The data of a patch: the nearest points and points of lines, and further ones only where the nearest lie in a row."""

from __future__ import annotations

import numpy as np

from photoplan.terrain.covariance import LINES, POINTS, Neighbours

XY = np.random.default_rng(1).uniform(0, 100, (3000, 2))


def test_the_nearest_points_and_points_of_lines_are_taken() -> None:
    line = np.column_stack([np.linspace(0, 100, 400), np.full(400, 50.0)])
    xy = np.vstack([XY, line])
    middle = np.array([[40.0, 47.0]])
    (found,) = Neighbours.of(xy, len(XY), np.arange(len(XY))).query(middle)
    assert len(found) == POINTS + LINES
    apart = np.abs(xy - middle).max(axis=1)
    for numbers, most in ((np.arange(3000), POINTS), (np.arange(3000, 3400), LINES)):
        nearest = numbers[np.argsort(apart[numbers])[:most]]
        assert set(found[(found >= numbers[0]) & (found <= numbers[-1])]) == set(nearest)


def test_in_a_row_further_points_are_asked_too() -> None:
    """Profiles 30 m apart with a point every 0.1 m: the nearest points know no slope across."""
    x, y = np.meshgrid(np.arange(0, 90, 0.1), np.arange(0, 90, 30.0))
    xy = np.column_stack([x.ravel(), y.ravel()])
    neighbours = Neighbours.of(xy, len(xy), np.arange(len(xy)))
    (found,) = neighbours.query(np.array([[45.0, 32.0]]))
    assert len(np.unique(xy[found[found >= 0], 1])) >= 2
    (even,) = Neighbours.of(XY, len(XY), np.arange(len(XY))).query(np.array([[45.0, 32.0]]))
    assert (np.abs(XY[even] - [45, 32]).max(axis=1) < 12).all()


def test_only_the_patches_in_a_row_get_more() -> None:
    row = np.column_stack([np.linspace(300, 400, 1000), np.full(1000, 300.0)])
    xy = np.vstack([XY, row])
    found = Neighbours.of(xy, len(xy), np.arange(len(xy))).query(np.array([[350.0, 300.0], [50.0, 50.0]]))
    assert (found[0] >= 0).sum() > POINTS and (found[1] >= 0).sum() == POINTS


def test_few_data() -> None:
    (found,) = Neighbours.of(XY[:5], 5, np.arange(5)).query(np.array([[50.0, 50.0]]))
    assert set(found[found >= 0]) == set(range(5))

"""Bilinear heights of a grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.kernels.terrain import sample_lattice, sample_points


def bilinear(grid, x, y):
    """The rule of the module's docstring, one point."""
    rows, cols = grid.shape
    if not (-0.5 <= x <= cols - 0.5 and -0.5 <= y <= rows - 0.5):
        return np.nan
    x, y = (each if abs(each - round(each)) > 1e-6 else round(each) for each in (x, y))
    x, y = min(max(x, 0), cols - 1), min(max(y, 0), rows - 1)
    total = 0.0
    for row in {int(np.floor(y)), int(np.ceil(y))}:
        for col in {int(np.floor(x)), int(np.ceil(x))}:
            total += (1 - abs(x - col)) * (1 - abs(y - row)) * float(grid[row, col])
    return total


@settings(max_examples=80, deadline=None)
@given(
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    start=st.tuples(st.floats(-3, 8), st.floats(-3, 8)),
    step=st.tuples(
        st.sampled_from((-1.0, -0.3, 0.1, 0.25, 0.5, 1.0, 3.0)), st.sampled_from((-2.5, -0.5, 0.2, 1.0, 2.0))
    ),
    on_posts=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_equals_its_twin(size, start, step, on_posts, seed):
    rng = np.random.default_rng(seed)
    grid = (rng.random(size) * 100).astype(np.float32)
    grid[rng.random(size) < 0.2] = np.nan
    x0, y0 = (round(each) if on_posts else round(each, 3) + 4e-4 for each in start)
    found = sample_lattice(grid, x0, step[0], 7, y0, step[1], 6)
    x, y = x0 + np.arange(7) * step[0], y0 + np.arange(6) * step[1]
    expected = np.array([[bilinear(grid, each_x, each_y) for each_x in x] for each_y in y])
    edge = (
        np.minimum(np.abs(x + 0.5), np.abs(x - grid.shape[1] + 0.5))[None],
        np.minimum(np.abs(y + 0.5), np.abs(y - grid.shape[0] + 0.5))[:, None],
    )
    sure = (edge[0] > 1e-5) & (edge[1] > 1e-5)
    np.testing.assert_allclose(found[sure], expected[sure], atol=2e-4)
    points = sample_points(grid, np.stack(np.broadcast_arrays(x[None], y[:, None]), axis=-1).reshape(-1, 2)).reshape(
        6, 7
    )
    np.testing.assert_array_equal(np.isnan(points), np.isnan(found))
    np.testing.assert_allclose(points, found, atol=2e-4)


def test_posts_without_weight_may_be_missing():
    grid = np.array([[1, np.nan, 3], [4, 5, 6], [7, np.nan, 9]], np.float32)
    found = sample_lattice(grid, 0.0, 0.1, 21, 1.0, 1.0, 1)
    np.testing.assert_allclose(found[0], np.linspace(4, 6, 21), rtol=1e-6)
    assert np.isnan(sample_lattice(grid, 0.5, 1.0, 1, 0.5, 1.0, 1)).all()
    assert sample_points(grid, np.array([[2.0, 0.5]]))[0] == pytest.approx(4.5)


def test_edge_is_continued_for_half_a_cell():
    grid = np.arange(6, dtype=np.float32).reshape(2, 3)
    found = sample_points(grid, np.array([[-0.5, 0], [-0.51, 0], [2.5, 1.5], [2.5, 1.51], [np.nan, 0], [0, 1e300]]))
    np.testing.assert_array_equal(found, np.array([0, np.nan, 5, np.nan, np.nan, np.nan], np.float32))


def test_empty():
    assert sample_lattice(np.zeros((3, 3), np.float32), 0, 1, 0, 0, 1, 4).shape == (4, 0)
    assert np.isnan(sample_lattice(np.zeros((0, 3), np.float32), 0, 1, 2, 0, 1, 2)).all()
    assert sample_points(np.zeros((3, 3), np.float32), np.empty((0, 2))).shape == (0,)

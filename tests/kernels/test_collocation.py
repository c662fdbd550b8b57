"""Linear algebra of linear prediction against numpy, covariance functions by what defines them."""

from __future__ import annotations

import numpy as np
import pytest
from collocation_twin import covariance, stacked
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.kernels.jit import kernel
from photoplan.kernels.prediction import EXPONENTIAL, GAUSSIAN, MATERN, correlation, factorise, solve_transposed, system

FAMILIES = (GAUSSIAN, MATERN, EXPONENTIAL)


@kernel
def correlations(d2, family, out):
    for i in range(len(d2)):
        out[i] = correlation(d2[i], family)


@pytest.mark.parametrize("family", FAMILIES)
def test_correlation_is_one_at_zero_a_half_at_one_and_falls(family: int) -> None:
    d = np.linspace(0, 6, 301)
    got = np.empty(len(d))
    correlations(d**2, family, got)
    assert got[0] == 1.0 and got[50] == pytest.approx(0.5, abs=1e-12)
    assert (np.diff(got) < 0).all()
    np.testing.assert_allclose(got, covariance(d, family), rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 11, 30])
def test_factorise_and_solve_are_those_of_numpy(n: int) -> None:
    """All remainders of the blocks of four rows."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n + 3))
    a = root @ root.T
    u, b = a.copy(), rng.normal(size=(n, 7))
    assert factorise(u)
    np.testing.assert_allclose(np.triu(u), np.linalg.cholesky(a).T, atol=1e-11)
    expected = np.linalg.solve(np.triu(u).T, b)
    solve_transposed(u, b)
    np.testing.assert_allclose(b, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("place", [0, 3, 4, 6])
def test_a_matrix_that_is_not_positive_definite_is_refused(place: int, bad: float) -> None:
    a = np.eye(7)
    a[place, place] = bad
    assert not factorise(a)


@given(st.integers(0, 10**6), st.sampled_from(FAMILIES), st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_covariance_matrices_with_sides_of_lines_are_positive_definite(seed: int, family: int, count: int) -> None:
    """For any lines: the side coordinates are coordinates, not rules (design/007)."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 10, (16, 2))
    lines = [rng.uniform(-2, 12, (rng.integers(2, 6), 2)) for _ in range(count)]
    vertices, start = stacked(lines)
    xyz = np.column_stack([xy, np.zeros(16)])
    model = np.array([family, 2.0, rng.uniform(1, 8), 2.5])
    leaf = np.array([5.0, 5.0, 2.0])
    noise = np.full(16, 1e-6)
    u, at, _, _ = system(xyz, noise, np.arange(16), leaf, np.empty((0, 2)), vertices, start, model)
    assert u.shape == (16, 16) and at.shape[1] >= 2
    d = np.sqrt(((at[:, None] - at[None]) ** 2).sum(axis=2))
    matrix = 2.0 * covariance(d, family)
    assert np.linalg.eigvalsh(matrix)[0] > -1e-10
    upper = np.triu(u)
    np.testing.assert_allclose(upper.T @ upper, matrix + 1e-6 * np.eye(16), atol=1e-7)

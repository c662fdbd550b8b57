"""Least squares: against what is known in closed form, the same fit repeated, and simulated errors."""

from dataclasses import dataclass

import numpy as np
import pytest

from photoplan.adjustment.blocks import Kind, Layout
from photoplan.adjustment.least_squares import (
    Decomposed,
    bisquare,
    cauchy,
    geman_mcclure,
    huber,
    levenberg,
    solve,
    spread,
)
from photoplan.adjustment.statistics import chance_chi_square, chance_f, chance_gain, chance_normal, chance_t
from photoplan.orientation.bundle.model import Vectors

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("n", [12, 900])
def test_solution_cofactors_and_residuals_are_those_of_the_normal_equations(n):
    A = np.column_stack([np.ones(n), RNG.normal(size=(n, 3)) * [1.0, 1e4, 1e-5]])
    y, weight = RNG.normal(size=n), RNG.uniform(0.0, 3.0, n)
    weight[0] = 0.0
    fit = solve(A, y, weight)
    N = A.T @ (weight[:, None] * A)
    assert np.allclose(N @ fit.unknowns, A.T @ (weight * y), rtol=1e-9, atol=1e-9 * np.sqrt(np.diag(N)))
    assert np.allclose(fit.cofactors @ N, np.eye(4), atol=1e-6)
    assert np.allclose(fit.residuals, A @ fit.unknowns - y)
    assert fit.redundancy == n - 1 - 4
    assert np.isclose(fit.sigma0**2 * fit.redundancy, weight @ fit.residuals**2)
    assert np.isclose(fit.redundancies[1:].sum(), fit.redundancy)
    assert np.allclose(fit.influence @ y, fit.unknowns)


def test_several_right_sides_share_their_equations():
    A, y = RNG.normal(size=(9, 3)), RNG.normal(size=(9, 2))
    both, one = solve(A, y), solve(A, y[:, 1])
    assert np.allclose(both.unknowns[:, 1], one.unknowns)
    assert both.redundancy == 12


@pytest.mark.parametrize("weighted", [False, True])
def test_residuals_without_rows_are_those_of_the_fit_repeated_without_them(weighted):
    A, y = RNG.normal(size=(20, 3)), RNG.normal(size=20)
    weight = RNG.uniform(0.5, 2.0, 20) if weighted else None
    rows = np.array([4, 11])
    rest = np.delete(np.arange(20), rows)
    repeated = solve(A[rest], y[rest], None if weight is None else weight[rest])
    assert np.allclose(solve(A, y, weight).without(rows), (A @ repeated.unknowns - y)[rows])


@pytest.mark.parametrize("n", [8, 600])
def test_what_is_not_determined_is_counted_and_stays_zero(n):
    A = RNG.normal(size=(n, 2))
    A = np.column_stack([A, A @ [1.0, -2.0]])
    fit = solve(A, A[:, 0])
    assert fit.rank == 2 and fit.redundancy == n - 2 and fit.condition == 0.0
    assert np.allclose(A @ fit.unknowns, A[:, 0], atol=1e-7)


@pytest.mark.parametrize("n", [8, 600])
def test_columns_that_have_vanished_are_not_determined(n):
    A = np.column_stack([np.ones(n), np.full(n, 1e-155), np.zeros(n)])
    fit = solve(A, np.full(n, 3.0))
    assert fit.rank == 1 and np.allclose(fit.unknowns, [3.0, 0.0, 0.0])


def test_standard_deviations_are_those_of_repetition():
    A = np.column_stack([np.ones(30), np.linspace(-1, 5, 30)])
    fits = [solve(A, RNG.normal(0.0, 2.0, 30)) for _ in range(2000)]
    found = np.std([fit.unknowns for fit in fits], axis=0)
    assert np.allclose(np.sqrt(np.mean([fit.sigmas**2 for fit in fits], axis=0)), found, rtol=0.05)


def test_damping_is_that_of_marquardt():
    A, y = RNG.normal(size=(10, 3)) * [1.0, 10.0, 0.1], RNG.normal(size=10)
    N, parts = A.T @ A, Decomposed.of(A)
    wanted = np.linalg.solve(N + 0.3 * np.diag(np.diag(N)), A.T @ y)
    assert np.allclose(parts.back(parts.along(y), 0.3), wanted)


def test_iterations_end_at_the_minimum_from_a_start_that_plain_steps_do_not_bear():
    t = np.linspace(0.0, 4.0, 40)
    y = 3.0 * np.exp(-1.3 * t) + RNG.normal(0.0, 0.01, 40)

    def equations(x):
        decay = np.exp(-x[1] * t)
        return np.column_stack([decay, -x[0] * t * decay]), x[0] * decay - y

    found = levenberg(np.array([0.1, 6.0]), equations, lambda x, step: x + step if x[1] + step[1] > 0 else None, 60)
    gradient = found.A.T @ found.v
    assert np.abs(gradient / np.linalg.norm(found.A, axis=0)).max() < 1e-3 * found.sigma0
    sigma = np.sqrt(np.diag(found.cofactors())) * found.sigma0
    assert (np.abs(found.state - [3.0, 1.3]) < 4 * sigma).all() and found.sigma0 == pytest.approx(0.01, rel=0.4)


def test_spread_is_the_standard_deviation_of_normal_errors_and_bears_gross_ones():
    e = RNG.normal(5.0, 2.0, 40001)
    assert spread(e, 5.0) == pytest.approx(2.0, rel=0.02)
    e[:4000] = 1e9
    e[4000] = np.nan
    assert spread(e, None) == pytest.approx(2.0, rel=0.2)
    assert np.isnan(spread([np.nan]))


@pytest.mark.parametrize("weight", [huber, cauchy, geman_mcclure, bisquare])
def test_weights_fall_from_one(weight):
    size = np.linspace(0.0, 10.0, 101)
    w = weight(size, 2.0)
    assert w[0] == 1.0 and (np.diff(w) <= 0).all() and (w >= 0).all() and np.allclose(w, weight(-size, 2.0))


def test_chances_are_those_of_the_distributions():
    from scipy import stats  # a second of each collection

    assert chance_normal(-1.7) == pytest.approx(2 * stats.norm.sf(1.7))
    assert chance_t(2.1, 7.5) == pytest.approx(2 * stats.t.sf(2.1, 7.5))
    assert chance_chi_square(11.0, 6) == pytest.approx(stats.chi2.sf(11.0, 6))
    assert chance_f(2.5, 3, 20) == pytest.approx(stats.f.sf(2.5, 3, 20))
    assert chance_gain(10.0, 8.0, 2, 30) == pytest.approx(stats.f.sf(1.0 / (8.0 / 30), 2, 30))
    assert chance_f(-0.1, 2, 5) == 1.0 and chance_t(np.inf, 3) == 0.0


@dataclass(frozen=True)
class Scales:
    """A kind of unknowns that multiplies by its steps, as no kind of the package does."""

    values: np.ndarray

    def moved(self, step):
        return Scales(self.values * np.exp(step[:, 0]))


def test_blocks_stand_one_after_the_other_and_move_by_their_own_rules():
    layout = Layout.of(
        [
            Kind("knots", ("a", "b", "c", "d"), ("X of {}", "Y of {}"), "knot"),
            Kind("held", ("a",), ()),
            Kind("scales", ("east", "west"), ("scale of {}",), "half"),
        ]
    )
    assert layout.count == 10 and layout.get("held") is None
    scales = layout.get("scales")
    assert scales.at(np.array([1])) == [9] and layout.get("knots").columns(2).tolist() == [4, 5]
    step = np.zeros(10)
    step[5], step[9] = 2.0, np.log(3.0)
    values = {"knots": Vectors(np.ones((4, 2))), "held": Vectors(np.ones((1, 1))), "scales": Scales(np.full(2, 5.0))}
    moved = layout.moved(values, step)
    assert moved["knots"].values[2].tolist() == [1.0, 3.0] and moved["held"] is values["held"]
    assert np.allclose(moved["scales"].values, [5.0, 15.0])


def test_undetermined_directions_are_spelled_by_names():
    layout = Layout.of(
        [Kind("knots", ("a", "b", "c", "d"), ("X of {}", "Y of {}"), "knot"), Kind("scale", ("",), ("scale",))]
    )
    direction = np.array([0.0, 0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 0.5, 0.01])
    assert layout.spelled(direction, np.full(9, 2.0)) == ("Y of knots 'a', 'b', 'c' and 1 more with scale (+0.02)")

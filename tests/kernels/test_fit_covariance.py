"""The score of a covariance function is that of true leave-one-out; its least value is found."""

from __future__ import annotations

import numpy as np
import pytest
from collocation_twin import collocation, covariance, distances
from numpy.typing import NDArray

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.prediction import EXPONENTIAL, GAUSSIAN, MATERN, block_score
from photoplan.terrain.covariance import minimise

NOISE = 2e-4


def block(n: int, seed: int, family: int, variance: float, length: float) -> tuple[NDArray[np.float64], ...]:
    """Points of a random field, as the kernels take them: squared distances, sides, heights and trend, noise."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, np.sqrt(n), (n, 2))
    d = distances(xy, xy)
    root = np.linalg.cholesky(variance * covariance(d / length, family) + 1e-9 * variance * np.eye(n))
    z = root @ rng.normal(size=n) + rng.normal(0, np.sqrt(NOISE), n)
    b = np.column_stack([z, np.ones(n), xy - xy.mean(axis=0)])
    return d**2, np.zeros((n, n)), b, np.tile([0.0, 1.0, 1.0], (n, 1))


@pytest.mark.parametrize("family", [GAUSSIAN, MATERN, EXPONENTIAL])
def test_the_score_is_that_of_leave_one_out(family: int) -> None:
    """Points are predicted, also those of known noise; lines (with a share of it, or a known one) only take part."""
    variance, length, noise2, scored = 4e-4, 3.0, 1e-4, 14
    d2, sides, b, noise = block(20, 3, family, 1e-3, 3.0)
    noise[:5, :2] = 4e-5, 0.0
    noise[scored:17, 1:] = 0.09, 0.0
    noise[17:] = (3e-5, 0.0, 0.0)
    total = 0.0
    all_noise = noise[:, 0] + noise[:, 1] * noise2
    xyz = np.column_stack([b[:, 2:], b[:, 0]])
    for k in range(scored):
        rest = np.delete(np.arange(20), k)
        z, v = collocation(xyz[rest], all_noise[rest], xyz[[k], :2], (family, variance, length, 2.0), [])
        v = v + all_noise[k]
        total += (xyz[k, 2] - z[0]) ** 2 / v[0] + np.log(v[0])
    got = block_score(d2, sides, b, noise, np.array([variance, length, noise2]), family)
    assert got == pytest.approx(total, rel=1e-5)


def test_a_matrix_that_cannot_be_is_infinitely_bad() -> None:
    d2, sides, b, noise = block(8, 1, MATERN, 1e-3, 3.0)
    assert block_score(d2, sides, b, noise, np.array([np.nan, 3.0, 1e-4]), MATERN) == np.inf


def fitted(blocks: list[tuple[NDArray[np.float64], ...]], prior: NDArray[np.float64], first, family: int):  # type: ignore[no-untyped-def]
    return minimise(*(np.stack(part) for part in zip(*blocks)), prior, np.asarray(first, float), family)


FREE = np.array([[0, 0, 0], [0, 0, 0], [-20, -3, -25], [5, 4, 2]], float)


@pytest.mark.skipif(not COMPILED, reason="hundreds of factorisations: too slow as plain Python")
@pytest.mark.parametrize("family", [GAUSSIAN, MATERN, EXPONENTIAL])
def test_no_place_beside_the_least_score_is_better(family: int) -> None:
    blocks = [block(60, seed, family, 0.01, 4.0) for seed in range(8)]
    logs, value = fitted(blocks, FREE, np.log([1e-3, 2.0, 1e-5]), family)
    logs, value = fitted(blocks, FREE, logs, family)
    total = lambda at: sum(block_score(*one, np.exp(at), family) for one in blocks)  # noqa: E731
    assert value == pytest.approx(total(logs), rel=1e-9)
    rng = np.random.default_rng(0)
    around = [total(logs + rng.normal(0, size, 3)) for size in (0.02, 0.1, 0.5) for _ in range(30)]
    assert min(around) > value - 0.05
    assert value < total(np.log([0.01, 4.0, NOISE]))


def test_bounds_hold_and_equal_bounds_fix_a_parameter() -> None:
    blocks = [block(12, 5, MATERN, 0.01, 4.0)]
    prior = FREE.copy()
    prior[2:, 2] = np.log(NOISE)
    prior[2:, 1] = np.log([1.0, 2.0])
    logs, value = fitted(blocks, prior, [np.log(1e-3), np.log(1.5), np.log(NOISE)], MATERN)
    assert logs[2] == np.log(NOISE) and np.log(1.0) <= logs[1] <= np.log(2.0) and np.isfinite(value)


def test_a_strong_prior_decides() -> None:
    blocks = [block(12, 5, MATERN, 0.01, 4.0)]
    prior = FREE.copy()
    prior[0], prior[1] = np.log([0.02, 3.0, 1e-4]), 1e6
    logs, _ = fitted(blocks, prior, np.log([0.03, 2.0, 2e-4]), MATERN)
    np.testing.assert_allclose(logs, prior[0], atol=0.02)

"""Least-squares matching of patches with known displacement, against what its covariance promises."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.matching import (
    CONVERGED,
    CORRELATION,
    LEFT,
    RESULTS,
    SINGULAR,
    UNSETTLED,
    match_patches,
    sample_spline,
    spline_coefficients,
)

RADIUS, HALF = 10, 20
COUNT = 400 if COMPILED else 3


class Texture:
    """A sum of waves of random direction: known everywhere without interpolation. Standard deviation 1."""

    def __init__(self, seed: int, shortest: float = 5.0) -> None:
        rng = np.random.default_rng(seed)
        length, angle = rng.uniform(shortest, 20.0, 40), rng.uniform(0, 2 * np.pi, 40)
        self.k = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.phase = rng.uniform(0, 2 * np.pi, 40)

    def __call__(self, x: NDArray, y: NDArray) -> NDArray:
        return np.sqrt(2 / 40) * np.cos(np.einsum("ni,i...->n...", self.k, np.stack([x, y])).T + self.phase).T.sum(0)


def scene(seed: int, affine: NDArray, shift: NDArray, noise: float) -> tuple[NDArray, NDArray]:
    """Template T(u) = f(u) and window S(A u + middle + shift) = f(u), both noisy; S is darker, with less contrast."""
    rng = np.random.default_rng(10_000 + seed)
    f = Texture(seed)
    v, u = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1].astype(float)
    template = f(u, v) + noise * rng.normal(size=u.shape)
    row, col = np.mgrid[: 2 * HALF + 1, : 2 * HALF + 1] - float(HALF)
    back = np.linalg.inv(affine) @ np.stack([col - shift[0], row - shift[1]]).reshape(2, -1)
    window = 80 + 40 * (f(*back).reshape(col.shape) + noise * rng.normal(size=col.shape))
    return 100 + 50 * template, window


def match(template: NDArray, window: NDArray, start: tuple[float, ...] = (HALF, HALF, 1, 0, 0, 1)) -> NDArray:
    coefficients = window[None].astype(float).copy()
    spline_coefficients(coefficients)
    results = np.zeros((1, RESULTS))
    results[0, :6] = start
    weights = np.ones((1, *template.shape))
    match_patches(np.ascontiguousarray(template)[None], weights, coefficients, np.array([30, 1e-3, 4.0]), results)
    return results[0]


def test_spline_is_that_of_scipy() -> None:
    values = np.random.default_rng(1).normal(size=(12, 15))
    c = values[None].copy()
    spline_coefficients(c)
    np.testing.assert_allclose(c[0], ndimage.spline_filter(values, 3, mode="mirror"), atol=1e-9)
    xy = np.random.default_rng(2).uniform([1, 1], [12.9, 9.9], (50, 2))
    found = np.empty(50)
    sample_spline(c[0], xy, found)
    np.testing.assert_allclose(found, ndimage.map_coordinates(values, xy.T[::-1], order=3, mode="mirror"), atol=1e-9)


def test_without_noise_position_affine_and_radiometry_are_found() -> None:
    A, shift = np.array([[1.05, 0.08], [-0.06, 0.97]]), np.array([0.37, -1.21])
    found = match(*scene(3, A, shift, 0.0))
    assert found[-1] == CONVERGED
    np.testing.assert_allclose(found[:2], HALF + shift, atol=2e-3)
    np.testing.assert_allclose(found[2:6], A.ravel(), atol=1e-3)
    np.testing.assert_allclose(found[6:8], (0.0, 1.25), atol=0.5)
    assert found[CORRELATION] > 0.9999


def test_shifts_at_a_signal_to_noise_ratio_of_20_are_found_to_0_03_px() -> None:
    rng = np.random.default_rng(4)
    shifts = rng.uniform(-1.5, 1.5, (COUNT, 2))
    found = np.array([match(*scene(i, np.eye(2), s, 1 / 20)) for i, s in enumerate(shifts)])
    assert (found[:, -1] == CONVERGED).all()
    error = found[:, :2] - HALF - shifts
    rms = np.sqrt((error**2).mean())
    assert rms <= 0.02 and np.quantile(np.abs(error), 0.99) <= 0.03, (rms, np.abs(error).max())
    assert np.abs(error.mean(axis=0)).max() < 5 * rms / np.sqrt(COUNT)  # no bias


@pytest.mark.skipif(not COMPILED, reason="many patches")
@pytest.mark.parametrize(("noise", "low", "high"), [(1 / 20, 0.8, 1.25), (1 / 8, 1.0, 1.35)])
def test_covariance_is_that_of_the_errors_under_white_noise(noise: float, low: float, high: float) -> None:
    """With much noise the slopes have noise too, and the standard deviations become too small."""
    rng = np.random.default_rng(5)
    A = np.array([[1.02, 0.15], [-0.12, 0.98]])
    shifts = rng.uniform(-1, 1, (COUNT, 2))
    found = np.array([match(*scene(i, A, s, noise), start=(HALF, HALF, 1, 0.1, -0.1, 1)) for i, s in enumerate(shifts)])
    error = found[:, :2] - HALF - shifts
    C = found[:, [9, 10, 10, 11]].reshape(-1, 2, 2)
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(C), error) / 2
    spread = np.sqrt(normalised.mean())
    assert low <= spread <= high, spread  # measured: 1.10 and 1.27


def test_pixels_without_weight_do_not_matter() -> None:
    template, window = scene(6, np.eye(2), np.array([0.3, 0.2]), 0.02)
    weights = np.ones((1, *template.shape))
    weights[0, :6, :6] = 0
    spoilt = template.copy()
    spoilt[:6, :6] = 1e4
    found = []
    for values in (template, spoilt):
        c = window[None].copy()
        spline_coefficients(c)
        results = np.zeros((1, RESULTS))
        results[0, :6] = HALF, HALF, 1, 0, 0, 1
        match_patches(values[None], weights, c, np.array([30, 1e-3, 4.0]), results)
        found.append(results[0])
    np.testing.assert_array_equal(*found)


def test_what_cannot_be_matched_is_told_apart() -> None:
    template, window = scene(7, np.eye(2), np.zeros(2), 0.05)
    assert match(template, window, (3, HALF, 1, 0, 0, 1))[-1] == LEFT
    assert match(template, np.full_like(window, 7.0))[-1] == LEFT  # no texture at all
    stripes = np.sin(np.arange(41.0) / 2)[None] * np.ones((41, 1))
    assert match(stripes[10:31, 10:31], stripes)[-1] == SINGULAR
    other = scene(8, np.eye(2), np.zeros(2), 0.05)[1]
    wrong = match(template, other)
    assert wrong[-1] in (UNSETTLED, LEFT) or wrong[CORRELATION] < 0.7
    assert np.isnan(match(template, window, (3, HALF, 1, 0, 0, 1))[:-1]).all()

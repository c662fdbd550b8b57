"""Correlation coefficient of a template over a window: Behr 1989, eq. 4.1, weighted, with missing pixels."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from photoplan.kernels.matching import correlate, sample_template

RNG = np.random.default_rng(4)


def surface(image: NDArray, template: NDArray, weights: NDArray, least: float = 0.75) -> NDArray:
    out = np.full(np.subtract(image.shape, template.shape) + 1, -9.0)
    correlate(*(np.asarray(a, np.float32) for a in (image, template, weights)), least, out)
    return out


def by_definition(image: NDArray, template: NDArray, weights: NDArray, least: float) -> NDArray:
    """Weighted covariance over standard deviations, place by place."""
    h, w = template.shape
    out = np.full(np.subtract(image.shape, template.shape) + 1, np.nan)
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            part = image[r : r + h, c : c + w]
            use = np.isfinite(part) & (weights > 0)
            if weights[use].sum() < least * weights.sum():
                continue
            cov = np.cov(np.stack([part[use], template[use]]), aweights=weights[use])
            out[r, c] = cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])
    return out


@pytest.mark.parametrize("holes", [0.0, 0.05])
def test_is_the_weighted_correlation_coefficient(holes: float) -> None:
    # Of its own: at a share of exactly `least`, float32 and float64 may differ.
    rng = np.random.default_rng(14)
    image = rng.normal(1000, 30, (24, 31))
    image[rng.random(image.shape) < holes] = np.nan
    template, weights = rng.normal(size=(6, 5)), rng.choice([0.0, 0.3, 1.0], (6, 5))
    np.testing.assert_allclose(
        surface(image, template, weights), by_definition(image, template, weights, 0.75), atol=2e-6
    )


def test_equation_4_1_as_printed() -> None:
    x, y = RNG.normal(size=(2, 7, 7))
    n = x.size
    r = ((x * y).sum() - x.sum() * y.sum() / n) / np.sqrt(
        ((x**2).sum() - x.sum() ** 2 / n) * ((y**2).sum() - y.sum() ** 2 / n)
    )
    assert surface(x, y, np.ones_like(x))[0, 0] == pytest.approx(r, abs=1e-6)


def test_does_not_depend_on_brightness_and_contrast_and_changes_sign_with_a_negative() -> None:
    image, template = RNG.normal(size=(20, 20)), RNG.normal(size=(8, 8))
    ones = np.ones_like(template)
    r = surface(image, template, ones)
    np.testing.assert_allclose(surface(60000 + 300 * image, 5 - 2 * template, ones), -r, atol=3e-4)


def test_missing_pixels_on_one_side_do_not_change_the_other() -> None:
    image, template = RNG.normal(size=(16, 40)), RNG.normal(size=(7, 6))
    ones = np.ones_like(template)
    whole = surface(image, template, ones)
    cut = image.copy()
    cut[:, :5] = np.nan
    np.testing.assert_allclose(surface(cut, template, ones)[:, 5:], whole[:, 5:], atol=1e-5)
    assert np.isnan(surface(cut, template, ones)[:, 0]).all()


def test_flat_windows_and_flat_templates_have_none() -> None:
    image = np.full((12, 12), 255.0)
    image[8:] = RNG.normal(size=(4, 12))
    template = RNG.normal(size=(4, 4))
    r = surface(image, template, np.ones((4, 4)))
    assert np.isnan(r[:5]).all()
    assert np.isfinite(r[5:]).all()
    assert np.isnan(surface(RNG.normal(size=(9, 9)), np.ones((4, 4)), np.ones((4, 4)))).all()


def test_sampled_template_and_its_derivatives() -> None:
    rows, columns = np.indices((40, 44), dtype=float)
    values = np.sin(columns / 6) * np.cos(rows / 7)
    to = np.array([[1.9, 0.2, 8.3], [-0.1, 2.1, 7.7]])

    def sampled(matrix: NDArray) -> NDArray:
        out = np.empty((4, 9, 11))
        sample_template(values, np.ones_like(values), matrix, out)
        return out

    out = sampled(to)
    r, c = np.indices((9, 11), dtype=float)
    x, y = to[0, 0] * c + to[0, 1] * r + to[0, 2], to[1, 0] * c + to[1, 1] * r + to[1, 2]
    np.testing.assert_allclose(out[0], np.sin(x / 6) * np.cos(y / 7), atol=5e-4)
    step = 1e-5
    for k, move in ((1, to[:, 0]), (2, to[:, 1])):
        shift = np.zeros((2, 3))
        shift[:, 2] = step * move
        difference = (sampled(to + shift)[0] - sampled(to - shift)[0]) / (2 * step)
        np.testing.assert_allclose(out[k], difference, atol=1e-7)


def test_beyond_the_template_the_weight_is_zero() -> None:
    out = np.empty((4, 6, 6))
    sample_template(np.ones((8, 8)), np.ones((8, 8)), np.array([[1.0, 0, 3.0], [0, 1.0, 3.0]]), out)
    assert (out[3, :3, :3] == 1).all()
    assert (out[3, 4:] == 0).all()

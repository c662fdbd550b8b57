"""Means of several edges: weights, outliers, intervals that hold what they promise, Gaussians."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tools.thinned import some

from photoplan.errors import InputError
from photoplan.quality.curves import MtfCurve, gaussian_modulation
from photoplan.quality.edges.groups import combine, field_cell, fit_gaussian, mean_curve, quantiles, sigma_of_interval


class TestCombine:
    @pytest.mark.parametrize(
        ("between", "edges"),
        some([(0.0, 12), (0.0, 4), (0.0, 3), (0.0, 2), (0.02, 12), (0.02, 5), (0.05, 30)], 0, 3, 5),
    )
    def test_intervals_cover_the_truth(self, between: float, edges: int) -> None:
        """Edges that differ by more than their own errors say: 95 % intervals hold the mean in 90 to 98 %."""
        rng = np.random.default_rng(edges + round(1000 * between))
        inside = 0
        for _ in range(400):
            sigma = rng.uniform(0.004, 0.02, edges)
            values = 0.3 + rng.normal(0, between, edges) + rng.normal(0, sigma)
            low, high = combine(values.tolist(), sigma.tolist()).interval
            inside += low <= 0.3 <= high
        print(f"scatter {between}, {edges} edges: {inside / 4:.1f} % covered")
        assert 0.90 <= inside / 400 <= 0.985

    def test_two_edges_lean_on_their_own_errors(self) -> None:
        """A little farther apart than these let expect: not 12.7 standard deviations, as Student says of two values."""
        alone = combine([0.30], [0.010])
        apart, near = combine([0.30, 0.316], [0.010, 0.010]), combine([0.30, 0.31], [0.010, 0.010])
        assert apart.scatter > 0.0 and near.scatter == 0.0
        assert np.ptp(apart.interval) < 6.0 * apart.sigma
        assert np.ptp(near.interval) < 0.75 * np.ptp(alone.interval)

    @pytest.mark.parametrize("edges", some([1, 2, 5], 0, 1))
    def test_errors_that_are_known_from_few_blocks_make_intervals_wider(self, edges: int) -> None:
        """Of seven degrees of freedom each: with the normal distribution's factor 91 % and not 95 % for one edge."""
        rng = np.random.default_rng(edges)
        inside, count = 0, 2000 // edges
        for _ in range(count):
            sigma = rng.uniform(0.004, 0.02, edges)
            stated = sigma * np.sqrt(rng.chisquare(7, edges) / 7)
            low, high = combine((0.3 + rng.normal(0, sigma)).tolist(), stated.tolist(), freedom=7).interval
            inside += low <= 0.3 <= high
        print(f"{edges} edges: {100 * inside / count:.1f} % covered")
        assert 0.935 <= inside / count <= 0.98

    def test_a_gross_error_counts_little(self) -> None:
        rng = np.random.default_rng(1)
        values = (0.3 + rng.normal(0, 0.01, 15)).tolist()
        clean = combine(values, [0.01] * 15)
        wild = combine([*values, 0.9], [0.01] * 16)
        assert abs(wild.value - clean.value) < 0.02

    def test_precise_edges_count_more(self) -> None:
        assert combine([0.30, 0.31], [0.001, 0.1]).value == pytest.approx(0.30, abs=0.002)

    def test_scatter_is_found(self) -> None:
        rng = np.random.default_rng(2)
        values = 0.3 + rng.normal(0, 0.05, 400) + rng.normal(0, 0.02, 400)
        assert combine(values.tolist(), [0.02] * 400).scatter == pytest.approx(0.05, rel=0.1)

    def test_one_none_and_unknown(self) -> None:
        one = combine([0.3, math.nan], [0.01, 0.01])
        assert (one.value, one.edges) == (0.3, 1)
        assert one.interval == pytest.approx((0.3 - 0.0196, 0.3 + 0.0196), abs=1e-4)
        none = combine([math.nan], [0.1])
        assert math.isnan(none.value) and none.edges == 0
        assert math.isnan(combine([0.3], [math.nan]).interval[0])
        assert combine([0.3, 0.3], [math.nan, 0.01]).value == pytest.approx(0.3)
        assert combine([0.1, 0.5], [0.001, 0.001], least=0.0).interval[0] == 0.0
        with pytest.raises(InputError, match="confidence 2"):
            combine([0.3], [0.1], 2.0)

    def test_sigma_of_an_interval_and_quantiles(self) -> None:
        assert sigma_of_interval((0.3 - 1.959964, 0.3 + 1.959964)) == pytest.approx(1.0, abs=1e-6)
        assert math.isnan(sigma_of_interval((math.nan, 1.0)))
        assert sigma_of_interval((0.3 - 2.3646, 0.3 + 2.3646), freedom=7) == pytest.approx(1.0, abs=1e-4)
        assert quantiles([1.0, math.nan, 3.0], (0.5,)) == [2.0]
        assert math.isnan(quantiles([math.nan], (0.5,))[0])


class TestCurves:
    def test_the_gaussian_of_a_gaussian(self) -> None:
        frequency = np.linspace(0, 1, 129)
        for fwhm in (0.8, 2.0, 5.0):
            fit = fit_gaussian(MtfCurve(frequency, gaussian_modulation(fwhm, frequency)))
            assert fit.fwhm == pytest.approx(fwhm, rel=1e-4)
            assert fit.rms < 1e-5

    def test_rms_of_another_form(self) -> None:
        """The box of a pixel: the best Gaussian is off by a stated amount."""
        frequency = np.linspace(0, 0.5, 501)
        fit = fit_gaussian(MtfCurve(frequency, np.sinc(frequency)))
        by_hand = np.sqrt(np.mean((gaussian_modulation(fit.fwhm, frequency) - np.sinc(frequency)) ** 2))
        assert fit.rms == pytest.approx(by_hand, rel=1e-6)
        assert 0 < fit.rms < 0.02

    def test_mean_curve(self) -> None:
        frequency = np.linspace(0, 1, 129)
        sharp, soft = (MtfCurve(frequency, gaussian_modulation(f, frequency), np.full(129, 0.01)) for f in (1.5, 2.0))
        mean = mean_curve([sharp, soft])
        assert mean.frequency[-1] == pytest.approx(1.0)
        assert soft.mtf50 < mean.mtf50 < sharp.mtf50
        assert mean.at(0.3) == pytest.approx((sharp.at(0.3) + soft.at(0.3)) / 2, abs=2e-3)
        short = MtfCurve(frequency[:65], gaussian_modulation(2.0, frequency[:65]))
        assert mean_curve([sharp, short]).frequency[-1] == pytest.approx(0.5)
        with pytest.raises(InputError):
            mean_curve([])

    def test_cells_of_the_field(self) -> None:
        assert field_cell(-0.5, -0.5, (300, 200), 3) == (0, 0)
        assert field_cell(299.4, 199.4, (300, 200), 3) == (2, 2)
        assert field_cell(99.6, 70.0, (300, 200), 3) == (1, 1)

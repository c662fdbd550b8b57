"""One edge measured: figures of ideal edges recovered at any angle and place, and intervals that hold the truth."""

from __future__ import annotations

from functools import cache
from math import cos, pi, radians, sin, sqrt

import numpy as np
import pytest
from tools.edges import TAILED, edge_image, gaussian, line_spread, modulation, true_fwhm, true_mtf50
from tools.thinned import some, thinned

from photoplan.quality.edges.line import PixelEdge
from photoplan.quality.edges.response import EdgeSettings, measure_edge

SNR = 50.0


def _edge(angle, spread, random, length=100, width=60):
    """Image of an edge at any place within a pixel, with noise."""
    middle = np.array([(width - 1) / 2, (length - 1) / 2]) + random.uniform(-0.5, 0.5, 2)
    if abs(cos(radians(angle))) > abs(sin(radians(angle))):
        image = edge_image((length, width), angle, tuple(middle), spread)
    else:
        image = edge_image((width, length), angle, tuple(middle[::-1]), spread)
    return image + random.normal(0.0, 1.0 / SNR, image.shape)


def test_the_closed_profile_is_that_of_the_integrated_pixel():
    x = np.linspace(-4.0, 4.0, 161)
    for angle in (0.0, 0.05, 12.0, 45.0, 80.0, 90.0):
        model = PixelEdge(0.4, radians(angle))
        _, spread, tilt = model.profile(x)
        assert spread == pytest.approx(line_spread(x, angle, gaussian(0.4)), abs=1e-7)
        step = 1e-4
        assert spread == pytest.approx((model.profile(x + step)[0] - model.profile(x - step)[0]) / 2 / step, abs=1e-6)
        assert tilt == pytest.approx((model.profile(x + step)[1] - model.profile(x - step)[1]) / 2 / step, abs=1e-5)
        f = np.linspace(0.0, 1.0, 21)
        assert np.abs(model.transfer(f)) == pytest.approx(modulation(f, angle, gaussian(0.4)), abs=1e-12)


@pytest.mark.parametrize("angle", [5.0, 33.0, 84.0, 187.0, 265.0])
@pytest.mark.parametrize("spread", [gaussian(0.7), TAILED], ids=["gaussian", "tailed"])
def test_without_much_noise_nothing_is_biased(angle, spread):
    image = edge_image((90, 90), angle, (44.3, 45.1), spread, (20.0, 180.0))
    image += np.random.default_rng(3).normal(0.0, 0.02, image.shape)
    edge = measure_edge(image, origin=(100.0, 200.0))
    assert edge.mtf50 == pytest.approx(true_mtf50(angle, spread), rel=1e-3)
    assert edge.fwhm == pytest.approx(true_fwhm(angle, spread), rel=2e-3)
    f = edge.mtf.frequency
    assert edge.mtf.modulation[f <= 0.7] == pytest.approx(modulation(f[f <= 0.7], angle, spread), abs=3e-3)
    assert (edge.angle_deg - angle + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.01)
    assert edge.dark == pytest.approx(20.0, abs=0.1) and edge.bright == pytest.approx(180.0, abs=0.1)
    assert edge.sampling == "super-sampled" and edge.direction == ("x" if abs(cos(radians(angle))) > 0.7 else "y")


@thinned("count", 80, 300)
def test_figures_and_intervals_of_many_edges(count):
    """Edges of 60 × 100 pixels: any angle, any place, any width; the issue's bounds as root mean squares."""
    random = np.random.default_rng(2024)
    errors, covered, limits = [], [], []
    for _ in range(count):
        angle, spread = random.uniform(0.0, 360.0), gaussian(random.uniform(0.35, 1.1))
        edge = measure_edge(_edge(angle, spread, random))
        truth = true_mtf50(angle, spread), true_fwhm(angle, spread)
        errors.append([edge.mtf50 / truth[0] - 1.0, edge.fwhm / truth[1] - 1.0])
        covered.append(
            [
                edge.mtf50_interval[0] <= truth[0] <= edge.mtf50_interval[1],
                edge.fwhm_interval[0] <= truth[1] <= edge.fwhm_interval[1],
            ]
        )
        limits.append(_least_error(spread.parts[0][2], edge.length))
    error = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    share, bias = np.mean(covered, axis=0), np.mean(errors, axis=0)
    best = sqrt(np.mean(np.square(limits)))
    print(f"MTF50: rms {error[0]:.4f} bias {bias[0]:.4f} covered {share[0]:.3f}; least possible {best:.4f}")
    print(f"FWHM: rms {error[1]:.4f} bias {bias[1]:.4f} covered {share[1]:.3f}")
    assert error[0] < 0.015 and error[1] < 0.01
    assert np.abs(bias).max() < 0.002
    assert (share >= 0.90).all() and (share <= 0.98).all()
    assert error[0] < 1.35 * best


def _least_error(blur, length):
    """Cramér-Rao bound of the relative error of a Gaussian's width from an edge with known place and levels.

    The information of ∂E/∂s = −(x/s²) φ(x/s), summed over length · dx pixels, is length / (4 √π s) / noise².
    """
    width = sqrt(blur**2 + 1.0 / 12.0)
    return sqrt(4.0 * sqrt(pi) / (SNR**2 * length * width))


@pytest.mark.slow
def test_long_edges_reach_the_bounds_one_by_one():
    random = np.random.default_rng(8)
    worst = np.zeros(2)
    for angle in random.uniform(0.0, 360.0, 5):
        spread = gaussian(0.7)
        edge = measure_edge(_edge(angle, spread, random, length=800, width=400))
        error = [edge.mtf50 / true_mtf50(angle, spread) - 1.0, edge.fwhm / true_fwhm(angle, spread) - 1.0]
        worst = np.maximum(worst, np.abs(error))
    print(f"largest errors of single edges of 560 pixels and more: MTF50 {worst[0]:.4f}, FWHM {worst[1]:.4f}")
    assert worst[0] < 0.015 and worst[1] < 0.01


@cache
def _with_tails(length, number):
    """Errors of MTF50 and FWHM of edges with coma and stray light out to 12 pixels, and whether intervals hold them."""
    random = np.random.default_rng(3)
    errors, covered = [], []
    for _ in range(number):
        angle = random.uniform(3.0, 12.0) + 180.0 * random.integers(2)
        edge = measure_edge(_edge(angle, TAILED, random, length=length, width=60 + length // 5))
        truth = true_mtf50(angle, TAILED), true_fwhm(angle, TAILED)
        errors.append([edge.mtf50 / truth[0] - 1.0, edge.fwhm / truth[1] - 1.0])
        covered.append([edge.mtf50_interval[0] <= truth[0] <= edge.mtf50_interval[1]])
    error = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    print(f"tails, {length} pixels: rms MTF50 {error[0]:.4f} FWHM {error[1]:.4f}, MTF50 covered {np.mean(covered):.2f}")
    return error, float(np.mean(covered))


@pytest.mark.slow
def test_edges_with_tails_reach_the_bounds_from_800_pixels_on():
    error, covered = _with_tails(800, 12)
    assert error[0] < 0.015 and error[1] < 0.01 and covered > 0.8


@pytest.mark.slow
def test_short_edges_with_tails_reach_the_bound_of_mtf50():
    error, covered = _with_tails(100, 60)
    assert error[0] < 0.015 and covered >= 0.88


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="2 %: noise on 100 px hides a form that is neither Gaussian nor even")
def test_short_edges_with_tails_reach_the_bound_of_fwhm():
    assert _with_tails(100, 60)[0][1] < 0.01


@pytest.mark.parametrize("angle", some([0.0, 90.0, 180.0, 270.0, 45.0], 1, 4))
@thinned("edges", 5, 20)
def test_an_edge_along_the_pixels_says_that_its_phases_are_few(angle, edges):
    random = np.random.default_rng(int(angle))
    spread = gaussian(0.8)
    errors = []
    for _ in range(edges):
        edge = measure_edge(_edge(angle, spread, random))
        errors.append([edge.mtf50 / true_mtf50(angle, spread) - 1.0, edge.fwhm / true_fwhm(angle, spread) - 1.0])
        assert edge.sampling == "few phases"
        assert edge.phase_gap == pytest.approx(1.0 if angle != 45.0 else sqrt(0.5), abs=0.1)
        assert edge.mtf.frequency[-1] == pytest.approx(0.5 / edge.phase_gap)
        if angle != 45.0:
            places, values, sigma = edge.samples.positions, edge.samples.values, edge.samples.sigma
            assert np.diff(places) == pytest.approx(1.0, abs=0.01)
            # The adjusted place of the edge is not that of the optics to a thousandth: compare by the fitted profile.
            fitted = np.interp(places, edge.esf.positions, edge.esf.values)
            assert np.mean(np.abs(values - fitted)[1:-1] < 4.0 * sigma[1:-1] + 0.002) > 0.95
    error = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    print(f"{angle}°: rms MTF50 {error[0]:.4f} FWHM {error[1]:.4f}")
    assert error[0] < 0.015 and error[1] < 0.01


def test_edge_enhancement_is_seen_and_its_absence_too():
    random = np.random.default_rng(4)
    plain = measure_edge(_edge(8.0, gaussian(0.7), random))
    assert plain.overshoot < 3.0 * plain.overshoot_sigma + 0.01
    sharp = TAILED.__class__(((1.5, 0.0, 0.7), (-0.5, 0.0, 1.4)))
    enhanced = measure_edge(_edge(8.0, sharp, random))
    x = np.linspace(-8.0, 8.0, 1601)
    profile = np.cumsum(line_spread(x, 8.0, sharp)) * 0.01
    assert enhanced.overshoot == pytest.approx(profile.max() - 1.0, abs=0.01)
    assert enhanced.undershoot == pytest.approx(-profile.min(), abs=0.01)
    assert enhanced.overshoot > 5.0 * enhanced.overshoot_sigma


def test_polarity_transposition_and_scale_do_not_matter():
    image = _edge(7.0, gaussian(0.7), np.random.default_rng(6))
    one = measure_edge(image)
    for other in (image.T, image[:, ::-1], image[::-1], 100.0 - 30.0 * image, 1e-3 * image):
        assert measure_edge(other).mtf50 == pytest.approx(one.mtf50, rel=2e-4)


def test_masked_pixels_do_not_count():
    random = np.random.default_rng(9)
    image = _edge(7.0, gaussian(0.7), random)
    valid = np.ones(image.shape, bool)
    valid[20:30, 5:25] = False
    spoilt = np.where(valid, image, 40.0)
    holes = np.where(valid, image, np.nan)
    assert measure_edge(spoilt, valid).mtf50 == measure_edge(holes).mtf50
    assert measure_edge(holes).mtf50 == pytest.approx(measure_edge(image).mtf50, rel=0.01)


def test_photon_noise_is_weighted():
    """Without the weights of pixels the root mean square is 0.0062: the bright side is ten times as noisy."""
    random = np.random.default_rng(10)
    errors = []
    for _ in range(24):
        image = edge_image((100, 60), 7.0, (29.3, 50.0), gaussian(0.7), (20.0, 2000.0))
        edge = measure_edge(random.poisson(image).astype(float))
        errors.append(edge.mtf50 / true_mtf50(7.0, gaussian(0.7)) - 1.0)
    assert sqrt(np.mean(np.square(errors))) < 0.0053


def test_uneven_light_along_the_edge_is_taken_up():
    image = _edge(4.0, gaussian(0.7), np.random.default_rng(11))
    image *= 1.0 + 0.002 * np.arange(100)[:, None]
    assert measure_edge(image).mtf50 == pytest.approx(true_mtf50(4.0, gaussian(0.7)), rel=0.02)


def test_a_bent_edge_is_measured_as_a_parabola():
    rows, columns = np.mgrid[:200, :60].astype(float)
    t = rows - 99.5
    line = 29.5 + 0.08 * t + 2e-4 * t**2
    distance = (columns - line) / np.sqrt(1.0 + (0.08 + 4e-4 * t) ** 2)
    image = PixelEdge(0.6, np.arctan(0.08)).profile(distance)[0]
    image += np.random.default_rng(12).normal(0.0, 0.02, image.shape)
    edge = measure_edge(image, settings=EdgeSettings(curve=2))
    truth = true_mtf50(np.degrees(np.arctan(0.08)), gaussian(0.6))
    assert edge.mtf50_interval[0] < truth < edge.mtf50_interval[1]
    assert edge.straightness < 0.05

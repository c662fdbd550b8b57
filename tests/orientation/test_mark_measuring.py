"""One mark in a window: paraboloid, least-squares matching, round targets."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from tools.mark_scans import Simulated, ring_cross_pattern, simulate

from photoplan.errors import InputError
from photoplan.orientation.marks.locate import (
    fine_template,
    locate_mark,
    locate_target,
    match_template,
    paraboloid_peak,
)

PATTERN = ring_cross_pattern()


def window(
    seed: int, noise: float = 9.0, **more: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """A single mark on dark ground, the matrix that draws it, and its place."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.05, 0.05, 2)
    made = Simulated(marks={"m": (x, y)}, side=8.0, picture=0.0, noise=noise, **more)
    grey, truth = simulate(made, seed)
    t = np.radians(made.small_turn)
    matrix = np.array([[np.cos(t), np.sin(t)], [np.sin(t), -np.cos(t)]]) / made.pixel_mm
    return grey, matrix @ np.diag(1 + np.array(made.shrinkage)), *truth["m"]


def test_paraboloid_is_exact_on_a_paraboloid() -> None:
    Y, X = np.mgrid[:11, :13].astype(float)
    surface = 0.9 - 0.02 * (X - 6.3) ** 2 - 0.03 * (Y - 4.6) ** 2
    top = paraboloid_peak(surface, 5, 6)
    assert top is not None
    assert (top.x, top.y) == pytest.approx((6.3, 4.6), abs=1e-10)
    assert top.height == pytest.approx(0.9)
    assert max(top.sigma_x, top.sigma_y) < 1e-9


@pytest.mark.parametrize(("dx", "dy"), [(0.2, -0.1), (1.5, -1.3)])
def test_paraboloid_standard_deviations_tell_its_spread(dx: float, dy: float) -> None:
    rng = np.random.default_rng(2)
    Y, X = np.mgrid[:7, :7].astype(float)
    surface = 0.9 - 0.02 * (X - 3 - dx) ** 2 - 0.03 * (Y - 3 - dy) ** 2
    tops = [paraboloid_peak(surface + rng.normal(0, 0.002, surface.shape), 3, 3) for _ in range(400)]
    normalised = [((t.x - 3 - dx) / t.sigma_x, (t.y - 3 - dy) / t.sigma_y) for t in tops if t is not None]
    assert len(normalised) == 400
    assert 0.9 < np.std(normalised) < 1.1


@pytest.mark.parametrize("spoil", ["saddle", "border", "nan", "valley"])
def test_no_paraboloid_where_there_is_no_top(spoil: str) -> None:
    Y, X = np.mgrid[:9, :9].astype(float)
    surface = -((X - 4) ** 2) - (Y - 4) ** 2
    row = 4
    if spoil == "saddle":
        surface = -((X - 4) ** 2) + (Y - 4) ** 2
    elif spoil == "valley":
        surface = -surface
    elif spoil == "nan":
        surface[2, 3] = np.nan
    else:
        row = 1
    assert paraboloid_peak(surface, row, 4) is None


def test_without_noise_matching_is_exact_to_a_hundredth_of_a_pixel() -> None:
    for seed in range(5):
        grey, matrix, x, y = window(seed, noise=0.0, small_turn=1.3)
        at = locate_mark(grey, PATTERN, matrix, blur_px=0.8)
        assert at.method == "matching"
        assert (at.x, at.y) == pytest.approx((x, y), abs=0.01)
        assert at.peak is not None
        assert (at.peak.x, at.peak.y) == pytest.approx((x, y), abs=0.1)


def test_matching_begins_most_of_a_pixel_off_and_gain_and_uneven_brightness_do_not_matter() -> None:
    grey, matrix, x, y = window(3, noise=0.0)
    rows, columns = np.indices(grey.shape)
    uneven = 500 - 1.7 * grey + 0.8 * columns - 0.3 * rows
    template = fine_template(PATTERN, matrix, 0.8, negative=True)
    match = match_template(uneven, template, x + 0.7, y - 0.6)
    assert match is not None
    assert (match.x, match.y) == pytest.approx((x, y), abs=0.01)
    assert match.gain == pytest.approx(1.7 * 180, rel=0.02)


def test_normalised_errors_of_matching_spread_by_one() -> None:
    normalised = []
    for seed in range(60):
        grey, matrix, x, y = window(seed)
        at = locate_mark(grey, PATTERN, matrix, blur_px=0.8)
        normalised.append(((at.x - x) / at.sigma_x, (at.y - y) / at.sigma_y))
    assert 0.85 < np.sqrt(np.mean(np.square(normalised))) < 1.15


def test_grain_larger_than_a_pixel_is_told_by_the_standard_deviation() -> None:
    rng = np.random.default_rng(0)
    normalised, white = [], []
    for seed in range(60):
        grey, matrix, x, y = window(seed, noise=0.0)
        grain = ndimage.gaussian_filter(rng.normal(size=grey.shape), 1.0)
        grey = grey + 9 * grain / grain.std()
        match = match_template(grey, fine_template(PATTERN, matrix, 0.8, False), x, y)
        assert match is not None
        error = np.array([match.x - x, match.y - y])
        normalised.append(error / np.sqrt(np.diag(match.covariance)))
        white.append(error)
    assert 0.75 < np.sqrt(np.mean(np.square(normalised))) < 1.3
    # Were the grain taken as independent from pixel to pixel, errors would be three times as large as stated.
    alone = []
    for seed in range(20):
        grey, matrix, x, y = window(seed, noise=9.0)
        match = match_template(grey, fine_template(PATTERN, matrix, 0.8, False), x, y)
        assert match is not None
        alone.append(np.sqrt(np.diag(match.covariance)))
    assert np.sqrt(np.mean(np.square(white))) > 2 * np.mean(alone)


def test_matching_gives_nothing_where_there_is_no_mark() -> None:
    rng = np.random.default_rng(1)
    matrix = np.array([[10.0, 0], [0, -10.0]])
    template = fine_template(PATTERN, matrix, 0.8, False)
    found = [match_template(rng.normal(100, 9, (70, 70)), template, 34.0, 35.0) for _ in range(10)]
    assert sum(m is None or abs(m.correlation) < 0.3 for m in found) == 10
    assert match_template(np.full((70, 70), np.nan), template, 35.0, 35.0) is None


def test_near_limits_the_search() -> None:
    made = Simulated(marks={"a": (-3.0, 0.0), "b": (3.0, 0.0)}, side=14.0, picture=0.0)
    grey, truth = simulate(made, 1)
    matrix = np.array([[10.0, 0], [0, -10.0]])
    for x, y in truth.values():
        at = locate_mark(grey, PATTERN, matrix, near=(x + 1, y - 1, 4.0))
        assert (at.x, at.y) == pytest.approx((x, y), abs=0.2)


def disc(d: float, x: float, y: float, blur: float, n: int = 50) -> NDArray[np.float64]:
    fine = (np.arange(n * 8) + 0.5) / 8 - 0.5
    X, Y = np.meshgrid(fine, fine)
    share = (np.hypot(X - x, Y - y) <= d / 2).reshape(n, 8, n, 8).mean((1, 3))
    return np.asarray(ndimage.gaussian_filter(share, blur))


def test_round_targets_of_unknown_size_and_tone() -> None:
    rng = np.random.default_rng(0)
    errors, normalised, sizes = [], [], []
    for k in range(50):
        d, x, y = rng.uniform(4, 14), *(25 + rng.uniform(-6, 6, 2))
        grey = 40 + 120 * disc(d, x, y, rng.uniform(0.4, 1.2)) + rng.normal(0, 6, (50, 50))
        bright = bool(k % 2)
        target = locate_target(grey if bright else 255 - grey, bright=bright)
        at = target.location
        errors.append((at.x - x, at.y - y))
        normalised.append((errors[-1][0] / at.sigma_x, errors[-1][1] / at.sigma_y))
        sizes.append(target.diameter - d)
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert 0.75 < np.sqrt(np.mean(np.square(normalised))) < 1.25
    assert np.abs(sizes).max() < 0.7


@pytest.mark.parametrize(
    ("window_", "says"),
    [
        (np.full((30, 30), 7.0), "without variation"),
        (disc(10, 2.0, 15.0, 0.7), "border"),
        (np.random.default_rng(3).normal(0, 1, (40, 40)), "no round target|border|too small"),
        (np.pad(np.ones((3, 22)), 14), "no round target|border"),
    ],
)
def test_what_is_no_round_target_is_refused(window_: NDArray[np.float64], says: str) -> None:
    with pytest.raises(InputError, match=says):
        locate_target(window_)

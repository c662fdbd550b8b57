"""Siemens stars: centre, sectors and transfer recovered in all directions; equal to that of an edge; refusals."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from tools.patterns import bars, box_edge, formed, gauss_box, star
from tools.thinned import some, thinned

from photoplan.errors import InputError
from photoplan.quality.edges.response import measure_edge
from photoplan.quality.patterns.bars import StarRules, clipped_pixels, measure_star

TURN = np.linspace(0.0, pi, 180, endpoint=False)


def mean_transfer(sigma, frequency):
    """Over all directions: pixels are square."""
    return np.array([gauss_box(sigma)(f * np.cos(TURN), f * np.sin(TURN)).mean() for f in frequency])


def noisy_star(shape, centre, sectors, sigma, noise=2.0, seed=0, **options):
    picture = star(shape, centre, sectors, sigma, **options)
    return picture + np.random.default_rng(seed).normal(0.0, noise, picture.shape)


@pytest.mark.parametrize(
    ("shape", "centre", "sectors", "sigma", "sine"),
    some(
        [
            ((300, 300), (150.3, 148.8), 36, 0.6, False),
            ((300, 310), (140.1, 155.3), 36, 1.0, True),
            ((400, 400), (200.4, 199.8), 72, 0.6, False),
            ((300, 300), (150.3, 148.8), 25, 0.6, True),
            ((120, 120), (60.3, 61.0), 16, 0.6, False),
        ],
        4,
    ),
)
def test_star_recovers_centre_sectors_and_transfer(shape, centre, sectors, sigma, sine):
    found = measure_star(noisy_star(shape, centre, sectors, sigma, sine=sine))
    assert found.sectors == sectors
    assert found.wave == ("sine" if sine else "square")
    error = np.hypot(found.centre[0] - centre[0], found.centre[1] - centre[1])
    frequency = found.mtf.frequency[1:]
    part = frequency <= 0.5
    away = np.abs(found.mtf.modulation[1:] - mean_transfer(sigma, frequency))[part]
    print(f"centre {error:.3f} px; largest error of the MTF up to 0.5 cy/px {away.max():.4f}")
    assert error < 0.02
    assert away.max() < 0.01
    for angle, curve in found.directional.items():
        turn = np.deg2rad(angle)
        f = curve.frequency[1:]
        true = gauss_box(sigma)(f * np.cos(turn), f * np.sin(turn))
        rms = float(np.sqrt(np.mean((curve.modulation[1:] - true) ** 2)))
        assert rms < 0.012, (angle, rms)
    assert len(found.directional) == 8


@thinned("count", 6, 12)
def test_standard_deviations_are_those_of_repetition(count):
    runs = [measure_star(noisy_star((140, 140), (70.2, 69.6), 24, 0.7, 4.0, seed, over=4)) for seed in range(count)]
    values = np.array([run.mtf.modulation[1:] for run in runs])
    ratio = values.std(axis=0, ddof=1) / np.mean([run.mtf.sigma[1:] for run in runs], axis=0)
    print(f"scatter through stated standard deviation: median {np.median(ratio):.2f}")
    assert 0.6 < np.median(ratio) < 1.5


def test_directions_are_told_apart():
    """Blur along the rows only: frequencies along the rows are lost, those along the columns kept."""
    from scipy.ndimage import gaussian_filter1d

    picture = gaussian_filter1d(noisy_star((300, 300), (150.3, 148.8), 36, 0.5, 0.5), 1.2, axis=1)
    found = measure_star(picture).directional
    print(f"MTF50 at 0° {found[0.0].mtf50:.3f}, at 90° {found[90.0].mtf50:.3f}")
    blurred = 1.2**2 + 0.5**2
    f = found[0.0].frequency[1:15]
    assert found[0.0].modulation[1:15] == pytest.approx(np.exp(-2 * pi**2 * blurred * f**2) * np.sinc(f), abs=0.02)
    assert found[90.0].mtf50 > 1.7 * found[0.0].mtf50
    assert found[45.0].mtf50 == pytest.approx(found[135.0].mtf50, rel=0.03)


def test_binary_star_gives_the_transfer_of_an_edge():
    """The same blur at a slanted edge and in a star: both curves are equal within 2 %."""
    sigma = 0.7
    found = measure_star(noisy_star((300, 300), (150.3, 148.8), 36, sigma, 1.0)).directional[0.0]
    turn = np.deg2rad(5.0)
    edge = formed(lambda x, y: np.where((x - 30.2) * np.cos(turn) + (y - 40.0) * np.sin(turn) > 0, 200.0, 40.0),
                  (80, 60), sigma, 8)  # fmt: skip
    edge += np.random.default_rng(1).normal(0.0, 1.0, edge.shape)
    slanted = measure_edge(edge).mtf
    for f in (0.1, 0.2, 0.3):
        print(f"{f}: star {found.at(f):.4f}, edge {slanted.at(f):.4f}, true {float(gauss_box(sigma)(f, 0)):.4f}")
        assert found.at(f) == pytest.approx(slanted.at(f), abs=0.02)
    assert found.mtf50 == pytest.approx(slanted.mtf50, rel=0.02)


def test_given_sectors_levels_and_centre_are_used():
    picture = noisy_star((200, 200), (99.6, 101.2), 48, 0.8)
    rules = StarRules(sectors=48, wave="square", levels=(40.0, 200.0), centre=(101.0, 100.0), radius=95.0, directions=4)
    found = measure_star(picture, rules)
    assert np.hypot(found.centre[0] - 99.6, found.centre[1] - 101.2) < 0.02
    assert sorted(found.directional) == [0.0, 45.0, 90.0, 135.0]
    assert found.levels_from == "as given"


def edge_picture():
    x = np.arange(120) - 60.3
    return np.tile(40 + 160 * box_edge(x, 0.7), (120, 1)) + np.random.default_rng(0).normal(0, 2, (120, 120))


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (lambda: np.random.default_rng(0).normal(100, 10, (120, 120)), "star"),
        (lambda: edge_picture(), "star"),
        (lambda: bars((120, 120), 0.1, 20.0), "star"),
        (lambda: np.full((50, 50), 3.0), "no pattern"),
        (lambda: star((120, 120), (60, 60), 16)[:20], "at least 32"),
        (lambda: star((60, 60), (30, 30), 72, radius=26.0), r"(star|sectors)"),
    ],
)
def test_no_number_without_a_star(picture, message):
    with pytest.raises(InputError, match=message):
        measure_star(picture())


def test_clipped_stars_and_unknown_contrast_are_refused():
    picture = np.clip(noisy_star((140, 140), (70.2, 69.6), 24, 0.7) * 1.4, 0, 255).astype(np.uint8)
    with pytest.raises(InputError, match="saturated or clipped"):
        measure_star(picture, clipped=clipped_pixels(picture))
    with pytest.raises(InputError, match="no flat middle"):
        measure_star(noisy_star((160, 160), (80.2, 79.6), 72, 1.1, 0.5), StarRules(wave="square"))
    for wrong in ({"sectors": 2}, {"directions": 0}, {"highest": 3.0}, {"levels": (3.0, 1.0)}, {"radius": -1.0}):
        with pytest.raises(InputError):
            StarRules(**wrong)


@pytest.mark.parametrize("sine", some([False, True]))
def test_standard_deviations_hold_the_error_of_the_object_s_contrast(sine):
    """The widest rings know their wave far better than the level of the widest sectors that it is compared with."""
    shape, centre = (200, 200), (100.3, 98.8)
    clean = star(shape, centre, 24, 0.6, sine=sine)
    rows = np.random.default_rng(5)
    seen = [measure_star(clean + rows.normal(0.0, 12.0, shape)) for _ in range(12)]
    wide = (seen[0].mtf.frequency > 0.0) & (seen[0].mtf.frequency < 0.08)
    count = np.count_nonzero(wide)
    values = np.array([found.mtf.modulation[1 : count + 1] for found in seen])
    sigmas = np.array([found.mtf.sigma[1 : count + 1] for found in seen])
    ratio = values.std(axis=0, ddof=1) / sigmas.mean(axis=0)
    print("scatter in standard deviations:", ratio)
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3

"""Spread function from an edge profile: Kölbl 2006, table 1, and recovery of what made the profile."""

import numpy as np
import pytest
from tools.blurred_scenes import discrete_spread
from tools.edges import edge_image, gaussian
from tools.koelbl import normalised_edge, spread_from_edge

from photoplan.errors import InputError
from photoplan.quality.curves import SpreadFunction
from photoplan.quality.edges.response import measure_edge, spread_from_response, spread_of_edge

TABLE_1 = np.array([150.0, 148, 133, 67, 52, 50])


def test_koelbl_table_1():
    found = spread_from_edge(TABLE_1)
    print(dict(zip("ZAB", np.round(found.spread.side(), 4), strict=True)))
    assert np.round(normalised_edge(TABLE_1), 2) == pytest.approx([-1.0, -0.96, -0.66, 0.66, 0.96, 1.0])
    assert found.spread.side() == pytest.approx([0.66, 0.15, 0.02], abs=0.0005)
    assert (found.shift, found.border) == (0.0, 2)
    assert found.beyond == pytest.approx(0.0, abs=1e-12)


def test_rising_and_falling_edges_agree():
    assert spread_from_edge(TABLE_1[::-1]).spread.values == pytest.approx(spread_from_edge(TABLE_1).spread.values)


def edge(spread, shift, count=21, levels=(40.0, 200.0)):
    """Image of an object edge that lies `shift` pixels behind the border of pixels 9 and 10."""
    object_ = np.where(np.arange(count + 40) < 30, levels[0], levels[1]).astype(float)
    mixed = 30 if shift >= 0.0 else 29
    object_[mixed] += (levels[0] - levels[1]) * shift if shift >= 0.0 else (levels[1] - levels[0]) * -shift
    return np.convolve(object_, spread.values, mode="same")[20:-20]


@pytest.mark.parametrize("shift", [-0.5, -0.31, -0.05, 0.0, 0.2, 0.49])
def test_shift_and_spread_are_recovered_together(shift):
    spread = SpreadFunction.symmetric([0.61, 0.17, 0.02, 0.005])
    found = spread_from_edge(edge(spread, shift), half=4)
    # An edge half a pixel before a border is the one half a pixel behind the border before it.
    assert (found.border + found.shift - 9.0) == pytest.approx(shift, abs=1e-6)
    assert found.spread.side()[:4] == pytest.approx(spread.side(), abs=1e-6)
    assert found.residual < 1e-7


def test_asymmetric_spread_function():
    values = np.array([0.01, 0.12, 0.62, 0.2, 0.05])
    values = SpreadFunction.normalised(values)
    centroid = float(values.values @ np.arange(-2, 3))
    found = spread_from_edge(edge(values, 0.0), half=4, symmetric=False)
    assert found.shift == pytest.approx(centroid)
    assert found.spread.values @ np.arange(-4, 5) == pytest.approx(0.0, abs=0.01)
    assert found.spread.asymmetry > 0.02
    assert spread_from_edge(edge(values, 0.0), half=4).residual > 50 * found.residual


def test_stray_light_beyond_the_reach_is_named():
    tails = SpreadFunction.symmetric([0.6, 0.15, 0.02, 0.01, 0.01, 0.01])
    found = spread_from_edge(edge(tails, 0.0), (40.0, 200.0), half=2)
    # Twice 0.03 of 1.0 lie farther than two pixels; a part of it is taken for nearer light.
    assert 0.75 * 0.06 < found.beyond < 0.06


@pytest.mark.parametrize(
    ("profile", "word"),
    [
        ([5.0, 5, 5, 5, 5], "no edge"),
        ([5.0, 6, 7], "at least four"),
        ([5.0, 5, np.nan, 9, 9], "finite"),
        ([5.0, 5, 9, 9], None),
    ],
)
def test_what_is_no_edge(profile, word):
    if word is None:
        assert spread_from_edge(np.array(profile)).spread.half == 1
        return
    with pytest.raises(InputError, match=word):
        spread_from_edge(np.array(profile))


def test_reach_beyond_the_profile_is_refused():
    with pytest.raises(InputError, match="3 pixels before the edge"):
        spread_from_edge(TABLE_1, half=5)


def test_response_to_discrete_spread():
    position = np.linspace(-8.0, 8.0, 1601)
    # A triangle two pixels wide is a pixel's aperture over a box: its steps are 1/8, 6/8, 1/8.
    response = np.interp(position, np.linspace(-1, 1, 201), np.cumsum(1 - np.abs(np.linspace(-1, 1, 201))) / 100.0)
    spread, beyond = spread_from_response(position, response, 3, np.full(position.size, 0.01))
    assert spread.side() == pytest.approx([0.75, 0.125, 0.0, 0.0], abs=0.01)
    assert beyond == pytest.approx(0.0, abs=1e-9)
    assert spread.sigma == pytest.approx(0.01 * np.sqrt(2.0))
    with pytest.raises(InputError, match=r"known from -8\.0 to 8\.0"):
        spread_from_response(position, response, 8)


@pytest.mark.parametrize(("angle", "phase", "bound"), [(6.0, 0.0, 0.005), (96.0, 0.3, 0.005), (0.0, 0.2, 0.015)])
def test_shares_of_measured_edges(angle, phase, bound):
    """Slanted edges at any place; edges along the pixels near the border of two of them."""
    found, measured = shares(angle, phase)
    assert found == pytest.approx(discrete_spread(0.5).side()[:3], abs=bound)
    assert measured.sampling == ("super-sampled" if angle else "few phases")


def test_an_edge_in_the_middle_of_pixels_says_that_it_is_not_sampled():
    """What lies between its samples is a model: its shares are not those of the truth, and it is flagged."""
    found, measured = shares(180.0, 0.5)
    assert measured.sampling == "few phases"
    assert found[0] == pytest.approx(0.61, abs=0.15)


def shares(angle, phase):
    pixels = edge_image((60, 60), angle, (29.5 + phase, 29.5 + phase), gaussian(0.5))
    pixels += np.random.default_rng(3).normal(0.0, 1 / 200, pixels.shape)
    measured = measure_edge(pixels)
    found = spread_of_edge(measured).spread.side()[:3]
    print(angle, phase, np.round(found, 4))
    return found, measured


@pytest.mark.parametrize("side", [[0.61, 0.17, 0.02, 0.005], [0.7, 0.13, 0.02], [0.5, 0.2, 0.05]])
@pytest.mark.parametrize("shift", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
def test_intervals_cover_edges_that_lie_inside_a_pixel(side: list[float], shift: float) -> None:
    """Kölbl's discrete model: one pixel of the object is mixed, then all are spread. The MTF50 is known."""
    spread = np.array([*side[:0:-1], *side])
    spread /= spread.sum()
    frequency = np.linspace(0.0, 0.5, 5001)
    reach = np.arange(len(spread)) - len(spread) // 2
    modulation = np.cos(2.0 * np.pi * np.multiply.outer(frequency, reach)) @ spread
    true = float(frequency[np.flatnonzero(modulation < 0.5)[0]])
    profile = np.convolve([1.0] * 40 + [shift] + [0.0] * 39, spread, "same")
    profile[:4], profile[-4:] = 1.0, 0.0
    image = 5000.0 + 10000.0 * np.repeat(profile[None], 64, axis=0)
    image += np.random.default_rng(5).normal(0.0, 20.0, image.shape)
    low, high = measure_edge(image).mtf50_interval
    assert low <= true <= high
    # What an interval that holds everything would hold as well is no information.
    assert low > 0.5 * true

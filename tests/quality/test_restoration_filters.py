"""Exact inverses and restoration filters: the printed figures of Kölbl 2006 and Ecker 1991, and their mathematics."""

import numpy as np
import pytest
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.curves import SpreadFunction, gaussian_modulation
from photoplan.quality.restoration.design import (
    BAND_ROWS,
    aperture_filter,
    band_matrix,
    condition_of,
    exact_inverse,
    point_spread,
    radial_filter,
    separable_filter,
)
from photoplan.quality.restoration.restorer import FilterKernel

# Kölbl 2006, figures 4 and 6: the octant's rows from the centre outwards, [distance down][distance right].
FIGURE_4 = [
    [3.011, -0.298, 0.017, 0.030, -0.030, -0.006],
    [-0.298, -0.169, 0.020, 0.020, -0.027, -0.006],
    [0.017, 0.020, 0.028, -0.007, -0.019, -0.004],
    [0.030, 0.020, -0.007, -0.024, -0.006, -0.001],
    [-0.030, -0.027, -0.019, -0.006, -0.002, 0.000],
    [-0.006, -0.006, -0.004, -0.001, 0.000, 0.000],
]
FIGURE_6 = [
    [5.105, -0.597, -0.090, 0.064, -0.005, -0.004],
    [-0.597, -0.389, -0.053, 0.053, -0.005, -0.004],
    [-0.090, -0.053, 0.037, 0.022, -0.004, -0.002],
    [0.064, 0.053, 0.022, -0.004, -0.004, -0.001],
    [-0.005, -0.005, -0.004, -0.004, -0.001, 0.000],
    [-0.004, -0.004, -0.002, -0.001, 0.000, 0.000],
]
SUMS_4 = [2.437, -0.620, 0.055, -0.005, -0.138, -0.027]
SUMS_6 = [3.842, -1.391, -0.091, 0.194, -0.033, -0.018]
# Ecker 1991, eq. 4.5 and 4.6 (He 1989), quadrants from the corner to the centre.
ROUND = [
    [0.000, 0.000, 0.000, -0.001, 0.008],
    [0.000, 0.000, 0.000, 0.001, -0.013],
    [0.000, 0.000, 0.001, -0.003, 0.027],
    [-0.001, 0.001, -0.003, 0.009, -0.088],
    [0.008, -0.013, 0.027, -0.088, 1.256],
]
SQUARE = [
    [0.000, 0.000, 0.000, -0.001, 0.012],
    [0.000, 0.000, -0.001, 0.002, -0.020],
    [0.000, -0.001, 0.001, -0.004, 0.040],
    [-0.001, 0.002, -0.004, 0.011, -0.124],
    [0.012, -0.020, 0.040, -0.124, 1.342],
]


def whole(quadrant, corner_first=False):
    part = np.array(quadrant)[::-1, ::-1] if corner_first else np.array(quadrant)
    rows = np.concatenate([part[:0:-1], part])
    return np.concatenate([rows[:, :0:-1], rows], axis=1)


def both_sides(side):
    return np.concatenate([side[:0:-1], side])


def test_centre_of_the_five_element_inverse():
    inverse = exact_inverse(SpreadFunction.symmetric([0.66, 0.15, 0.02]), 2, 5)
    print("centre", inverse[2])
    assert inverse[2] == pytest.approx(1.686, abs=0.0005)
    assert exact_inverse(SpreadFunction.symmetric([0.66, 0.15, 0.02]))[5] == pytest.approx(1.686, abs=0.0005)


@pytest.mark.parametrize(("figure", "sums"), [(FIGURE_4, SUMS_4), (FIGURE_6, SUMS_6)])
def test_printed_filters_follow_from_their_row_sums(figure, sums):
    """Distances rounded to two digits give every printed coefficient; the rows add up to the printed sums."""
    kernel = radial_filter(both_sides(np.array(sums)), distance_digits=2)
    print("largest difference", np.abs(kernel - whole(figure)).max())
    # The printed sums carry half a unit of the third digit each, which adds up over a row.
    assert kernel == pytest.approx(whole(figure), abs=0.0015)
    assert kernel.sum(axis=0) == pytest.approx(both_sides(np.array(sums)), abs=1e-12)
    assert whole(figure).sum(axis=0) == pytest.approx(both_sides(np.array(sums)), abs=0.0045)


@pytest.mark.parametrize(("sums", "total"), [(SUMS_4, 0.967), (SUMS_6, 1.164)])
def test_printed_row_sums_are_the_inverse_of_a_spread_function(sums, total):
    """The program finds the spread function whose exact inverse they are. Figure 6 adds up to 1.164 as printed."""
    printed = both_sides(np.array(sums))
    assert printed.sum() == pytest.approx(total, abs=0.002)
    spread = spread_of_inverse(printed)
    print("spread function", np.round(spread.side()[:6], 4), "sum", spread.values.sum())
    assert spread.asymmetry < 1e-12
    assert spread.values.sum() == pytest.approx(1.0)
    assert condition_of(spread).holds
    assert exact_inverse(spread) * total == pytest.approx(printed, abs=0.002)


@pytest.mark.parametrize(("shape", "printed", "bound"), [("square", SQUARE, 0.002), ("round", ROUND, 0.013)])
def test_apertures_of_scanners(shape, printed, bound):
    """Asked is 0.02; the round one is printed before its division by 1.009."""
    kernel = aperture_filter(shape)
    print(shape, "largest difference", np.abs(kernel - whole(printed, True)).max())
    assert kernel == pytest.approx(whole(printed, True), abs=bound)
    assert kernel.sum() == pytest.approx(1.0)
    undivided = kernel * {"square": 1.0, "round": 1.00914}[shape]
    assert undivided == pytest.approx(whole(printed, True), abs=0.002)


def test_aperture_filters_undo_apertures():
    """A wave that an aperture has weakened comes back, up to what 21 values can hold."""
    for shape, ratio in (("square", 0.6), ("square", 1.4), ("round", 1.3)):
        kernel = aperture_filter(shape, ratio, 10)
        offsets = np.arange(-10, 11)
        for frequency in (0.1, 0.25, 0.4):
            gain = float(np.cos(2 * np.pi * frequency * offsets) @ kernel.sum(axis=0))
            left = np.sinc(ratio * frequency) if shape == "square" else round_transfer(ratio * frequency)
            assert gain * left == pytest.approx(1.0, abs=0.03)


def round_transfer(x):
    """Transfer of a disc of diameter 1 by integration of its chords."""
    s = np.linspace(-0.5, 0.5, 20001)
    chord = 2.0 * np.sqrt(0.25 - s**2)
    return float(np.trapezoid(chord * np.cos(2 * np.pi * x * s), s) / np.trapezoid(chord, s))


@pytest.mark.parametrize(("shape", "ratio"), [("square", 2.0), ("round", 1.9), ("square", 0.0), ("round", -1.0)])
def test_apertures_that_lose_frequencies_are_refused(shape, ratio):
    with pytest.raises(InputError, match="aperture"):
        aperture_filter(shape, ratio)


@pytest.mark.parametrize("side", [[0.66, 0.15, 0.02], [0.61, 0.17, 0.02], [0.8, 0.1], [0.44, 0.19, 0.07, 0.01]])
def test_inverse_and_spread_function_are_a_pair(side):
    spread = SpreadFunction.symmetric(side)
    inverse = exact_inverse(spread, 25)
    one = np.convolve(spread.values, inverse)
    middle = one.size // 2
    assert one[middle] == pytest.approx(1.0, abs=1e-9)
    assert np.abs(np.delete(one, middle)).max() < 1e-4
    again = spread_of_inverse(inverse, spread.half)
    assert again.values == pytest.approx(spread.values, abs=1e-4)


def test_band_matrix_is_a_convolution():
    spread = SpreadFunction.normalised([0.02, 0.15, 0.6, 0.19, 0.04])
    object_ = np.random.default_rng(3).uniform(0, 255, 61)
    image = np.convolve(object_, spread.values, mode="same")
    assert band_matrix(spread) @ object_ == pytest.approx(image)
    restored = np.convolve(image, exact_inverse(spread, 15), mode="same")
    assert restored[17:-17] == pytest.approx(object_[17:-17], abs=1e-3)
    assert np.abs(image - object_).max() > 50.0


@pytest.mark.parametrize(("ratio", "holds"), [(0.3, True), (0.49, True), (0.5, False), (0.7, False)])
def test_koelbls_condition(ratio, holds):
    condition = condition_of(SpreadFunction.symmetric([1.0, ratio]))
    print(condition)
    assert condition.neighbour_ratio == pytest.approx(ratio)
    assert condition.holds is holds
    if ratio <= 0.5:
        assert condition.least_transfer == pytest.approx((1 - 2 * ratio) / (1 + 2 * ratio), abs=1e-9)
        assert condition.at_frequency == (0.5 if ratio > 0 else 0.0)


def test_singular_values_tell_what_the_ratio_does_not():
    """A < Z/2, and yet a frequency is lost: the transfer at 0.5 cycles/pixel is Z - 2A + 2B."""
    condition = condition_of(SpreadFunction.symmetric([0.5, 0.2, -0.05]))
    assert condition.neighbour_ratio < 0.5
    assert condition.least_transfer < 1e-9
    assert not condition.holds


def test_filters_whose_axes_differ():
    across = exact_inverse(SpreadFunction.symmetric([0.66, 0.15, 0.02]))
    along = exact_inverse(SpreadFunction.symmetric([0.55, 0.2, 0.025]))
    across, along = across / across.sum(), along / along.sum()
    kernel = radial_filter(across, along)
    assert kernel.sum(axis=0) == pytest.approx(across)
    assert kernel.sum(axis=1) == pytest.approx(along)
    assert kernel == pytest.approx(kernel[::-1, ::-1])
    assert radial_filter(along, across) == pytest.approx(kernel.T)
    assert radial_filter(across) == pytest.approx(radial_filter(across).T)


def test_noise_gain_of_the_radial_filter_is_below_that_of_the_product():
    inverse = exact_inverse(SpreadFunction.symmetric([0.61, 0.17, 0.02]))
    radial, product = FilterKernel(radial_filter(inverse)), FilterKernel(separable_filter(inverse))
    assert radial.noise_gain < 0.7 * product.noise_gain
    assert product.noise_gain == pytest.approx(float((inverse**2).sum()))


@pytest.mark.parametrize(
    ("x", "y", "word"),
    [
        ([0.1, 1.0, 0.2], None, "not symmetric"),
        ([0.1, 0.8, 0.1], [0.1, 0.9, 0.1], "add up"),
        ([0.1, 0.8, 0.1], [0.0, 0.1, 0.8, 0.1, 0.0], "odd number"),
    ],
)
def test_inverses_that_give_no_filter(x, y, word):
    with pytest.raises(InputError, match=word):
        radial_filter(np.array(x), None if y is None else np.array(y))


def test_gaussian_widths():
    """Half of the maximum lies half the width from the centre, and the second moment gives the width back."""
    frequency = np.array([0.0, 0.1, 0.3])
    sigma = 2.0 / 2.3548200450309493
    assert gaussian_modulation(2.0, frequency) == pytest.approx(np.exp(-2 * (np.pi * sigma * frequency) ** 2))
    offsets = np.arange(-12, 13)
    sampled = SpreadFunction.normalised(np.exp(-(offsets**2) / (2 * 1.3**2)))
    assert sampled.gaussian_fwhm() == pytest.approx(1.3 * 2.3548200450309493, rel=1e-6)


def test_point_spread_functions_have_the_sums_that_were_measured():
    x, y = SpreadFunction.symmetric([0.66, 0.15, 0.02]), SpreadFunction.symmetric([0.55, 0.2, 0.02, 0.005])
    both = point_spread(x, y)
    assert both.shape == (7, 7)
    assert both.sum(axis=0)[1:-1] == pytest.approx(x.values)
    assert both.sum(axis=1) == pytest.approx(y.values)
    assert both.sum() == pytest.approx(1.0)


def spread_of_inverse(inverse: NDArray[np.float64], half: int = 20) -> SpreadFunction:
    """The spread function whose exact inverse is a given one-dimensional filter.

    Parameters
    ----------
    inverse : ndarray, shape (2 n + 1,)
        Such as the row sums of a two-dimensional restoration filter; divided by its sum first.
    half : int
        How many pixels of the spread function are kept to each side.

    Raises
    ------
    InputError
        The filter suppresses a frequency wholly: it is no inverse.
    """
    filter_ = SpreadFunction.normalised(inverse)
    if condition_of(filter_).least_transfer < 1e-6:
        raise InputError("the filter suppresses a frequency wholly: it is not the inverse of a spread function")
    return SpreadFunction.normalised(exact_inverse(filter_, half, max(BAND_ROWS, 8 * half + 1)))

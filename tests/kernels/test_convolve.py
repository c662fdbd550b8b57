"""Convolution against a plain sum, rounding with its counts, and mirroring in the nearest valid pixel."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.jit import COMPILED
from photoplan.kernels.raster import round_clipped
from photoplan.quality.restoration.restorer import LEFT, RIGHT, Convolution, FilterKernel, Margin

NONE = np.empty((0, 0), bool)
ROUNDING = 2e-7
"""Of a float32 sum, per row and column of a kernel."""


def plain_convolution(image, values):
    """The definition, term by term: weight (i, k) belongs to the pixel i rows above and k columns left."""
    m, n = (side // 2 for side in values.shape)
    height, width = image.shape[0] - 2 * m, image.shape[1] - 2 * n
    total = np.zeros((height, width))
    for i in range(-m, m + 1):
        for k in range(-n, n + 1):
            total += values[m + i, n + k] * image[m - i : m - i + height, n - k : n - k + width]
    return total


def padded(image):
    return np.pad(image.astype(np.float32), ((0, 0), (LEFT, RIGHT)))


def convolved(image, values, margin):
    convolution = Convolution(FilterKernel(values))
    out = np.empty((image.shape[0] - 2 * margin[1], image.shape[1] - 2 * margin[0]), np.float32)
    assert convolution(padded(image), margin, out) == (0, 0)
    return out


def even(values):
    both = values + values[::-1]
    return both + both[:, ::-1]


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (3, 9), (9, 3), (1, 7), (5, 1), (11, 11), (13, 15)])
@pytest.mark.parametrize("symmetric", [False, True])
def test_convolution_is_the_plain_sum(shape, symmetric):
    rng = np.random.default_rng(shape[0] * 100 + shape[1])
    values = rng.normal(size=shape)
    values = even(values) if symmetric else values
    m, n = (side // 2 for side in shape)
    image = rng.uniform(0, 65535, (7 + 2 * m, 70 + 2 * n))
    assert Convolution(FilterKernel(values)).even == (symmetric or shape == (1, 1))
    made = convolved(image, values, (n, m))
    bound = ROUNDING * sum(shape) * np.abs(values).sum() * 65535
    np.testing.assert_allclose(made, plain_convolution(image.astype(np.float32), values), atol=bound, rtol=0)


def test_a_margin_wider_than_the_kernel_changes_nothing():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 5))
    image = rng.uniform(0, 255, (20, 30))
    assert np.array_equal(convolved(image, values, (4, 3)), convolved(image[2:-2, 2:-2], values, (2, 1)))
    with pytest.raises(UsageError, match="a margin of"):
        convolved(image, values, (1, 1))


def test_values_that_differ_by_rounding_alone_count_as_symmetric():
    values = even(np.random.default_rng(0).normal(size=(5, 5)))
    values[0, 0] *= 1 + 1e-15
    assert Convolution(FilterKernel(values)).even
    values[0, 0] += 1e-3
    assert not Convolution(FilterKernel(values)).even


@pytest.mark.skipif(not COMPILED, reason="a large picture")
def test_the_widest_kernel_of_all():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(101, 101)) / 101
    image = rng.uniform(0, 255, (102, 103))
    made = convolved(image, values, (50, 50))
    np.testing.assert_allclose(
        made, plain_convolution(image, values), atol=ROUNDING * 202 * np.abs(values).sum() * 255, rtol=0
    )


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16"])
def test_rounding_is_to_the_nearest_and_clipping_is_counted(dtype):
    limits = np.iinfo(dtype)
    low, high = float(limits.min), float(limits.max)
    given = [2.5, 3.4999998, 0.49999997, 7.0, high, high + 0.4, high + 0.5, high + 1e6, low - 0.4, low - 0.6, low - 1e9]
    values = np.array([given], np.float32)
    # Near the end of sixteen bits float32 knows steps of 1/256, which all of these are.
    out = np.empty(values.shape, dtype)
    below, above = round_clipped(values, NONE, (low, high), out)
    assert out[0].tolist() == [3, 3, 0, 7, *[int(high)] * 4, *[int(low)] * 3]
    assert (below, above) == (2, 2)
    valid = np.ones(values.shape, bool)
    valid[0, -1] = False
    assert round_clipped(values, valid, (low, high), out) == (1, 2)


def test_negative_halves_are_rounded_away_from_zero():
    out = np.empty((1, 4), np.int16)
    round_clipped(np.array([[-0.5, -1.5, -2.49, 0.5]], np.float32), NONE, (-32768.0, 32767.0), out)
    assert out[0].tolist() == [-1, -2, -2, 1]


def plain_extension(image, valid, reach):
    """The rule in words: nearest valid pixels within reach; mirrored, averaged across a gap, or repeated."""
    out = np.where(valid, image, 0.0)
    height, width = image.shape

    def known(y, x):
        return 0 <= y < height and 0 <= x < width and valid[y, x]

    for y, x in np.argwhere(~valid):
        near = [
            (dy * dy + dx * dx, dy, dx)
            for dy in range(-reach[1], reach[1] + 1)
            for dx in range(-reach[0], reach[0] + 1)
            if known(y + dy, x + dx)
        ]
        values = []
        for squared, dy, dx in near:
            if squared > min(near)[0]:
                continue
            value = image[y + dy, x + dx]
            if not known(y - dy, x - dx) and known(y + 2 * dy, x + 2 * dx):
                value = 2 * value - image[y + 2 * dy, x + 2 * dx]
            values.append(value)
        if values:
            out[y, x] = np.mean(values)
    return out


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_extension_is_the_rule_in_words(share):
    rng = np.random.default_rng(3)
    image = rng.uniform(0, 255, (14, 17)).astype(np.float32)
    valid = rng.random(image.shape) > share
    margin = Margin(3, 2)
    # The frame around the window stands for the image beyond it; nothing outside of it is known.
    frame = np.pad(image, ((2, 2), (3, 3))), np.pad(valid, ((2, 2), (3, 3)))
    made = margin.source(Window(0, 0, 17, 14), image[None], Window(0, 0, 17, 14), valid)[0]
    np.testing.assert_allclose(made[:, LEFT:-RIGHT], plain_extension(*frame, (3, 2)), rtol=1e-6, atol=1e-4)
    assert (made[:, :LEFT] == 0).all() and (made[:, -RIGHT:] == 0).all()

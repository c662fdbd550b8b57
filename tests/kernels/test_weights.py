"""Weights of the kernels, against the textbook formulas."""

from __future__ import annotations

import kernel_reference as twin
import numpy as np
import pytest

from photoplan.kernels.weights import KERNELS, TABLE_STEPS, weight_function, weight_table

FRACTIONS = np.linspace(0, 1, 501)
TAPS = {"nearest": 1, "bilinear": 2, "bicubic": 4, "bicubic-1": 4, "lanczos3": 6}


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "nearest"])
def test_polynomials_are_the_textbook_weights(name):
    kernel = KERNELS[name]
    offsets = np.arange(kernel.taps) - kernel.taps // 2 + 1
    for fraction in FRACTIONS[::10]:
        expected = [twin.normalised(name, fraction - offset) for offset in offsets]
        np.testing.assert_allclose(kernel.weights(fraction), expected, atol=1e-8)
        raw = [twin.weight(name, fraction - offset) for offset in offsets]
        np.testing.assert_allclose(weight_function(name, fraction - offsets), raw, atol=1e-14)


@pytest.mark.parametrize("name", KERNELS)
def test_weights_add_up_to_one_and_are_symmetric(name):
    kernel = KERNELS[name]
    weights = kernel.weights(FRACTIONS)
    assert kernel.taps == TAPS[name]
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0, atol=1e-13)
    np.testing.assert_allclose(weights, weights[::-1, ::-1], atol=1e-13)


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "nearest"])
def test_whole_positions_return_the_pixel(name):
    kernel = KERNELS[name]
    expected = np.zeros(kernel.taps)
    expected[kernel.taps // 2 - 1] = 1
    np.testing.assert_allclose(kernel.weights(0.0), expected, atol=1e-8)


@pytest.mark.parametrize("name", [name for name in KERNELS if name != "nearest"])
def test_table_for_widened_kernels(name):
    table = weight_table(name)
    distance = np.random.default_rng(0).uniform(0, twin.SUPPORT[name], 2000)
    step = np.floor(distance * TABLE_STEPS).astype(int)
    part = distance * TABLE_STEPS - step
    found = table[step] * (1 - part) + table[step + 1] * part
    np.testing.assert_allclose(found, [twin.normalised(name, each) for each in distance], atol=3e-7)


def test_weights_are_constants():
    with pytest.raises(ValueError, match="read-only"):
        KERNELS["bicubic"].coefficients[0, 0] = 7

"""Figures as they are printed: digits by their standard deviation, no powers of ten without need."""

from __future__ import annotations

import math

import pytest

from photoplan.products.characterise.result import Figure


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (13710.4, 223.0, "13710 ± 220"),
        (0.76, 0.00037, "0.76000 ± 0.00037"),
        (31.0, 1.2, "31.0 ± 1.2"),
        (1.77218, 0.00091, "1.77218 ± 0.00091"),
        (5.0, math.nan, "5"),
        (1.234e-6, 1.1e-8, "1.234e-06 ± 1.1e-08"),
    ],
)
def test_digits_follow_the_standard_deviation(value: float, sigma: float, text: str):
    assert str(Figure("x", value, sigma, "x")) == f"x: {text}"

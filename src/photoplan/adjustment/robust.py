"""Scales that gross errors hardly move, weights that fall with the size of a residual, and weights of groups.

Weights are functions of the size s of a residual in units of its standard deviation, from 1 for small sizes downwards.
They multiply squares: a row of equations is multiplied by their root.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Floats = NDArray[np.float64]

#: Median of the absolute value of a normally distributed error, σ = 1: Φ⁻¹(3/4).
MEDIAN_1D = 0.6744897501960817
#: Median of the length of two such errors: √(2 ln 2).
MEDIAN_2D = 1.1774100225154747
#: Where weights fall so that 5 % of efficiency are lost at normally distributed errors (Holland and Welsch 1977).
BISQUARE = 4.685


def spread(residuals: ArrayLike, centre: float | None = 0.0) -> float:
    """Standard deviation by the median of absolute values (MAD) of residuals; NaN: none is finite."""
    values = np.asarray(residuals, float)
    values = values[np.isfinite(values)]
    if not values.size:
        return float("nan")
    return float(np.median(np.abs(values - (np.median(values) if centre is None else centre)))) / MEDIAN_1D


def huber(size: _Floats, limit: float) -> _Floats:
    """min(1, limit / s): least squares inside, absolute values outside (Huber 1964)."""
    return np.asarray(limit / np.maximum(np.abs(size), limit), float)


def cauchy(size: _Floats, limit: float) -> _Floats:
    """1 / (1 + (s / limit)²)."""
    return np.asarray(1.0 / (1.0 + (size / limit) ** 2), float)


def geman_mcclure(size: _Floats, limit: float) -> _Floats:
    """1 / (1 + (s / limit)²)² (Geman and McClure 1987): far errors lose all influence."""
    return np.asarray(1.0 / (1.0 + (size / limit) ** 2) ** 2, float)


def bisquare(size: _Floats, limit: float = BISQUARE) -> _Floats:
    """(1 − (s / limit)²)², 0 beyond the limit (Beaton and Tukey 1974)."""
    return np.asarray(np.clip(1.0 - (size / limit) ** 2, 0.0, None) ** 2, float)


#: Smallest variance factor: data without noise would otherwise get weights that no arithmetic bears.
_LEAST = 0.02
#: Redundancy from which the variance factor of a group is worth estimating.
ENOUGH = 10.0


def variance_factors(e: _Floats, redundancies: _Floats, groups: NDArray[np.int64], before: _Floats) -> _Floats:
    """Standard deviation found over the one stated, of each group (Förstner 1979): root of Σ e² / Σ r.

    Groups with little redundancy keep the factor that they had: the more a group's weight grows, the less checks it, so
    its factor may not fall for ever, nor jump back.
    """
    total = np.bincount(groups, redundancies, len(before))
    square = np.bincount(groups, e**2, len(before))
    found = np.maximum(np.sqrt(square / np.maximum(total, ENOUGH)), _LEAST)
    return np.asarray(np.where(total > ENOUGH, found, before), float)

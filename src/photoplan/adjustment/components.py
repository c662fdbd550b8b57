"""Variance components: groups of observations are worth what their residuals say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

#: Smallest variance factor: data without noise would otherwise get weights that no arithmetic bears.
_LEAST = 0.02
#: Redundancy from which the variance factor of a group is worth estimating.
ENOUGH = 10.0


def variance_factors(e: _Floats, redundancies: _Floats, groups: NDArray[np.int64], before: _Floats) -> _Floats:
    """Standard deviation found over the one stated, of each group (Förstner 1979): root of Σ e² / Σ r.

    Groups with little redundancy keep the factor that they had: the more a group's weight grows, the less checks it, so
    its factor may not fall for ever, nor jump back.

    Parameters
    ----------
    e : ndarray, shape (n,)
        Residuals divided by the standard deviations that were stated.
    redundancies : ndarray, shape (n,)
        Redundancy numbers with the weights of `before`.
    groups : ndarray, shape (n,)
        Group of each observation.
    before : ndarray, shape (groups,)
    """
    total = np.bincount(groups, redundancies, len(before))
    square = np.bincount(groups, e**2, len(before))
    found = np.maximum(np.sqrt(square / np.maximum(total, ENOUGH)), _LEAST)
    return np.asarray(np.where(total > ENOUGH, found, before), float)

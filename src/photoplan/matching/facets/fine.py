"""Waves between coefficients of cubic grey facets, for facets that are coarser than pixels.

A cubic spline through samples of a wave with k radians a facet has beside it one with k − 2π, about (k / (2π − k))⁴ as
large. Pixels that lie nearly as the facets do see it as a shift of the first, over as long a stretch as they keep in
step, and hardly as residuals. The same coefficients with more of their neighbours give the wave alone.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

#: Coefficients along a row or column, waves of how many radians a facet they give (2.6 facets long), parts of a facet.
_TAPS, _SHORTEST, _PARTS = 8, 2.4, 128
_WAVES = 60


@cache
def shares() -> NDArray[np.float64]:
    """Of coefficients beside a place, see `add_missed`: by least squares, those with which waves have the size that
    cubic facets give them, and nothing beside."""
    k = np.linspace(0, _SHORTEST, _WAVES)
    sizes = np.sinc(k / (2 * np.pi)) ** 4
    at = np.arange(_TAPS) - (_TAPS // 2 - 1)
    out = np.empty((_PARTS + 1, _TAPS))
    for n in range(_PARTS + 1):
        turns = k[:, None] * (at - n / _PARTS)
        equations = np.concatenate([np.cos(turns), np.sin(turns)])
        out[n] = np.linalg.lstsq(equations, np.concatenate([sizes, np.zeros(_WAVES)]), rcond=None)[0]
    return np.asarray(out / out.sum(axis=1, keepdims=True))

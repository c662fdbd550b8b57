"""The median standard deviation of all tiles, from how many heights of each have which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Classes, the binary logarithms of their least and largest standard deviation, metres.
_CLASSES, _LEAST, _LARGEST = 256, -24.0, 8.0


def counted(sigmas: NDArray[np.floating]) -> list[int]:
    """How many standard deviations (metres, NaN: none) lie in each class; those beyond lie in the last."""
    known = sigmas[np.isfinite(sigmas)].astype(float)
    exponents = np.log2(np.clip(known, 2.0**_LEAST, 2.0**_LARGEST))
    return np.histogram(exponents, _CLASSES, (_LEAST, _LARGEST))[0].tolist()


def median(counts: Sequence[int]) -> float | None:
    """Median standard deviation, metres, to 4 %; None: there are none."""
    below = np.concatenate([[0], np.cumsum(counts)])
    if not below[-1]:
        return None
    exponents = np.linspace(_LEAST, _LARGEST, _CLASSES + 1)
    return float(2.0 ** np.interp(below[-1] / 2, below, exponents))

"""Grey values at which an image is cut off though its type, or the bits of its file, hold larger or smaller ones."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Pixels that are looked at.
_SAMPLE = 1 << 18
#: Share of the pixels, and their number, from which on an end is a pile.
_MANY, _LEAST = 0.01, 20
#: How many times as many pixels as the value beside it an end must hold: noise rounds to both.
_HEAP = 4
#: Share of the pixels that the other end may hold: more is a drawing, whose even areas have no noise.
_FEW = 0.002


def piled_ends(values: NDArray[Any]) -> tuple[float, float]:
    """Smallest and largest value where many pixels have exactly that value, and the other end shows noise.

    A sensor that is full, an amplifier or a developing program that cuts off, leaves such piles. A picture without
    noise has them at both ends and is not cut off.
    """
    flat = values.ravel()
    flat = flat[:: max(1, flat.size // _SAMPLE)]
    distinct, counts = np.unique(flat, return_counts=True)
    if distinct.size < 4:
        return -inf, inf
    first, second, before, last = (int(counts[k]) for k in (0, 1, -2, -1))
    many, few = max(_MANY * flat.size, _LEAST), _FEW * flat.size
    low = float(distinct[0]) if first >= max(many, _HEAP * second) and last < few else -inf
    high = float(distinct[-1]) if last >= max(many, _HEAP * before) and first < few else inf
    return low, high

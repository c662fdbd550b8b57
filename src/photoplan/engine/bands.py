"""A picture as a sum of bands of detail, from what of it can be used: a pyramid without steps between pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]


def detail_bands(
    values: NDArray[Any], usable: NDArray[np.bool_], reaches: Sequence[int], at: tuple[slice, slice]
) -> Iterator[_Floats]:
    """Bands of a picture whose sum it is (Burt and Adelson 1983), from the finest.

    Each is what one smoothing takes away that the finer one has left; the last is what the coarsest has left. Smoothed
    is over usable pixels alone, by weights that fall along rows and columns to nothing beyond a reach; a pixel's bands
    depend on what lies within the last but one of the reaches, in a sum of always the same order.
    """
    picture = np.where(usable, values, 0).astype(np.float64)
    before = picture[(slice(None), *at)]
    for reach in reaches[:-1]:
        known = np.maximum(_smooth(usable.astype(np.float64), reach, at), 1.0)
        after = np.stack([_smooth(band, reach, at) for band in picture]) / known
        yield before - after
        before = after
    yield before


def _smooth(values: _Floats, reach: int, at: tuple[slice, slice]) -> _Floats:
    """Sums by whole weights that fall from reach + 1 to 0 on both sides, along both axes, of a part."""
    # Products without bands do without it: a tenth of a second of their start.
    from scipy.ndimage import correlate1d  # noqa: PLC0415

    weights = reach + 1.0 - np.abs(np.arange(-reach, reach + 1))
    down = correlate1d(values, weights, axis=0, mode="constant")[at[0]]
    return np.asarray(correlate1d(down, weights, axis=1, mode="constant")[:, at[1]])

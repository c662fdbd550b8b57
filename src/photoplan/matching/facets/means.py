"""Means of neighbouring values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.kernels.matching import box_means

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]


def means_around(values: NDArray[np.floating], patch: int) -> _Doubles:
    """Means over patches of patch × patch values, fewer at the border, shape (rows, columns); an even patch has one
    more before than behind."""
    out = np.empty(values.shape)
    box_means(np.ascontiguousarray(values, float), patch // 2, patch - patch // 2, out)
    return out


def smoothed(values: _Floats) -> _Floats:
    """Means of three by three."""
    padded = np.pad(values, 1, mode="edge")
    across = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return (across[:-2] + across[1:-1] + across[2:]) / np.float32(9)


def corners(facets: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Posts at the corners of any of these facets: shape (rows, columns) of (rows − 1, columns − 1)."""
    around = np.pad(facets, 1)
    return around[:-1, :-1] | around[:-1, 1:] | around[1:, :-1] | around[1:, 1:]


def away_from_border(seen: NDArray[np.bool_], border: int, least: float) -> NDArray[np.bool_]:
    """Of what is seen of a block, what is `border` values away from its border and from what is not seen along that.

    Where less than the part `least` of what is seen would be left, the latter does not count. Holes do not, either:
    heights hang together around them. All of shape (rows, columns).
    """
    inner = np.zeros_like(seen)
    inner[border:-border, border:-border] = True
    inner &= seen
    if seen.all():
        return inner
    parts, _ = ndimage.label(~seen)
    edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    beside = ndimage.maximum_filter(np.isin(parts, edge[edge > 0]), 2 * border + 1)
    away: NDArray[np.bool_] = inner & ~beside
    return away if np.count_nonzero(away) >= least * np.count_nonzero(inner) else inner

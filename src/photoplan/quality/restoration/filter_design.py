"""Two-dimensional restoration filters from one-dimensional inverses (Kölbl 2006, §3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.spread import SpreadFunction


def radial_filter(
    inverse_x: NDArray[np.float64], inverse_y: NDArray[np.float64] | None = None, distance_digits: int | None = None
) -> NDArray[np.float64]:
    """Two-dimensional filter whose row and column sums are given one-dimensional inverses, turned about its centre.

    The rotation assumption: the weight depends on the distance r from the centre, linearly between the whole distances
    0, 1, 2 … of the main axes, and is 0 beyond the last but one; where the axes differ, it goes over from one to the
    other with the squared cosine of the direction. The weights on the axes follow from the row and column sums, as
    many linear equations as unknowns. Kölbl states this principle (2006, §3); with distances rounded to two digits it
    gives the printed filters of figures 4 and 6 to the last digit.

    Parameters
    ----------
    inverse_x, inverse_y : ndarray, shape (2 n + 1,)
        Inverses along a row and along a column, symmetric; None for y: the same. Their sums must be equal.
    distance_digits : int, optional
        Decimals to which distances are rounded; None: exact.

    Returns
    -------
    ndarray, shape (2 n + 1, 2 n + 1)

    Raises
    ------
    InputError
        Inverses of different length, not symmetric, or with different sums.
    """
    across = np.asarray(inverse_x, float)
    along = across if inverse_y is None else np.asarray(inverse_y, float)
    _check(across, along)
    half = across.size // 2
    weights = _axis_weights(half, distance_digits)
    # Column sums are the inverse along a row, row sums the one along a column; both sides are equal by symmetry.
    equations = np.concatenate([weights.sum(axis=0)[half:], weights.sum(axis=1)[half:]])
    right = np.concatenate([across[half:], along[half:]])
    axes = np.linalg.lstsq(equations, right, rcond=None)[0]
    return np.asarray(weights @ axes)


def point_spread(x: SpreadFunction, y: SpreadFunction) -> NDArray[np.float64]:
    """Point spread function whose sums are the spread functions along a row and along a column.

    Between the axes by the rotation assumption of `radial_filter`; both spread functions are made symmetric, and the
    shorter one is continued with 0. Shape (2 n + 1, 2 n + 1), sum 1.
    """
    half = max(x.half, y.half)
    across, along = (np.pad(one.side(), (0, half - one.half)) for one in (x, y))
    return radial_filter(np.concatenate([across[:0:-1], across]), np.concatenate([along[:0:-1], along]))


def separable_filter(
    inverse_x: NDArray[np.float64], inverse_y: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Two-dimensional filter as the product of the inverses: exact if the spread function itself is such a product.

    Shape (2 n + 1, 2 n + 1). Its noise gain is the product of both, much larger than that of `radial_filter`.
    """
    across = np.asarray(inverse_x, float)
    along = across if inverse_y is None else np.asarray(inverse_y, float)
    return np.outer(along, across)


def _check(across: NDArray[np.float64], along: NDArray[np.float64]) -> None:
    if across.shape != along.shape or across.ndim != 1 or across.size % 2 == 0 or across.size < 3:
        raise InputError(
            f"both inverses have the same odd number of values, at least 3; given: {across.shape} and {along.shape}"
        )
    for name, values in (("along rows", across), ("along columns", along)):
        if np.abs(values - values[::-1]).max() > 1e-9 * np.abs(values).max():
            raise InputError(f"the inverse {name} is not symmetric; a filter turned about its centre cannot hold it")
    if abs(across.sum() - along.sum()) > 1e-9 * max(1.0, abs(along.sum())):
        raise InputError(
            f"the inverses add up to {across.sum():.6g} along rows and {along.sum():.6g} along columns; divide each by "
            "its sum"
        )


def _axis_weights(half: int, digits: int | None) -> NDArray[np.float64]:
    """How each weight follows from those on the axes, shape (2 n + 1, 2 n + 1, 1 + 2 n): centre, x axis, y axis."""
    offset = np.arange(-half, half + 1.0)
    x, y = np.meshgrid(offset, offset)
    distance = np.hypot(x, y)
    if digits is not None:
        distance = np.round(distance, digits)
    with np.errstate(invalid="ignore", divide="ignore"):
        share_x = np.where(distance > 0.0, x**2 / (x**2 + y**2), 0.5)
    below = np.floor(distance + 1e-12).astype(int)
    weights = np.zeros((*distance.shape, 1 + 2 * half))
    for whole, part in ((below, 1.0 - (distance - below)), (below + 1, distance - below)):
        for ring in range(half + 1):
            here = np.where(whole == ring, part, 0.0)
            if ring == 0:
                weights[..., 0] += here
            else:
                weights[..., ring] += here * share_x
                weights[..., half + ring] += here * (1.0 - share_x)
    return weights

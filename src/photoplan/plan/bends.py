"""What boxes of anchors miss of a mapping that is bent: measured where it declares its breaks."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.breaks import Breaks

Positions = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]
"""Gives the strict homogeneous positions (k, 3) of places (k, 3) in (h, v, u), 0 to 1, in the boxes numbered (k,)."""

#: A bend that crosses a box askew is missed most between the lines along which it is looked for.
_BESIDE = 1.25
#: Crossings that are looked for together.
_MOST = 2_000_000

# 27 lines through a box in (h, v, u): nine along each axis, at its lower, middle and upper places.
_LINES = [
    (axis, np.insert(np.array(place), axis, 0.0))
    for axis in range(3)
    for place in itertools.product((0.0, 0.5, 1.0), repeat=2)
]
_AXIS = np.array([axis for axis, _ in _LINES])
_START = np.array([start for _, start in _LINES])
_ALONG = np.eye(3)[_AXIS]
_CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


def _weights(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear weights of the corners (4·ih + 2·iv + iu) at places (k, 3) in (h, v, u)."""
    return np.where(_CORNERS[None] == 1.0, fractions[:, None], 1.0 - fractions[:, None]).prod(axis=2)


_FROM, _TO = _weights(_START), _weights(_START + _ALONG)


def bend_errors(
    breaks: Breaks,
    corners: NDArray[np.float64],
    strict: Positions,
) -> NDArray[np.float64]:
    """Residual of boxes at the breaks that cross them, pixels.

    Parameters
    ----------
    breaks : Breaks
        By positions that the boxes give.
    corners : ndarray, shape (n, 8, 3)
        Homogeneous corners of the boxes.
    strict : callable

    Returns
    -------
    ndarray, shape (n, 4)
        Worst along lines in h, v and u, and worst of all; 0 where no break crosses.
    """
    errors = np.zeros((len(corners), 4))
    for component, places in enumerate((np.asarray(breaks.columns), np.asarray(breaks.rows))):
        many = max(1, _MOST // (27 * max(1, len(places))))
        for first in range(0, len(corners) if len(places) else 0, many):
            some = slice(first, first + many)
            begin, end = (np.einsum("lc,ncj->nlj", w, corners[some]) for w in (_FROM, _TO))
            step = end - begin
            at = begin[..., component, None] - places * begin[..., 2, None]
            with np.errstate(all="ignore"):
                t = at / (places * step[..., 2, None] - step[..., component, None])
            box, line, place = np.nonzero((t > 0) & (t < 1))
            t = t[box, line, place]
            between = begin[box, line] + t[:, None] * step[box, line]
            found = strict(box + first, _START[line] + t[:, None] * _ALONG[line])
            with np.errstate(all="ignore"):
                miss = np.hypot(*(between[:, :2] / between[:, 2:] - found[:, :2] / found[:, 2:]).T)
            miss = _BESIDE * np.nan_to_num(miss, nan=np.inf)
            np.maximum.at(errors, (box + first, _AXIS[line]), miss)
            np.maximum.at(errors[:, 3], box + first, miss)
    return errors

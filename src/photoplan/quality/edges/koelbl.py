"""Spread function from the response of one edge, by differences (Kölbl 2006, §3 and table 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.edges.response import EdgeMeasurement
from photoplan.quality.spread import SpreadFunction

#: Pixels to each side that a spread function is asked for.
_HALF = 5


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """Spread function that an edge shows."""

    spread: SpreadFunction
    beyond: float
    """Share of the light that falls outside of the spread function's reach (stray light)."""


def spread_from_response(
    position: NDArray[np.float64], response: NDArray[np.float64], half: int, sigma: NDArray[np.float64] | None = None
) -> tuple[SpreadFunction, float]:
    """Discrete spread function from a finely sampled edge spread function.

    The share at k pixels is the rise of the response from k - 1/2 to k + 1/2: what a profile across an edge on the
    border of two pixels shows.
    """
    reach = half + 0.5
    if position[0] > -reach or position[-1] < reach:
        raise InputError(
            f"the edge is known from {position[0]:.1f} to {position[-1]:.1f} pixels; a spread function of {half} "
            f"pixels to each side needs {reach} on both"
        )
    borders = np.arange(-half, half + 2) - 0.5
    at = np.interp(borders, position, response)
    values = np.diff(at)
    total = float(values.sum())
    if not total > 0.0:
        raise InputError("the edge response does not rise")
    errors = None
    if sigma is not None:
        each = np.interp(borders, position, sigma)
        errors = np.hypot(each[1:], each[:-1]) / total
    return SpreadFunction(values / total, errors), 1.0 - total


def spread_of_edge(edge: EdgeMeasurement) -> EdgeSpread | None:
    """Discrete spread function of a measured edge, five pixels to each side or as far as it is seen.

    It follows from the edge spread function as measured. An edge that runs along the pixels shows that at one phase
    only, and what lies between its samples is a model (`EdgeMeasurement.sampling`). The solution by a mixed object
    pixel (design/009) is no help there: half a pixel from the border it gives Z = 0.83 where it is 0.61.
    """
    positions = edge.esf.positions
    half = min(_HALF, int(min(-positions[0], positions[-1]) - 0.5))
    if half < 1:
        return None
    try:
        spread, beyond = spread_from_response(positions, edge.esf.values, half, edge.esf.sigma)
    except InputError:
        return None
    return EdgeSpread(spread, beyond)

"""Saturation: where a sensor stops to answer more light with larger grey values.

Three signs, the first that is found counts: grey values stop at the largest that the camera writes; the response falls
below the line of the darker levels; the temporal variance falls although the mean grows (EMVA 1288 release 4 linear,
section 6.6).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, nan, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.linear import solve
from photoplan.adjustment.robust import spread
from photoplan.errors import InputError

#: Share of samples at the largest grey value from which on a level is clipped.
_CLIPPED = 0.01
#: Share at the last level from which on it shows saturation, not a bright spot.
_MOSTLY = 0.5
#: Standard deviations below the level of a full sensor down to which its samples lie.
_SPREAD = 4.0
#: Part of the response that is lost where a level departs from the line.
_DEPARTED = 0.05


@dataclass(frozen=True)
class Saturation:
    """Where and why it saturates."""

    level_dn: float
    """Mean grey value of the most exposed level: what saturation looks like."""
    rule: str
    """``clipping``, ``response`` or ``variance``."""
    last_unsaturated: float
    """Largest exposure without the sign."""
    first_saturated: float
    exposure: float
    """Exposure at which the line of the darker levels reaches `level_dn`; NaN if it lies not between the two."""
    exposure_sigma: float


@dataclass(frozen=True)
class FullWell:
    """A sensor that is full below the largest grey value that is written."""

    level_dn: float
    """Grey value of its full elements, their median."""
    least_dn: float
    """Grey value from which on a sample may be one of a full element."""


def full_well(mean: ArrayLike, temporal_variance: float, step: float = 1.0) -> FullWell:
    """Grey values of full elements, from frames in which most elements are full."""
    values = np.asarray(mean, float)
    level = float(np.median(values))
    pattern = spread(values, level)
    noise = sqrt(pattern**2 + (temporal_variance if isfinite(temporal_variance) else 0.0) + step**2 / 12)
    return FullWell(level, level - _SPREAD * noise)


def find_saturation(
    exposure: ArrayLike, mean: ArrayLike, black: float, saturated_share: ArrayLike, variance: ArrayLike | None = None
) -> Saturation | None:
    """Saturation of levels with growing exposure; None where none of them shows a sign of it."""
    x, y, share = (np.asarray(v, float) for v in (exposure, mean, saturated_share))
    if x.size < 4 or (np.diff(x) <= 0).any():
        raise InputError(f"{x.size} levels; saturation needs four of increasing exposure")
    if not isfinite(black):
        black = _black_of_line(x[: max(3, x.size // 2)], y[: max(3, x.size // 2)])
    signal = y - black
    found = {
        "clipping": _first(share > _CLIPPED) if share[-1] >= _MOSTLY else None,
        "response": _first_departure(x, signal),
        "variance": None if variance is None else _first_collapse(np.asarray(variance, float)),
    }
    if found["clipping"] == 0:
        raise InputError("every level has saturated samples; take shorter exposures")
    known = {rule: k for rule, k in found.items() if k is not None and k > 0}
    if not known:
        return None
    rule = min(known, key=lambda name: (known[name], list(known).index(name)))
    first = known[rule]
    level = float(y[-1])
    response = float(np.median(signal[:first] / x[:first]))
    # Of a median, whose variance is π / 2 times that of a mean.
    spread = float(np.std(signal[:first] / x[:first])) * sqrt(pi / 2 / max(first - 1, 1))
    at = (level - black) / response if response > 0 else inf
    # Clipped shares begin before the mean arrives: the crossing may lie a little outside of the two levels.
    inside = 0.8 * x[first - 1] <= at <= 1.2 * x[first]
    sigma = at * spread / response if inside and first > 1 else nan
    return Saturation(
        level_dn=level,
        rule=rule,
        last_unsaturated=float(x[first - 1]),
        first_saturated=float(x[first]),
        exposure=at if inside else nan,
        exposure_sigma=sigma,
    )


def _black_of_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Grey value at no exposure of the line of least relative deviations; not below 0, nor above the darkest level."""
    below = np.maximum(y, 1e-300)
    offset, _ = solve(np.column_stack([1 / below, x / below]), np.ones_like(x)).unknowns
    return float(np.clip(offset, 0.0, max(0.0, float(y[0]))))


def _first(signs: NDArray[np.bool_]) -> int | None:
    """The first level from which on all show the sign."""
    without = np.flatnonzero(~signs)
    first = int(without[-1]) + 1 if without.size else 0
    return first if first < signs.size else None


def _first_departure(x: NDArray[np.float64], signal: NDArray[np.float64]) -> int | None:
    """Level from which on the response stays below that of the darker ones, with a flat end."""
    with np.errstate(invalid="ignore", divide="ignore"):
        response = signal / x
    reference = float(np.median(response[: max(2, x.size // 2)]))
    first = _first(response < (1 - _DEPARTED) * reference)
    if first is None or first == x.size:
        return None
    last_slope = (signal[-1] - signal[-2]) / (x[-1] - x[-2])
    return first if last_slope < 0.1 * reference else None


def _first_collapse(variance: NDArray[np.float64]) -> int | None:
    """Level behind the largest variance, where the last is less than half of it."""
    if not np.isfinite(variance).all():
        return None
    top = int(np.argmax(variance))
    return top + 1 if top + 1 < variance.size and variance[-1] < 0.5 * variance[top] else None

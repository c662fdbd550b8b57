"""Blooming: charge of an overfull pixel that runs over into its neighbours (Behr 1989, §4.2.3).

A bright object is exposed longer and longer. As long as nothing runs over, its neighbours grow with the exposure like
everything else, stray light included. Where they begin to grow faster, blooming has begun; the grey value that the
object has there is the onset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import nan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.errors import InputError

#: Pixels from the object up to which its neighbours lie. The nearest ones count, since charge fills them first; what
#: they hold of the object's own light belongs to their response.
_FAR = 4
#: Standard deviations by which neighbours must exceed what was expected.
_SIGNIFICANT = 4.0
#: Part of the range of grey values up to which the threshold of lifted pixels tells them.
_TOLD = 0.25
#: Part of the brightest grey value that the object reaches, up to which it gives the responses.
_SAFE = 0.55


@dataclass(frozen=True, eq=False)
class Blooming:
    """What neighbours of a bright object show."""

    onset_dn: float
    """Grey value of the object above black, from its response, at which neighbours begin to grow faster; NaN: they do
    not."""
    onset_dn_sigma: float
    last_without: float
    """Object's grey value above black at the longest exposure without blooming."""
    object_dn: NDArray[np.float64]
    """Grey value of the object above black that its response promises at each exposure."""
    excess_dn: NDArray[np.float64]
    """Grey value of the neighbours above what was expected."""
    excess_sigma: NDArray[np.float64]
    extent_rows: int
    """Pixels beyond the object along columns (up or down) that are lifted at `extent_exposure`."""
    extent_columns: int
    """The same along rows."""
    extent_exposure: float
    """The longest exposure at which lifted pixels can be told."""


def find_blooming(
    exposures: Sequence[float],
    images: Sequence[NDArray[Any]],
    black: float | Sequence[float],
    saturation: float,
    step: float = 1.0,
) -> Blooming:
    """Onset and extent of blooming around the brightest object."""
    if len(exposures) < 4 or (np.diff(exposures) <= 0).any():
        raise InputError(f"{len(exposures)} exposures; blooming needs four that increase")
    blacks = np.broadcast_to(np.asarray(black, float), len(exposures))
    lights = [np.asarray(image, np.float32) - np.float32(below) for image, below in zip(images, blacks)]
    spans = saturation - blacks
    span = float(spans[0])
    tops = [_brightest(light) for light in lights]
    # Charge that runs over may keep the object far below the largest grey value.
    reached = min(span, max(tops))
    safe = [k for k, top in enumerate(tops) if top <= _SAFE * reached]
    if len(safe) < 2:
        raise InputError(
            f"the bright object is below half of its brightest grey value in {len(safe)} of {len(tops)} exposures; "
            "blooming needs two or more: expose shorter"
        )
    response = _response(exposures, lights, safe)
    bright = _object(response)
    near = _neighbours(response, bright)
    inside = response[bright]
    of_object = float(inside[inside >= 0.9 * np.percentile(inside, 90)].mean())
    times = np.array(exposures, float)
    excess = np.array(
        [
            float((light[near] - np.minimum(response[near] * t, full)).mean())
            for light, t, full in zip(lights, times, spans)
        ]
    )
    sigma = _sigmas(lights, times, response, near, safe, step)
    usable = np.array([float(np.median(light[near])) < 0.95 * full for light, full in zip(lights, spans)])
    object_dn = of_object * times
    onset, onset_sigma, last = _onset(object_dn, excess, sigma, usable)
    if not np.isfinite(onset) and object_dn[-1] < 0.95 * span:
        raise InputError(
            f"no blooming, but the bright object reaches only {object_dn[-1]:.4g} DN of {span:.4g}; expose it longer"
        )
    thresholds = np.maximum(_SIGNIFICANT * sigma * sqrt(near.sum()), 0.03 * reached)
    # Single pixels' responses are uncertain: far beyond the exposures that gave them they promise nothing.
    last_told = int(np.flatnonzero(thresholds <= _TOLD * span)[-1]) if (thresholds <= _TOLD * span).any() else 0
    promised = response * times[last_told]
    full = float(spans[last_told])
    lifted = lights[last_told] - np.minimum(promised, full) > thresholds[last_told]
    # What is full by its own light, blurred edges and stray light included, is the object by then.
    rows, columns = _extent(lifted, bright, _grown(bright, promised >= 0.9 * full))
    return Blooming(
        onset_dn=onset,
        onset_dn_sigma=onset_sigma,
        last_without=last,
        object_dn=object_dn,
        excess_dn=excess,
        excess_sigma=sigma,
        extent_rows=rows,
        extent_columns=columns,
        extent_exposure=float(times[last_told]),
    )


def _brightest(image: NDArray[Any]) -> float:
    """Largest value that more than a pixel has."""
    return float(ndimage.median_filter(np.asarray(image, np.float32), 3, mode="nearest").max())


def _response(
    exposures: Sequence[float], lights: Sequence[NDArray[np.float32]], safe: Sequence[int]
) -> NDArray[np.float64]:
    """Grey values per exposure of every pixel, from the exposures without saturation."""
    total = np.zeros(lights[0].shape)
    weight = 0.0
    for k in safe:
        total += exposures[k] * lights[k].astype(np.float64)
        weight += exposures[k] ** 2
    return total / weight


def _object(response: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels of the brightest object: over half of the largest response, the largest connected patch."""
    top = _brightest(response)
    patches, count = ndimage.label(response > 0.5 * top)
    if not count:
        raise InputError("no bright object found")
    sizes = np.bincount(patches.ravel())[1:]
    found = patches == 1 + int(np.argmax(sizes))
    if found.sum() < 4 or found.mean() > 0.5:
        raise InputError(
            f"the bright object has {int(found.sum())} of {found.size} pixels; blooming needs a small bright object on "
            "a dark ground: give a roi around one"
        )
    return np.asarray(found)


def _grown(bright: NDArray[np.bool_], full: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The object with the full pixels that are connected to it."""
    patches, _ = ndimage.label(bright | full)
    return np.isin(patches, np.unique(patches[bright]))


def _neighbours(response: NDArray[np.float64], bright: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Dark pixels close to the object."""
    square = np.ones((3, 3), bool)
    far = ndimage.binary_dilation(bright, square, _FAR)
    near = far & ~bright & (response < 0.25 * float(response[bright].mean()))
    if near.sum() < 8:
        raise InputError("the bright object has no dark surrounding; give a roi around an object on a dark ground")
    return np.asarray(near)


def _sigmas(
    lights: Sequence[NDArray[np.float32]],
    times: NDArray[np.float64],
    response: NDArray[np.float64],
    near: NDArray[np.bool_],
    safe: Sequence[int],
    step: float,
) -> NDArray[np.float64]:
    """Standard deviation of the mean excess: noise of the neighbours, and that of their responses."""
    residual = np.concatenate([(lights[k][near] - response[near] * times[k]) for k in safe])
    freedom = max(residual.size - near.sum(), 1)
    noise = sqrt(max(float(np.sum(residual**2)) / freedom, step**2 / 12))
    of_response = noise / sqrt(float(np.sum(times[list(safe)] ** 2)))
    level = np.array([max(float(light[near].mean()), step) for light in lights])
    base = max(float(np.mean(level[list(safe)])), step)
    grown = noise * np.sqrt(np.maximum(level / base, 1.0))  # shot noise
    return np.asarray(np.sqrt(grown**2 + (of_response * times) ** 2) / sqrt(near.sum()))


def _onset(
    level: NDArray[np.float64], excess: NDArray[np.float64], sigma: NDArray[np.float64], usable: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Where the excess leaves zero by the line through the first levels with blooming, its sigma, last without."""
    above = excess > _SIGNIFICANT * sigma
    without = np.flatnonzero(~above)
    first = int(without[-1]) + 1 if without.size else 0
    last = float(level[first - 1]) if first else 0.0
    if first >= level.size:
        return nan, nan, last
    beyond = [k for k in range(first, level.size) if usable[k]][:3]
    upper, before = float(level[first]), float(level[first - 2]) if first > 1 else 0.0
    crossings = [_crossing(level[[i, j]], excess[[i, j]]) for i, j in pairwise(beyond)]
    if crossings and before <= crossings[0] <= upper:
        i, j = beyond[:2]
        spread = float(np.hypot(2 * sigma[i], sigma[j]) * (level[j] - level[i]) / (excess[j] - excess[i]))
        # The growth is no straight line: how far the next pair leads elsewhere says by how much.
        bend = abs(crossings[1] - crossings[0]) if len(crossings) > 1 else (upper - last) / sqrt(12.0)
        return crossings[0], float(np.hypot(max(spread, 0.1 * (upper - last)), min(bend, upper - last))), last
    return (last + upper) / 2, (upper - last) / sqrt(12.0), last


def _crossing(level: NDArray[np.float64], excess: NDArray[np.float64]) -> float:
    """Where the line through two levels has no excess; NaN where it does not grow."""
    slope = (excess[1] - excess[0]) / (level[1] - level[0])
    return float(level[0] - excess[0] / slope) if slope > 0 else nan


def _extent(lifted: NDArray[np.bool_], bright: NDArray[np.bool_], grown: NDArray[np.bool_]) -> tuple[int, int]:
    """Longest unbroken run of lifted pixels from the grown object along the object's columns and along its rows."""
    return _run(lifted, bright, grown), _run(lifted.T, bright.T, grown.T)


def _run(lifted: NDArray[np.bool_], bright: NDArray[np.bool_], grown: NDArray[np.bool_]) -> int:
    longest = 0
    for col in np.flatnonzero(bright.any(axis=0)):
        rows = np.flatnonzero(grown[:, col])
        below, above = lifted[rows[-1] + 1 :, col], lifted[: rows[0], col][::-1]
        for side in (below, above):
            stop = np.flatnonzero(~side)
            longest = max(longest, int(stop[0]) if stop.size else side.size)
    return longest

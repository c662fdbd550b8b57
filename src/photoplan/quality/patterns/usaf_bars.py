"""The contrast of three bars of a USAF-1951 target, at a place that is known to a fraction of a period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.patterns.pixels import least_squares
from photoplan.quality.patterns.usaf_find import HALF, UsafElement, UsafPlace

Array = NDArray[np.float64]

#: Half the part of the bars' length that is used, periods: their ends are blurred.
_MIDDLE = 0.75
#: Half the part of a bar whose mean is its level, periods, where bars are wide.
_REACH = 0.125
#: Bars with fewer cycles per pixel have levels of their own; those with more are measured by their waves.
_WIDE = 0.1
#: Cycles per pixel of the highest harmonic wave that is fitted.
_LAST_WAVE = 0.8


@dataclass(frozen=True)
class ThreeBars:
    """What three bars show."""

    frequency: float
    """Cycles per pixel across them."""
    centre: tuple[float, float]
    """Column and row."""
    difference: float
    """Mean of the three bars less mean of both gaps; positive where the bars are seen as they are."""
    sigma: float
    flat: bool
    """The middle of bars and gaps is flat: the difference is that of wide areas."""
    clipped: float
    """Share of its pixels that are cut off."""
    square: float
    """Mean light of the square that they fill less that around it: finest bars run together to a grey square."""
    square_sigma: float


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels around three bars."""

    u: Array
    """Across the bars from the middle one, periods."""
    v: Array
    """Along the bars from their middle, periods."""
    light: Array
    clipped: Array
    centre: Array
    frequency: float
    across: Array
    """Unit vector."""


def _pixels(
    values: Array, clipped: NDArray[np.bool_] | None, place: UsafPlace, item: UsafElement, reach: float
) -> _Pixels | None:
    """Pixels up to so many periods from the centre; None where the element is not inside of the picture."""
    x_axis, y_axis = (place.matrix * item.period).T
    across, along = (y_axis, x_axis) if item.horizontal else (x_axis, y_axis)
    centre = place.pixel(item.x, item.y, item.step // 2)
    size = np.array(values.shape[::-1])
    signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    bars = np.array([centre + HALF * (a * across + b * along) for a, b in signs])
    if (bars < 0.0).any() or (bars > size - 1).any():
        return None
    corners = np.array([centre + reach * (a * across + b * along) for a, b in signs])
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 1, size)
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]]
    u, v = np.linalg.inv(np.stack([across, along], axis=1)) @ np.stack([x.ravel() - centre[0], y.ravel() - centre[1]])
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    cut = np.zeros(u.size) if clipped is None else clipped[part].ravel().astype(float)
    frequency = float(np.hypot(*along)) / float(abs(across[0] * along[1] - across[1] * along[0]))
    return _Pixels(
        u=u,
        v=v,
        light=values[part].ravel(),
        clipped=cut,
        centre=centre,
        frequency=frequency,
        across=across / float(np.hypot(*across)),
    )


def measure_three(
    values: Array, clipped: NDArray[np.bool_] | None, place: UsafPlace, item: UsafElement
) -> ThreeBars | None:
    """Difference between bars and gaps; None where the element is not inside of the picture, or has too few pixels.

    Bars are placed along their normal by their own wave, if it stands out; a linear change of light across them is
    taken away.
    """
    pixels = _pixels(values, clipped, place, item, 2.2)
    if pixels is None:
        return None
    u = pixels.u - _shift(pixels.u, pixels.v, pixels.light)
    inside = (np.abs(u) <= HALF) & (np.abs(pixels.v) <= _MIDDLE)
    if inside.sum() < 8:
        return None
    part, light = u[inside], pixels.light[inside]
    try:
        wide = pixels.frequency < _WIDE
        found = _wide(part, light) if wide else _fine(part, light, pixels.frequency)
    except InputError:
        return None
    far = np.maximum(np.abs(u), np.abs(pixels.v))
    square, around = pixels.light[far <= 1.0], pixels.light[(far > 1.6) & (far <= 2.2)]
    if min(square.size, around.size) < 4:
        return None
    return ThreeBars(
        pixels.frequency,
        (float(pixels.centre[0]), float(pixels.centre[1])),
        *found,
        float(pixels.clipped[inside].mean()),
        float(square.mean() - np.median(around)),
        float(around.std()),
    )


def place_pair(values: Array, place: UsafPlace, items: Sequence[UsafElement]) -> UsafPlace:
    """Shift one pair of groups so that its bars lie where the picture has bars.

    Makers place the inner pairs to a fraction of a millimetre; each pair is shifted by the sum of the correlations of
    its elements with three bars, up to a period of its first element.
    """
    pair = items[0].step // 2
    shift = np.zeros(2)
    for horizontal in (False, True):
        unit, steps = np.zeros(2), np.linspace(-1.0, 1.0, 65)
        score = np.zeros(steps.size)
        for item in items:
            if item.horizontal != horizontal:
                continue
            pixels = _pixels(values, None, place, item, 2.8)
            if pixels is None or pixels.frequency > 0.4:
                continue
            # Steps are periods of the pair's first element.
            own = steps * 2.0 ** ((item.step % 2) + (item.element - 1) / 6.0)
            near = np.abs(pixels.v) <= _MIDDLE
            u, light = pixels.u[near], pixels.light[near]
            score = score + np.array([_correlation(u - s, light) for s in own])
            unit = pixels.across / pixels.frequency * items[0].period / item.period
        if score.any():
            shift += float(steps[int(np.argmax(score))]) * unit
    return place.shifted(pair, shift)


def _correlation(u: Array, light: Array) -> float:
    """Correlation of pixels with three bars and the dark on both sides of them."""
    part = np.abs(u) <= 1.75
    if part.sum() < 12:
        return 0.0
    bars = np.where(np.abs(u[part]) <= HALF + 0.25, 0.5 + 0.5 * np.cos(2.0 * pi * u[part]), 0.0)
    grey = light[part] - light[part].mean()
    bars = bars - bars.mean()
    size = sqrt(float(grey @ grey) * float(bars @ bars))
    return float(grey @ bars) / size if size > 0.0 else 0.0


def _shift(u: Array, v: Array, light: Array) -> float:
    """By how much the bars lie beside their place, periods; 0 where their wave does not stand out."""
    shift = 0.0
    for _ in range(3):
        inside = (np.abs(u - shift) <= HALF) & (np.abs(v) <= _MIDDLE)
        if inside.sum() < 12:
            return 0.0
        turn = 2.0 * pi * (u[inside] - shift)
        columns = np.stack([np.ones_like(turn), turn, np.cos(turn), np.sin(turn)], axis=1)
        try:
            solution, covariance, _ = least_squares(columns, light[inside])
        except InputError:
            return 0.0
        a, b = float(solution[2]), float(solution[3])
        if a * a + b * b < 25.0 * (covariance[2, 2] + covariance[3, 3]):
            return 0.0
        shift += atan2(b, a) / (2.0 * pi)
        if abs(shift) > 0.3:
            return 0.0
    return shift


def _wide(u: Array, light: Array) -> tuple[float, float, bool]:
    """Difference of the means in the middle of bars and gaps."""
    level: list[tuple[float, float, float]] = []
    for k in (-1.0, -0.5, 0.0, 0.5, 1.0):
        away = np.abs(u - k)
        inner, outer = light[away <= _REACH / 2.0], light[(away > _REACH / 2.0) & (away <= _REACH)]
        if min(inner.size, outer.size) < 2:
            return _fine(u, light, _WIDE)
        level.append((float(inner.mean()), float(outer.mean()), float(inner.var(ddof=1)) / inner.size))
    inner_mean, outer_mean, variance = np.array(level).T
    # The mean of bars -1, 0, 1 and gaps -0.5, 0.5 have one centre: a linear change of light cancels.
    weights = np.array([1 / 3, -1 / 2, 1 / 3, -1 / 2, 1 / 3])
    difference = float(weights @ inner_mean)
    bend = difference - float(weights @ outer_mean)
    sigma = sqrt(float(weights**2 @ variance))
    return difference, sigma, bool(abs(bend) < 0.015 * abs(difference) + 2.0 * sigma and difference > 20.0 * sigma)


def _fine(u: Array, light: Array, frequency: float) -> tuple[float, float, bool]:
    """Difference of bars and gaps by waves with the bars' period, beside a level with slope and curvature.

    Harmonic waves are taken in as far as blur leaves them and the places of the pixels tell them apart.
    """
    turn = 2.0 * pi * u
    columns = [np.ones_like(u), u, u**2]
    # The level's curvature is the same for bars and gaps but for their mean squares, 2/3 and 1/4.
    weights = [0.0, 0.0, 2.0 / 3.0 - 0.25]
    best: tuple[float, float] | None = None
    least = np.inf
    for k in (1, 3, 5):
        if best is not None and k * frequency > _LAST_WAVE:
            break
        columns += [np.cos(k * turn), np.sin(k * turn)]
        weights += [2.0, 0.0]
        if u.size < 2 * len(columns):
            break
        try:
            solution, covariance, residuals = least_squares(np.stack(columns, axis=1), light)
        except InputError:
            break
        combine = np.array(weights)
        variance = max(float(combine @ covariance @ combine), 0.0)
        # What the places of the pixels alone make of noise.
        power = float(residuals @ residuals) / max(u.size - len(columns), 1)
        spread = variance / power if power > 0.0 else least
        if best is not None and spread > 3.0 * least:
            break
        least = min(least, spread)
        best = float(combine @ solution), sqrt(variance)
    if best is None:
        raise InputError("too few pixels for three bars")
    return *best, False

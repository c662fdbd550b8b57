"""Shares of square cells that shapes cover, exactly: half planes, bars, sectors, steps, discs."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi, radians, sin

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]
#: A side seen at less than this share of the other counts as none; the share is then wrong by less than that.
_THIN = 1e-7


def _over_cell(t: _Array, normal: tuple[float, float], side: float, first: _Wave, second: _Wave) -> _Array:
    """Mean over a square cell of a function of the distance t along a normal, from its first and second integrals.

    Seen along the normal a square is the convolution of two intervals, so the mean is a second difference.
    """
    long, short = sorted((abs(normal[0]) * side, abs(normal[1]) * side), reverse=True)
    if short < _THIN * long:
        return (first(t + long / 2.0) - first(t - long / 2.0)) / long
    outer, inner = (long + short) / 2.0, (long - short) / 2.0
    return (second(t + outer) - second(t + inner) - second(t - inner) + second(t - outer)) / (long * short)


_Wave = Callable[[_Array], _Array]


def edge_share(x: _Array, y: _Array, side: float, angle_deg: float) -> _Array:
    """Share to the right of a line through (0, 0) that is turned against the columns."""
    normal = (cos(radians(angle_deg)), sin(radians(angle_deg)))
    t = np.clip(normal[0] * x + normal[1] * y, -2.0 * side, 2.0 * side)
    return _over_cell(t, normal, side, lambda s: np.maximum(s, 0.0), lambda s: np.maximum(s, 0.0) ** 2 / 2.0)


def bar_share(x: _Array, y: _Array, side: float, period: float, angle_deg: float) -> _Array:
    """Share of bars that are half a period wide; a bar begins at (0, 0) and lies to its right."""
    normal = (cos(radians(angle_deg)), sin(radians(angle_deg)))
    half = period / 2.0

    def triangle(s: _Array) -> _Array:
        # Integral of the wave ±1 from 0; its mean is half / 2.
        inside = np.mod(s, period)
        return np.asarray(np.minimum(inside, period - inside))

    def parabolas(s: _Array) -> _Array:
        # Integral of the triangle less its mean: periodic.
        inside = np.mod(s, period)
        rest = np.maximum(inside - half, 0.0)
        falling = rest * half - rest**2 / 2.0
        rising = np.minimum(inside, half) ** 2 / 2.0
        return np.asarray(rising + falling - inside * half / 2.0)

    # The triangle's mean makes a term that is linear in s: it drops out of a second difference.
    mean = _over_cell(normal[0] * x + normal[1] * y, normal, side, triangle, parabolas)
    return 0.5 + 0.5 * mean


def sector_share(x: _Array, y: _Array, side: float, sectors: int) -> _Array:
    """Share of `sectors` bright sectors around (0, 0), as wide as the dark ones between them.

    Exact where no cell meets two borders; the cells at the middle are cut into 64 for that.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    share = _one_border(x, y, side, sectors)
    inner = np.hypot(x, y) < 1.5 * side / sin(pi / (2.0 * max(sectors, 1)))
    if inner.any():
        steps = (np.arange(8) - 3.5) * side / 8.0
        fine_x = x[inner][:, None, None] + steps[None, None, :]
        fine_y = y[inner][:, None, None] + steps[None, :, None]
        fine_x, fine_y = np.broadcast_arrays(fine_x, fine_y)
        share[inner] = _one_border(fine_x, fine_y, side / 8.0, sectors).mean((1, 2))
    return share


def _one_border(x: _Array, y: _Array, side: float, sectors: int) -> _Array:
    """Share of bright sectors in cells, each with regard to the nearest border only."""
    step = pi / sectors
    number = np.round(np.arctan2(y, x) / step)
    along = number * step
    normal_x, normal_y = -np.sin(along), np.cos(along)
    t = np.clip(normal_x * x + normal_y * y, -2.0 * side, 2.0 * side)
    a, b = np.abs(normal_x) * side, np.abs(normal_y) * side
    long, short = np.maximum(a, b), np.maximum(np.minimum(a, b), 1e-4 * side)
    outer, inner = (long + short) / 2.0, (long - short) / 2.0

    def second(s: _Array) -> _Array:
        return np.asarray(np.maximum(s, 0.0) ** 2 / 2.0)

    share = (second(t + outer) - second(t + inner) - second(t - inner) + second(t - outer)) / (long * short)
    return np.where(np.mod(number, 2) == 0, share, 1.0 - share)


def step_mean(x: _Array, side: float, steps: int, width: int) -> _Array:
    """Mean of a staircase from 0 to 1 with `steps` equal steps over `width`, x from its middle; outside its ends."""
    levels = np.arange(steps) / (steps - 1.0)
    borders = np.linspace(0.0, width, steps + 1)
    integral = np.concatenate([[0.0], np.cumsum(levels * width / steps)])

    def below(t: _Array) -> _Array:
        return np.asarray(np.interp(t, borders, integral) + np.maximum(t - width, 0.0))

    middle = x + width / 2.0
    return (below(middle + side / 2.0) - below(middle - side / 2.0)) / side


def disc_share(x: _Array, y: _Array, side: float, radius: float) -> _Array:
    """Share of cells that a disc around (0, 0) covers; the area of disc and square in closed form."""
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    distance = np.hypot(x, y)
    share = (distance < radius).astype(float)
    near = np.abs(distance - radius) <= side
    px, py, h = x[near], y[near], side / 2.0
    area = (
        _quarter(px + h, py + h, radius)
        - _quarter(px - h, py + h, radius)
        - _quarter(px + h, py - h, radius)
        + _quarter(px - h, py - h, radius)
    )
    share[near] = area / side**2
    return share


def _quarter(a: _Array, b: _Array, radius: float) -> _Array:
    """Area of the part of a disc with x ≤ a and y ≤ b."""
    a, b = np.clip(a, -radius, radius), np.clip(b, -radius, radius)
    level = np.abs(b)
    reach = np.sqrt(np.maximum(radius**2 - level**2, 0.0))
    # ∫ min(level, s(x)) dx from −radius to a, where s is half the chord: s outside ±reach, level between.
    capped = (
        _half_chords(np.minimum(a, -reach), radius)
        + level * (np.clip(a, -reach, reach) + reach)
        + _half_chords(np.maximum(a, reach), radius)
        - _half_chords(reach, radius)
    )
    return _half_chords(a, radius) + np.sign(b) * capped


def _half_chords(a: _Array, radius: float) -> _Array:
    """∫ √(r² − x²) dx from −r to a."""
    s = np.sqrt(np.maximum(radius**2 - a**2, 0.0))
    return (a * s + radius**2 * np.arcsin(np.clip(a / radius, -1.0, 1.0))) / 2.0 + pi * radius**2 / 4.0

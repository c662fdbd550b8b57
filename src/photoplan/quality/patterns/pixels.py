"""What all patterns need of their pixels: complete, not clipped, and a noise that can be told from the pattern."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.linear import solve
from photoplan.errors import InputError

Array = NDArray[np.float64]

#: Share of clipped pixels from which on a pattern is refused.
MOST_CLIPPED = 0.005
#: Side of the largest window that is measured at once.
MOST_SIDE = 8192


def clipped_pixels(stored: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels that are cut off at an end of the range, same shape.

    They are at a limit of an integer type; or they all have the highest (lowest) value, one in a hundred of them or
    more, while the other end of the range shows noise. Noise-free drawings are not clipped.
    """
    clipped = np.zeros(stored.shape, bool)
    if stored.size == 0:
        return clipped
    if np.issubdtype(stored.dtype, np.integer):
        limits = np.iinfo(stored.dtype)
        clipped |= (stored == limits.max) | (stored == limits.min)
    low, high = float(np.nanmin(stored)), float(np.nanmax(stored))
    at_low, at_high = stored == low, stored == high
    few, many = 0.002, 0.01
    if at_high.mean() >= many and at_low.mean() < few and _heaped(stored, high, -1, at_high):
        clipped |= at_high
    if at_low.mean() >= many and at_high.mean() < few and _heaped(stored, low, 1, at_low):
        clipped |= at_low
    return clipped


def _heaped(stored: NDArray[Any], end: float, step: int, at_end: NDArray[np.bool_]) -> bool:
    """An end of integers is cut off if it holds far more pixels than the value beside it: noise rounds to both."""
    return not np.issubdtype(stored.dtype, np.integer) or at_end.sum() >= 4 * (stored == end + step).sum()


def pattern_window(
    light: NDArray[Any], clipped: NDArray[np.bool_] | None, what: str, least: int = 12, most: int = MOST_SIDE
) -> Array:
    """The window of a pattern as float64, checked."""
    values = np.asarray(light, np.float64)
    if values.ndim != 2 or min(values.shape, default=0) < least:
        size = " × ".join(map(str, values.shape[::-1]))
        raise InputError(f"{what}: a window of {size} pixels; at least {least} × {least} are needed")
    if max(values.shape) > most:
        raise InputError(
            f"{what}: a window of {values.shape[1]} × {values.shape[0]} pixels; at most {most} a side, give the part "
            "with the pattern"
        )
    missing = int(values.size - np.isfinite(values).sum())
    if missing:
        raise InputError(f"{what}: {missing} of its pixels have no value; choose a window without gaps")
    if clipped is not None and clipped.mean() > MOST_CLIPPED:
        raise InputError(
            f"{what}: {100 * clipped.mean():.1f} % of its pixels are saturated or clipped; their contrast is unknown, "
            "expose shorter"
        )
    if float(np.ptp(values)) == 0.0:
        raise InputError(f"{what}: all pixels have the value {values.flat[0]:g}; there is no pattern")
    return values


def white_noise(values: Array) -> float:
    """Standard deviation of uncorrelated noise of a picture without its structure.

    The second mixed difference takes planes and slow structure away; Immerkær 1996, "Fast noise variance estimation".
    """
    rows = values[:-2] - 2.0 * values[1:-1] + values[2:]
    both = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    return float(np.sqrt((both**2).mean())) / 6.0


def waves(turn: ArrayLike, harmonics: Sequence[int]) -> Array:
    """Cosine and sine of each harmonic wave, shape (…, 2 · harmonics), at phases of shape (…) in periods."""
    angle = 2.0 * pi * np.multiply.outer(turn, np.asarray(harmonics, float))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(*angle.shape[:-1], -1)


def least_squares(columns: Array, values: Array) -> tuple[Array, Array, Array]:
    """Solution, its covariance, and residuals (observed minus computed) of an overdetermined linear system."""
    fit = solve(columns, values)
    if fit.rank < columns.shape[1]:
        raise InputError("the pixels do not determine the pattern: too few of its bars are in the window")
    return fit.unknowns, fit.covariance, -fit.residuals

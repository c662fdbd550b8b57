"""Statistical tests: the chance that a hypothesis without effect gives as much."""

from __future__ import annotations

import math

from scipy import special


def chance_normal(ratio: float) -> float:
    """Chance of a value as far from 0 on either side, in standard deviations that are known."""
    return float(2.0 * special.ndtr(-abs(ratio)))


def chance_t(ratio: float, freedom: float) -> float:
    """The same in standard deviations that were estimated with `freedom` (Student's distribution)."""
    return float(2.0 * special.stdtr(freedom, -abs(ratio))) if math.isfinite(ratio) else 0.0


def reach_t(share: float, freedom: float) -> float:
    """Estimated standard deviations within which a `share` of the errors lies (Student's distribution); NaN: none."""
    return float(special.stdtrit(freedom, 0.5 + share / 2.0)) if freedom > 0 else math.nan


def chance_chi_square(square: float, freedom: float) -> float:
    """Chance of a sum of squares of `freedom` normalised errors as large."""
    return float(special.chdtrc(freedom, square))


def chance_f(ratio: float, freedom: float, below: float) -> float:
    """Chance of a ratio of two variances as large, of `freedom` above and `below` below."""
    return float(special.fdtrc(freedom, below, ratio)) if ratio > 0.0 else 1.0


def chance_gain(whole: float, rest: float, more: float, freedom: float) -> float:
    """Chance that `more` unknowns without meaning lower a sum of squares from `whole` to `rest` (F-test).

    `freedom` is the redundancy with them.
    """
    return chance_f((whole - rest) / more / (rest / freedom), more, freedom)

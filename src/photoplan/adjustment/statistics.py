"""Statistics of adjustments: p-values and variance components."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray


def chance_normal(ratio: float) -> float:
    """Chance of a value as far from 0 on either side, in standard deviations that are known."""
    return float(2.0 * scipy.special.ndtr(-abs(ratio)))


def chance_t(ratio: float, freedom: float) -> float:
    """The same in standard deviations that were estimated with `freedom` (Student's distribution)."""
    return float(2.0 * scipy.special.stdtr(freedom, -abs(ratio))) if math.isfinite(ratio) else 0.0


def reach_t(share: float, freedom: float) -> float:
    """Estimated standard deviations within which a `share` of the errors lies (Student's distribution); NaN: none."""
    return float(scipy.special.stdtrit(freedom, 0.5 + share / 2.0)) if freedom > 0 else math.nan


def chance_chi_square(square: float, freedom: float) -> float:
    """Chance of a sum of squares of `freedom` normalised errors as large."""
    return float(scipy.special.chdtrc(freedom, square))


def chance_f(ratio: float, freedom: float, below: float) -> float:
    """Chance of a ratio of two variances as large, of `freedom` above and `below` below."""
    return float(scipy.special.fdtrc(freedom, below, ratio)) if ratio > 0.0 else 1.0


def chance_gain(whole: float, rest: float, more: float, freedom: float) -> float:
    """Chance that `more` unknowns without meaning lower a sum of squares from `whole` to `rest` (F-test).

    `freedom` is the redundancy with them.
    """
    return chance_f((whole - rest) / more / (rest / freedom), more, freedom)


_Floats = NDArray[np.float64]

#: Most steps, change of the deviance that ends them, longest step of the logarithm of a variance.
_STEPS, _SETTLED, _LONGEST = 30, 1e-3, 2.0
#: Variances beyond these, in units of what was stated, are zero or infinite.
_BOUNDS = 1e-8, 1e8


@dataclass(frozen=True, eq=False)
class Components:
    """Variances of the parts of a covariance matrix, where they are most likely."""

    variances: _Floats
    """Factor of each part of the matrix, (k,)."""
    deviance: float
    """−2 times the logarithm of the likelihood, without its constant: differences between models of the same data
    count."""


def variance_components(contrasts: _Floats, fixed: _Floats, parts: Sequence[_Floats], start: ArrayLike) -> Components:
    """Variances σ² of the covariance matrix V = fixed + Σ σ² · part that make error contrasts most likely.

    Contrasts are combinations Kᵀy of observations that no unknown moves, KᵀA = 0, so that their likelihood is the
    restricted one (Patterson and Thompson 1971). The steps are those of average information (Gilmour, Thompson and
    Cullis 1995) on the logarithms of the variances, halved where they lead to less likely ones.
    """
    values = np.asarray(start, float)
    now = _Likelihood.at(contrasts, fixed, parts, values)
    if now is None:
        raise ValueError("a covariance matrix that is not positive definite")
    for _ in range(_STEPS if len(parts) else 0):
        step = now.step(parts, values)
        for part in 0.5 ** np.arange(10):
            moved = np.clip(values * np.exp(part * step), *_BOUNDS)
            after = _Likelihood.at(contrasts, fixed, parts, moved)
            if after is not None and after.deviance <= now.deviance:
                break
        else:
            break
        gain = now.deviance - after.deviance
        values, now = moved, after
        if gain < _SETTLED:
            break
    return Components(values, now.deviance)


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """The deviance at some variances, and what its derivatives need."""

    factor: tuple[_Floats, bool]
    x: _Floats
    """V⁻¹ · contrasts."""
    deviance: float

    @classmethod
    def at(cls, w: _Floats, fixed: _Floats, parts: Sequence[_Floats], values: _Floats) -> _Likelihood | None:
        """None: the covariance matrix is not positive definite."""
        V = fixed.copy()
        for value, part in zip(values, parts):
            V += value * part
        try:
            factor = scipy.linalg.cho_factor(V, lower=True, overwrite_a=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            return None
        x = scipy.linalg.cho_solve(factor, w)
        return cls(factor, x, float(2.0 * np.log(np.diag(factor[0])).sum() + w @ x))

    def step(self, parts: Sequence[_Floats], values: _Floats) -> _Floats:
        """Step of the logarithms of the variances."""
        inverse = scipy.linalg.cho_solve(self.factor, np.eye(len(self.x)), overwrite_b=True)
        on = np.array([part @ self.x for part in parts])
        slope = np.array([np.vdot(inverse, part) for part in parts]) - on @ self.x
        information = on @ inverse @ on.T * np.outer(values, values)
        information += np.diag(1e-6 * np.diag(information) + 1e-9)
        step = -np.linalg.solve(information, slope * values)
        return np.asarray(np.clip(step, -_LONGEST, _LONGEST))

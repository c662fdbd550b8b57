"""Least squares: linear and Levenberg-Marquardt solutions, robust scales."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Floats = NDArray[np.float64]

#: Rows per unknown from which equations are decomposed by their normal equations.
_TALL = 50
#: Singular values below this part of the largest are no more than rounding, in the two ways of decomposition.
ROUNDING = 1e-10
_ROUNDING_TALL = 1e-7


@dataclass(frozen=True, eq=False)
class Decomposed:
    """Equations with columns of unit length, A = U diag(s) Vᵀ diag(length).

    Unknowns of very different size, and units, are so brought together. Few rows are decomposed as they are; many by
    their normal equations, a tenth of the work, since their columns do not resemble each other to seven digits.
    """

    A: _Floats
    """(n, u)."""
    length: _Floats
    s: _Floats
    """Singular values, falling, (u,); 0: not determined."""
    half: _Floats
    """V / s / length: a square root of the cofactors (u, u); 0 along what is not determined."""

    @classmethod
    def of(cls, A: _Floats, least: float = 0.0) -> Decomposed:
        """Decompose equations (n, u); singular values below the part `least` of the largest count as 0."""
        length = np.sqrt(np.einsum("ij,ij->j", A, A))
        # What is as good as zero is not brought to one: it counts as not determined.
        length = np.where(length > 1e-100 * length.max(initial=0.0), length, 1.0)
        if len(A) > _TALL * A.shape[1]:
            values, vectors = np.linalg.eigh(A.T @ A / np.multiply.outer(length, length))
            s, V, least = np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1], max(least, _ROUNDING_TALL)
        else:
            s, Vt = np.linalg.svd(A / length, full_matrices=False)[1:]
            V, least = Vt.T, max(least, ROUNDING)
        known = s > least * s.max(initial=0.0)
        inverse = np.where(known, 1.0 / np.where(known, s, 1.0), 0.0)
        return cls(A, length, np.where(known, s, 0.0), V * inverse / length[:, None])

    @property
    def rank(self) -> int:
        """Directions of the unknowns that the equations determine."""
        return int(np.count_nonzero(self.s))

    def along(self, y: _Floats) -> _Floats:
        """Uᵀ y of right sides (n,) or (n, k)."""
        return np.asarray(self.half.T @ (self.A.T @ y))

    def back(self, along: _Floats, damping: float = 0.0) -> _Floats:
        """Unknowns of `along`, with `damping` times the diagonal of the normal equations added to it (Marquardt)."""
        if damping > 0.0:
            along = (along.T * (self.s**2 / (self.s**2 + damping))).T
        return np.asarray(self.half @ along)

    @property
    def cofactors(self) -> _Floats:
        """Inverse of the normal equations (u, u)."""
        return np.asarray(self.half @ self.half.T)


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of `solve`."""

    unknowns: _Floats
    """(u,), or (u, k) where k right sides share the equations; 0 along what is not determined."""
    cofactors: _Floats
    """(u, u)."""
    residuals: _Floats
    """Computed minus observed, (n,) or (n, k)."""
    rank: int
    condition: float
    """Smallest over largest singular value of the equations with columns of unit length; 0: not determined."""
    square: float
    """Weighted sum of squared residuals."""
    redundancy: int
    """Observations of any weight minus unknowns that are determined."""
    A: _Floats
    weight: _Floats | None

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return math.sqrt(self.square / self.redundancy) if self.redundancy > 0 else math.nan

    @property
    def covariance(self) -> _Floats:
        """Of the unknowns (u, u), with sigma0 in it; where nothing is redundant, as if one observation were."""
        return self.cofactors * (self.square / max(self.redundancy, 1))

    @property
    def sigmas(self) -> _Floats:
        """Standard deviations of the unknowns, (u,)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def influence(self) -> _Floats:
        """By how much the unknowns change with each observation, (u, n)."""
        return np.asarray(self.cofactors @ (self.A.T if self.weight is None else self.A.T * self.weight))

    @property
    def redundancies(self) -> _Floats:
        """Redundancy numbers: the part of its own error that an observation shows in its residual, (n,)."""
        return np.asarray(1.0 - np.einsum("ij,ji->i", self.A, self.influence))

    def without(self, rows: NDArray[np.integer]) -> _Floats:
        """Residuals of some rows against the fit without these rows, same shape as their residuals.

        (I − H)⁻¹ v: the fit need not be repeated.
        """
        hat = self.A[rows] @ self.cofactors @ self.A[rows].T
        if self.weight is not None:
            hat = hat * self.weight[rows]
        return np.asarray(np.linalg.solve(np.eye(len(rows)) - hat, self.residuals[rows]))


def solve(A: _Floats, y: _Floats, weight: _Floats | None = None) -> Fit:
    """Least squares of A x = y."""
    root = None if weight is None else np.sqrt(weight)
    B = A if root is None else A * root[:, None]
    z = y if root is None else (y.T * root).T
    parts = Decomposed.of(B)
    x = parts.back(parts.along(z))
    # One step of refinement: what the decomposition has lost by rounding is small against what it has found.
    x = x + parts.back(parts.along(z - B @ x))
    square = float(((z - B @ x) ** 2).sum())
    count = len(A) if weight is None else int(np.count_nonzero(weight))
    redundancy = (count - parts.rank) * (1 if y.ndim == 1 else y.shape[1])
    condition = float(parts.s[-1] / parts.s[0]) if parts.rank else 0.0
    return Fit(
        unknowns=x,
        cofactors=parts.cofactors,
        residuals=A @ x - y,
        rank=parts.rank,
        condition=condition,
        square=square,
        redundancy=redundancy,
        A=A,
        weight=weight,
    )


State = TypeVar("State")

#: Largest step at the end, in units of each unknown's own standard deviation (the others fixed). The one rule of all
#: iterations of this package: what is left to go then is small against what is known, whatever the unknown's unit.
CONVERGED = 1e-3
#: Damping (part of the diagonal) after a step that made things worse, and when to give up.
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e6
#: Part of the first sum of squares that is no more than rounding.
_NOTHING = 1e-26


@dataclass(frozen=True, eq=False)
class Equations(Generic[State]):
    """Linearised equations at a state: residual + A · step."""

    state: State
    A: _Floats
    """(n, u)."""
    v: _Floats
    """Computed minus observed, (n,), both divided by standard deviations where these differ."""

    @property
    def square(self) -> float:
        """Sum of squares; infinite where a residual is not finite."""
        square = float(self.v @ self.v)
        return square if math.isfinite(square) else math.inf

    @property
    def redundancy(self) -> int:
        """Equations minus unknowns, at least 1."""
        return max(len(self.v) - self.A.shape[1], 1)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight."""
        return math.sqrt(self.square / self.redundancy)

    def cofactors(self) -> _Floats | None:
        """Inverse normal equations (u, u); None: the unknowns are not determined."""
        parts = Decomposed.of(self.A)
        return parts.cofactors if parts.rank == self.A.shape[1] else None


def levenberg(
    start: State,
    equations: Callable[[State], tuple[_Floats, _Floats] | None],
    moved: Callable[[State, _Floats], State | None],
    most: int = 25,
) -> Equations[State]:
    """The state with the least sum of squares near a start (Levenberg 1944, Marquardt 1963)."""
    first = equations(start)
    assert first is not None
    now = Equations(start, *first)
    nothing, damping = _NOTHING * now.square, 0.0
    parts = Decomposed.of(now.A)
    for _ in range(most if math.isfinite(now.square) else 0):
        step = -parts.back(parts.along(now.v), damping)
        state = moved(now.state, step)
        found = None if state is None else equations(state)
        trial = None if state is None or found is None else Equations(state, *found)
        small = float(np.abs(step * parts.length).max(initial=0.0)) <= CONVERGED * now.sigma0
        if trial is not None and trial.square <= now.square * (1.0 + 1e-9):
            now = trial
            if now.square <= nothing or (small and damping <= FIRST_DAMPING):
                break
            damping = damping / 10.0 if damping > 1e-9 else 0.0
            parts = Decomposed.of(now.A)
            continue
        damping = max(10.0 * damping, FIRST_DAMPING)
        if damping > MOST_DAMPING or (small and damping <= FIRST_DAMPING):
            break
    return now


def by_differences(values: Callable[[_Floats], _Floats], at: _Floats, step: ArrayLike) -> _Floats:
    """Derivatives of values (n,) by unknowns (u,), shape (n, u): central differences with a step, or one for each."""
    steps = np.broadcast_to(np.asarray(step, float), at.shape)
    ends = [(values(at + move), values(at - move)) for move in np.diag(steps)]
    found = [(up - down) / (2.0 * h) for (up, down), h in zip(ends, steps)]
    return np.stack(found, axis=-1) if found else np.empty((len(values(at)), 0))


#: Median of the absolute value of a normally distributed error, σ = 1: Φ⁻¹(3/4).
MEDIAN_1D = 0.6744897501960817
#: Median of the length of two such errors: √(2 ln 2).
MEDIAN_2D = 1.1774100225154747
#: Where weights fall so that 5 % of efficiency are lost at normally distributed errors (Holland and Welsch 1977).
BISQUARE = 4.685


def spread(residuals: ArrayLike, centre: float | None = 0.0) -> float:
    """Standard deviation by the median of absolute values (MAD) of residuals; NaN: none is finite."""
    values = np.asarray(residuals, float)
    values = values[np.isfinite(values)]
    if not values.size:
        return float("nan")
    return float(np.median(np.abs(values - (np.median(values) if centre is None else centre)))) / MEDIAN_1D


def huber(size: _Floats, limit: float) -> _Floats:
    """min(1, limit / s): least squares inside, absolute values outside (Huber 1964)."""
    return np.asarray(limit / np.maximum(np.abs(size), limit), float)


def cauchy(size: _Floats, limit: float) -> _Floats:
    """1 / (1 + (s / limit)²)."""
    return np.asarray(1.0 / (1.0 + (size / limit) ** 2), float)


def geman_mcclure(size: _Floats, limit: float) -> _Floats:
    """1 / (1 + (s / limit)²)² (Geman and McClure 1987): far errors lose all influence."""
    return np.asarray(1.0 / (1.0 + (size / limit) ** 2) ** 2, float)


def bisquare(size: _Floats, limit: float = BISQUARE) -> _Floats:
    """(1 − (s / limit)²)², 0 beyond the limit (Beaton and Tukey 1974)."""
    return np.asarray(np.clip(1.0 - (size / limit) ** 2, 0.0, None) ** 2, float)


#: Smallest variance factor: data without noise would otherwise get weights that no arithmetic bears.
_LEAST = 0.02
#: Redundancy from which the variance factor of a group is worth estimating.
ENOUGH = 10.0


def variance_factors(e: _Floats, redundancies: _Floats, groups: NDArray[np.int64], before: _Floats) -> _Floats:
    """Standard deviation found over the one stated, of each group (Förstner 1979): root of Σ e² / Σ r.

    Groups with little redundancy keep the factor that they had: the more a group's weight grows, the less checks it, so
    its factor may not fall for ever, nor jump back.
    """
    total = np.bincount(groups, redundancies, len(before))
    square = np.bincount(groups, e**2, len(before))
    found = np.maximum(np.sqrt(square / np.maximum(total, ENOUGH)), _LEAST)
    return np.asarray(np.where(total > ENOUGH, found, before), float)

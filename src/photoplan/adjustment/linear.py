"""Linear least squares of dense equations, with what it knows of its accuracy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

"""Essential matrices from five points in closed form."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Monomials x^a y^b z^c: the ten of third degree, which are eliminated, then the basis of the quotient ring.
_CUBIC = ((3, 0, 0), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 1, 1), (1, 0, 2), (0, 3, 0), (0, 2, 1), (0, 1, 2), (0, 0, 3))
_BASIS = ((2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
_QUADRATIC = _BASIS
_LINEAR = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))


def five_point_essentials(first: ArrayLike, second: ArrayLike) -> Array:
    """Essential matrices E with dᵀ₂ E d₁ = 0 for five pairs of directions.

    E lies in the four-dimensional null space of the five linear equations; det E = 0 and 2 E Eᵀ E − tr(E Eᵀ) E = 0 are
    ten cubic equations for its three coordinates (Nistér 2004, "An efficient solution to the five-point relative pose
    problem", IEEE PAMI 26). They are solved by the eigenvectors of the 10 × 10 action matrix of x on the quotient ring
    (Stewénius, Engels & Nistér 2006, "Recent developments on direct relative orientation", ISPRS Journal 60). Points
    on a plane are no special case.

    Parameters
    ----------
    first, second : array_like, shape (n, 5, 3)
        Directions in camera axes of each image.

    Returns
    -------
    ndarray, shape (n, 10, 3, 3)
        Real solutions of unit norm; NaN in place of complex ones.
    """
    a, b = np.asarray(first, float), np.asarray(second, float)
    a, b = a.reshape(-1, 5, 3), b.reshape(-1, 5, 3)
    Q = (b[:, :, :, None] * a[:, :, None, :]).reshape(-1, 5, 9)
    null = np.linalg.svd(Q)[2][:, 5:].reshape(-1, 4, 3, 3)
    # E = x N0 + y N1 + z N2 + N3: every entry is a linear polynomial, coefficients last.
    E = np.moveaxis(null, 1, -1)
    G = _eliminated(_constraints(E))
    action = np.zeros((len(a), 10, 10))
    for row, monomial in enumerate(_BASIS):
        raised = (monomial[0] + 1, monomial[1], monomial[2])
        if raised in _CUBIC:
            action[:, row] = -G[:, _CUBIC.index(raised)]
        else:
            action[:, row, _BASIS.index(raised)] = 1.0
    sound = np.asarray(np.isfinite(action).all(axis=(1, 2)))
    action[~sound] = np.eye(10)
    values, vectors = np.linalg.eig(action)
    with np.errstate(all="ignore"):
        xyz = np.swapaxes(vectors[:, 6:9] / vectors[:, 9:10], 1, 2)
        real = (np.abs(xyz.imag).max(axis=2) < 1e-8 * (1.0 + np.abs(xyz.real).max(axis=2))) & sound[:, None]
        real &= np.abs(values.imag) < 1e-8 * (1.0 + np.abs(values.real))
        weights = np.concatenate([xyz.real, np.ones((len(a), 10, 1))], axis=2)
        weights[~(real & np.isfinite(weights).all(axis=2))] = np.nan
        found = np.einsum("nkc,nijc->nkij", weights, E)
        return np.asarray(found / np.linalg.norm(found, axis=(2, 3), keepdims=True), float)


def _constraints(E: Array) -> Array:
    """Coefficients (n, 10, 20) of the ten cubic equations, of entries (n, 3, 3, 4)."""
    square = _sum([_product(E[:, :, None, k], E[:, None, :, k], 1) for k in range(3)])
    trace = square[:, 0, 0] + square[:, 1, 1] + square[:, 2, 2]
    cube = _sum([_product(square[:, :, None, k], E[:, None, k, :], 2) for k in range(3)])
    first = 2.0 * cube - _product(trace[:, None, None], E, 2)
    minors = [
        _product(E[:, 1, (k + 1) % 3], E[:, 2, (k + 2) % 3], 1)
        - _product(E[:, 1, (k + 2) % 3], E[:, 2, (k + 1) % 3], 1)
        for k in range(3)
    ]
    determinant = _sum([_product(minors[k], E[:, 0, k], 2) for k in range(3)])
    return np.concatenate([first.reshape(len(E), 9, 20), determinant[:, None]], axis=1)


def _sum(terms: list[Array]) -> Array:
    return np.asarray(np.sum(terms, axis=0), float)


def _eliminated(equations: Array) -> Array:
    """Cubic monomials by the basis: rows of G in cubic + G · basis = 0, (n, 10, 10); NaN where that fails."""
    left, right = equations[:, :, :10], equations[:, :, 10:]
    sound = np.abs(np.linalg.det(left / np.abs(left).max(axis=(1, 2), keepdims=True))) > 1e-40
    G = np.linalg.solve(np.where(sound[:, None, None], left, np.eye(10)), right)
    return np.where(sound[:, None, None], G, np.nan)


def _product(a: Array, b: Array, degree: int) -> Array:
    """Product of a polynomial of the given degree and a linear one, coefficients in the last axis."""
    table = _table(degree)
    return np.einsum("...i,...j,ijk->...k", a, b, table, optimize=True)


@cache
def _table(degree: int) -> Array:
    left = _LINEAR if degree == 1 else _QUADRATIC
    out = _QUADRATIC if degree == 1 else _CUBIC + _BASIS
    table = np.zeros((len(left), 4, len(out)))
    for i, a in enumerate(left):
        for j, b in enumerate(_LINEAR):
            table[i, j, out.index((a[0] + b[0], a[1] + b[1], a[2] + b[2]))] = 1.0
    return table

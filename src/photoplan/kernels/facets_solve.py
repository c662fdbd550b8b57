"""Heights of a grid of facets by conjugate gradients, and their variances by band Cholesky factors of its parts."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_rows import add_product, add_share, dot
from photoplan.kernels.jit import inner, kernel

#: Rows and columns between the posts of an entry: see `facets_height.OFFSETS`.
_DOWN, _ALONG = (0, 0, 0, 1, 1, 1, 2), (0, 1, 2, -1, 0, 1, 0)


@kernel
def add_curvatures(curve, out):
    """Add the normal equations of curvatures to those of the pixels, (7, rows, columns).

    `curve` has the weights of curvatures along columns, rows and across, (3, rows, columns), 0 where not inside.
    """
    for kind in range(3):
        count = 3 if kind < 2 else 4
        for row in range(curve.shape[1]):
            for col in range(curve.shape[2]):
                p = curve[kind, row, col]
                if not p > 0.0:
                    continue
                for k in range(count):
                    dj, di, a = curvature(kind, k)
                    for q in range(k, count):
                        ej, ei, b = curvature(kind, q)
                        down, along = ej - dj, ei - di
                        # (0, 0) (0, 1) (0, 2), (1, −1) (1, 0) (1, 1), (2, 0)
                        entry = along if down == 0 else (4 + along if down == 1 else 6)
                        out[entry, row + dj, col + di] += p * a * b


@inner
def curvature(kind, k):
    """Row and column from the middle, and factor, of the k-th post of a second difference: along, down, across."""
    if kind == 0:
        return 0, k - 1, -2.0 if k == 1 else 1.0
    if kind == 1:
        return k - 1, 0, -2.0 if k == 1 else 1.0
    return k // 2, k % 2, 1.0 if k == 0 or k == 3 else -1.0


@inner
def _factor(band):
    """Cholesky factor in place: L is the lower triangle, stored as the band is."""
    size, width = band.shape
    for n in range(size):
        column = band[n]
        if not column[0] > 0.0:
            return False
        column[0] = np.sqrt(column[0])
        scale = 1.0 / column[0]
        for k in range(1, width):
            column[k] *= scale
        for k in range(1, min(width, size - n)):
            if column[k] != 0.0:
                add_share(-column[k], column[k:], band[n + k, : width - k])
    return True


@inner
def _times(system, x, y):
    """y = system · x."""
    rows, columns = x.shape
    y[:] = 0.0
    for j in range(rows):
        add_product(system[0, j], x[j], y[j])
        for k in range(1, 7):
            dj, di = _DOWN[k], _ALONG[k]
            if j + dj < rows:
                i0, i1 = max(0, -di), columns - max(0, di)
                part = system[k, j, i0:i1]
                add_product(part, x[j + dj, i0 + di : i1 + di], y[j, i0:i1])
                add_product(part, x[j, i0:i1], y[j + dj, i0 + di : i1 + di])


@kernel
def solve_heights(system, right, rounds, enough, out):
    """Heights' corrections by conjugate gradients, preconditioned by the diagonal.

    Parameters
    ----------
    system : ndarray, shape (7, rows, columns)
        Of pixels and curvatures, see `add_curvatures`.
    right : ndarray, shape (rows, columns)
    rounds, enough
        Iterations at most; they end when what is left of the equations has fallen to this part.
    out : ndarray, shape (rows, columns)
        Start and result.

    Returns
    -------
    int
        Iterations.
    """
    rows, columns = right.shape
    residual, product = np.empty((rows, columns)), np.empty((rows, columns))
    way, improved = np.zeros((rows, columns)), np.empty((rows, columns))
    part, diagonal = np.empty(8), np.empty((rows, columns))
    _times(system, out, product)
    for j in range(rows):
        for i in range(columns):
            residual[j, i] = right[j, i] - product[j, i]
            diagonal[j, i] = 1.0 / max(system[0, j, i], 1e-300)
            improved[j, i] = diagonal[j, i] * right[j, i]
    first = dot(right, improved, part)
    before = 1.0
    for k in range(rounds):
        for j in range(rows):
            for i in range(columns):
                improved[j, i] = diagonal[j, i] * residual[j, i]
        size = dot(residual, improved, part)
        if not size > enough * enough * first:
            return k
        share = 0.0 if k == 0 else size / before
        for j in range(rows):
            for i in range(columns):
                way[j, i] = improved[j, i] + share * way[j, i]
        _times(system, way, product)
        curve = dot(way, product, part)
        if not curve > 0.0:
            return k
        for j in range(rows):
            add_share(size / curve, way[j], out[j])
            add_share(-size / curve, product[j], residual[j])
        before = size
    return rounds


@inner
def _invert(band, inverse, column):
    """Entries of the inverse inside the band (Takahashi 1973): row n holds columns n − w … n + w."""
    size, w = band.shape[0], band.shape[1] - 1
    inverse[:] = 0.0
    for n in range(size - 1, -1, -1):
        below = min(w, size - 1 - n)
        column[:] = 0.0
        for q in range(1, below + 1):
            if band[n, q] != 0.0:
                add_share(
                    -band[n, q] / band[n, 0], inverse[n + q, w - q + 1 : w - q + 1 + below], column[1 : below + 1]
                )
        total = 1.0 / band[n, 0] ** 2
        for k in range(1, below + 1):
            inverse[n, w + k] = inverse[n + k, w - k] = column[k]
            total -= band[n, k] / band[n, 0] * column[k]
        inverse[n, w] = total


@kernel
def variances(system, side, margin, out):
    """Variances of heights, part by part, with `margin` posts around each beyond which nothing changes; NaN where a
    part is singular.

    See `solve_heights`; `out` has shape (rows, columns).
    """
    rows, columns = out.shape
    column = np.empty(2 * (side + 2 * margin) + 1)
    for row in range(0, rows, side):
        for col in range(0, columns, side):
            j0, i0 = max(0, row - margin), max(0, col - margin)
            j1, i1 = min(rows, row + side + margin), min(columns, col + side + margin)
            n, m = j1 - j0, i1 - i0
            band, inverse = np.zeros((n * m, 2 * m + 1)), np.empty((n * m, 4 * m + 1))
            for j in range(n):
                for i in range(m):
                    for k in range(7):
                        if j + _DOWN[k] < n and 0 <= i + _ALONG[k] < m:
                            band[j * m + i, _DOWN[k] * m + _ALONG[k]] = system[k, j0 + j, i0 + i]
            done = _factor(band)
            if done:
                _invert(band, inverse, column)
            for j in range(row, min(rows, row + side)):
                for i in range(col, min(columns, col + side)):
                    out[j, i] = inverse[(j - j0) * m + i - i0, 2 * m] if done else np.nan

"""Heights of a grid of facets by conjugate gradients, and their variances by band Cholesky factors of its parts."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.facets_rows import add_both, add_four, add_product, add_share, dot
from photoplan.kernels.jit import inner, kernel, maker

#: Rows and columns between the posts of an entry: see `facets_height.OFFSETS`.
_DOWN, _ALONG = (0, 0, 0, 1, 1, 1, 2), (0, 1, 2, -1, 0, 1, 0)
#: Times by which the parts whose variances are computed at once are longer than wide.
_LONG = 12


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
def _factor(band, shares):
    """Cholesky factor in place: L is the lower triangle, stored as the band is. Three columns of zeros follow the
    band's own, as four rows are eliminated at once; `shares` is scratch of 4."""
    size, width = band.shape[0], band.shape[1] - 3
    for first in range(0, size, 4):
        several = min(4, size - first)
        for p in range(several):
            row = band[first + p]
            if not row[0] > 0.0:
                return False
            row[0] = np.sqrt(row[0])
            scale = 1.0 / row[0]
            for k in range(1, width):
                row[k] *= scale
            for q in range(p + 1, several):
                add_share(-row[q - p], row[q - p : width], band[first + q, : width - q + p])
        if several < 4:
            break
        a, b, c, d = band[first], band[first + 1], band[first + 2], band[first + 3]
        for k in range(4, min(width + 3, size - first)):
            count = width + 3 - k
            shares[0], shares[1], shares[2], shares[3] = -a[k], -b[k - 1], -c[k - 2], -d[k - 3]
            add_four(
                shares, a[k : k + count], b[k - 1 : k - 1 + count], c[k - 2 : k - 2 + count], d[k - 3 : k - 3 + count],
                band[first + k, :count],
            )  # fmt: skip
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


@maker
def _scaled(system, scale, kind):
    """The same system with unknowns such that its diagonal is 1, which is left out, by rows: (rows, 6, columns)."""
    rows, columns = scale.shape
    out = np.zeros((rows, 6, columns), kind.dtype)
    for j in range(rows):
        for k in range(1, 7):
            dj, di = _DOWN[k], _ALONG[k]
            if j + dj < rows:
                for i in range(max(0, -di), columns - max(0, di)):
                    out[j, k - 1, i] = system[k, j, i] * scale[j, i] * scale[j + dj, i + di]
    return out


@inner
def _go_on(system, share, residual, way, product, part):
    """way = residual + share · way, product = system · way of a scaled system; way · product."""
    rows, columns = way.shape
    total = 0.0
    for row in range(min(2, rows)):
        _renew(share, residual[row], way[row], product[row])
    for j in range(rows):
        if j + 2 < rows:
            _renew(share, residual[j + 2], way[j + 2], product[j + 2])
        for k in range(1, 7):
            dj, di = _DOWN[k], _ALONG[k]
            if j + dj < rows:
                i0, i1 = max(0, -di), columns - max(0, di)
                own, there = way[j, i0:i1], way[j + dj, i0 + di : i1 + di]
                here, other = product[j, i0:i1], product[j + dj, i0 + di : i1 + di]
                if dj == 0:
                    add_product(system[j, k - 1, i0:i1], there, here)
                    add_product(system[j, k - 1, i0:i1], own, other)
                else:
                    add_both(system[j, k - 1, i0:i1], there, own, here, other)
        total += dot(way[j : j + 1], product[j : j + 1], part)
    return total


@inner
def _renew(share, residual, way, product):
    """A row of what `_go_on` begins with: the diagonal is 1."""
    for i in range(len(way)):
        way[i] = residual[i] + share * way[i]
        product[i] = way[i]


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
    out : ndarray, shape (rows, columns), float32 or float64
        Start and result; what it lacks is found with numbers of its kind.

    Returns
    -------
    int
        Iterations.
    """
    rows, columns = right.shape
    scale, left = np.empty((rows, columns)), np.empty((rows, columns))
    _times(system, out, left)
    work = np.zeros((4, rows, columns), out.dtype)
    residual, way, product, more = work[0], work[1], work[2], work[3]
    first, before = 0.0, 1.0
    for j in range(rows):
        for i in range(columns):
            # What no equation knows stays.
            scale[j, i] = 1.0 / np.sqrt(system[0, j, i]) if system[0, j, i] > 0.0 else 0.0
            residual[j, i] = (right[j, i] - left[j, i]) * scale[j, i]
            first += (right[j, i] * scale[j, i]) ** 2
    part, system = np.empty(8, out.dtype), _scaled(system, scale, out)
    size, k = dot(residual, residual, part), 0
    while k < rounds and size > enough * enough * first:
        curve = _go_on(system, residual.dtype.type(0.0 if k == 0 else size / before), residual, way, product, part)
        if not curve > 0.0:
            break
        along = residual.dtype.type(size / curve)
        before, size, k = size, 0.0, k + 1
        for j in range(rows):
            add_share(along, way[j], more[j])
            add_share(-along, product[j], residual[j])
            size += dot(residual[j : j + 1], residual[j : j + 1], part)
    for j in range(rows):
        for i in range(columns):
            out[j, i] += scale[j, i] * more[j, i]
    return k


@inner
def _invert(band, inverse, column, shares):
    """Entries of the inverse inside the band (Takahashi 1973): row n holds columns n − w … n + w. See `_factor`."""
    size, w = band.shape[0], band.shape[1] - 4
    for n in range(size - 1, -1, -1):
        below = min(w, size - 1 - n)
        out, scale = column[1 : below + 1], -1.0 / band[n, 0]
        out[:] = 0.0
        for q in range(1, below - 2, 4):
            for k in range(4):
                shares[k] = scale * band[n, q + k]
            i = w - q + 1
            add_four(
                shares, inverse[n + q, i : i + below], inverse[n + q + 1, i - 1 : i - 1 + below],
                inverse[n + q + 2, i - 2 : i - 2 + below], inverse[n + q + 3, i - 3 : i - 3 + below], out,
            )  # fmt: skip
        for q in range(below // 4 * 4 + 1, below + 1):
            add_share(scale * band[n, q], inverse[n + q, w - q + 1 : w - q + 1 + below], out)
        total = 1.0 / band[n, 0] ** 2
        for k in range(1, below + 1):
            inverse[n, w + k] = inverse[n + k, w - k] = column[k]
            total -= band[n, k] / band[n, 0] * column[k]
        inverse[n, w] = total


@kernel
def variances(system, side, margin, out):
    """Variances of heights, part by part, with `margin` posts around each beyond which nothing changes; NaN where a
    part is singular. Parts are `side` columns wide and _LONG times as many rows long: narrow bands take least.

    See `solve_heights`; `out` has shape (rows, columns).
    """
    rows, columns = out.shape
    length = _LONG * side
    wide = min(columns, side + 2 * margin)
    most = min(rows, length + 2 * margin) * wide
    bands, inverses = np.empty(most * (2 * wide + 4)), np.empty(most * (4 * wide + 1))
    column, shares = np.empty(2 * wide + 1), np.empty(4)
    for row in range(0, rows, length):
        for col in range(0, columns, side):
            j0, i0 = max(0, row - margin), max(0, col - margin)
            j1, i1 = min(rows, row + length + margin), min(columns, col + side + margin)
            n, m = j1 - j0, i1 - i0
            band = bands[: n * m * (2 * m + 4)].reshape(n * m, 2 * m + 4)
            inverse = inverses[: n * m * (4 * m + 1)].reshape(n * m, 4 * m + 1)
            band[:] = 0.0
            for j in range(n):
                for i in range(m):
                    for k in range(7):
                        if j + _DOWN[k] < n and 0 <= i + _ALONG[k] < m:
                            band[j * m + i, _DOWN[k] * m + _ALONG[k]] = system[k, j0 + j, i0 + i]
            done = _factor(band, shares)
            if done:
                _invert(band, inverse, column, shares)
            for j in range(row, min(rows, row + length)):
                for i in range(col, min(columns, col + side)):
                    out[j, i] = inverse[(j - j0) * m + i - i0, 2 * m] if done else np.nan
